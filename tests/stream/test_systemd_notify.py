"""The notifier sends what systemd reads, waits for nobody and never fails."""

import logging
import os

import pytest

from socast.stream.systemd_notify import SystemdNotifier
from tests.support.service import SystemdSocket, systemd_socket


def test_messages_reach_the_socket_of_the_environment(tmp_path):
    with systemd_socket(tmp_path) as (received, address):
        notifier = SystemdNotifier.from_environment({"NOTIFY_SOCKET": address})
        notifier.announce_ready()
        notifier.set_status("12 messages,\n3 vehicles")
        notifier.announce_stop()
        assert received.read() == ["READY=1", "STATUS=12 messages, 3 vehicles", "STOPPING=1"]
        notifier.close()
        notifier.announce_ready()
        assert len(received.read()) == 3


def test_abstract_socket_is_reached():
    received = SystemdSocket(f"\0socast-test-{os.getpid()}")
    notifier = SystemdNotifier(f"@socast-test-{os.getpid()}")
    notifier.announce_ready()
    assert received.read() == ["READY=1"]
    notifier.close()
    received.close()


def test_watchdog_is_fed_four_times_per_period(tmp_path):
    with systemd_socket(tmp_path) as (received, address):
        notifier = SystemdNotifier.from_environment({"NOTIFY_SOCKET": address, "WATCHDOG_USEC": "8000000"})
        for second in range(9):
            notifier.feed_watchdog(100.0 + second)
        assert received.read() == ["WATCHDOG=1"] * 5
        notifier.close()


@pytest.mark.parametrize(
    ("environment", "watchdog_s"),
    [
        ({"WATCHDOG_USEC": "60000000"}, 60.0),
        ({"WATCHDOG_USEC": "60000000", "WATCHDOG_PID": str(os.getpid())}, 60.0),
        ({"WATCHDOG_USEC": "60000000", "WATCHDOG_PID": "1"}, None),
        ({"WATCHDOG_USEC": "soon"}, None),
        ({"WATCHDOG_USEC": "0"}, None),
        ({}, None),
    ],
)
def test_watchdog_of_another_process_or_none_is_not_fed(environment, watchdog_s):
    assert SystemdNotifier.from_environment(environment).watchdog_s == watchdog_s


def test_without_systemd_nothing_is_sent():
    notifier = SystemdNotifier.from_environment({})
    notifier.announce_ready()
    notifier.feed_watchdog(1.0)
    notifier.close()


def test_vanished_socket_is_logged_once(tmp_path, caplog, monkeypatch):
    with systemd_socket(tmp_path) as (_, address):
        pass
    (tmp_path / "notify").unlink()
    notifier = SystemdNotifier(address, 1.0)
    monkeypatch.setattr(logging.getLogger("socast"), "propagate", True)
    for second in range(3):
        notifier.feed_watchdog(float(second))
    notifier.close()
    assert [line.message for line in caplog.records] == ["systemd is not told: No such file or directory"]


def test_full_socket_delays_no_message_for_long(tmp_path, monkeypatch):
    monkeypatch.setattr("socast.stream.systemd_notify.SEND_S", 0.001)
    with systemd_socket(tmp_path) as (received, address):
        notifier = SystemdNotifier(address)
        for _ in range(1_000):
            notifier.set_status("x" * 1_000)
        notifier.close()
        assert 0 < len(received.read()) < 1_000
