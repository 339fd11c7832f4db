"""The status follows the loop, at a bounded cost, and systemd is told."""

from threading import Event

import pytest

from socast.stream.loop import Tally
from socast.stream.service_snapshot import ServiceSnapshot
from socast.stream.service_status import ServiceStatus, ServiceWatch
from socast.stream.systemd_notify import SystemdNotifier
from tests.support.service import FULL, Clock, systemd_socket


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def status(clock):
    return ServiceStatus(clock=clock)


def test_snapshot_is_renewed_once_a_second_and_less_often_where_it_takes_long(status, clock):
    taken = []

    def take(tally, _):
        taken.append(clock.now)
        clock.now += 0.1 if len(taken) > 3 else 0.0
        return ServiceSnapshot(messages=tally.received)

    watch = ServiceWatch(status, take, clock=clock)
    for turn in range(120):
        watch(Tally(received=turn))
        clock.now += 0.1
    assert taken[:4] == pytest.approx([1000.0, 1001.0, 1002.0, 1003.0])
    assert 4.9 < taken[4] - taken[3] < 5.3
    assert status.snapshot.messages > 40


def test_systemd_is_told_of_the_start_the_watchdog_and_the_end(status, clock, tmp_path):
    with systemd_socket(tmp_path) as (received, address):
        stop = Event()
        watch = ServiceWatch(status, lambda *_: FULL, SystemdNotifier(address, 60.0), stop, clock)
        assert received.read() == []
        for _ in range(3):
            watch(Tally())
            clock.now += 9.0
        stop.set()
        for _ in range(2):
            watch(Tally())
        line = "STATUS=9 messages, 4 forecasts, 1 of 2 vehicles active, 2 rides, publishes, overlaps with shard 3/3"
        assert received.read() == ["WATCHDOG=1", "READY=1", line, "WATCHDOG=1", line, "STOPPING=1"]
