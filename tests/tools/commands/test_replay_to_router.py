"""`socast replay` to a router loses nothing, obeys a signal whoever stalls, and tells that the router is gone."""

import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path
from threading import Event, Thread

from socast.core.wire.messages import Message
from socast.stream.mcap_writer import replace_recording
from socast.stream.zenoh_source import ZenohSource
from tests.support.commands import SOCAST
from tests.support.router_process import RouterProcess
from tests.support.zenoh_sessions import eventually

START_NS = 1_700_000_000_000_000_000
READER = """
import sys
from socast.stream.zenoh_session import Connection, Node
with Node(Connection(connect=(sys.argv[1],), lease_s=120.0)) as node:
    subscriber = node.session.declare_subscriber("fleet/**", lambda _: None)
    node.flush()  # the router knows the subscriber before the process is stopped
    print("ready", flush=True)
    sys.stdin.readline()
"""
"""Subscribe until standard input ends; the router waits for 120 s where the process is stopped."""


@contextmanager
def replaying(*arguments):
    """Run a replay in a process of its own."""
    with subprocess.Popen([*SOCAST, "replay", *map(str, arguments)], stderr=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def rests(process):
    """Return whether a process uses less than a tenth of a processor for a second."""

    def count_ticks():
        return sum(map(int, Path(f"/proc/{process}/stat").read_text(encoding="ascii").split()[13:15]))

    before = count_ticks()
    time.sleep(1.0)
    return count_ticks() - before < 10


@contextmanager
def subscribing(endpoint):
    """Run a subscriber in a process of its own, which is killed even if it is stopped."""
    command = [sys.executable, "-c", READER, endpoint]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout.readline() == "ready\n"
            yield process
        finally:
            process.kill()


def test_replay_obeys_a_signal_while_a_subscriber_has_stalled(tmp_path):
    recording = tmp_path / "large.mcap"
    with replace_recording(recording) as sink:
        sink.put([Message("fleet/a/telemetry", b"x" * 20_000, START_NS + number) for number in range(4000)])
    with RouterProcess() as router, router.join() as node, subscribing(router.endpoint) as reader:
        reader.send_signal(signal.SIGSTOP)
        with replaying(recording, "--connect", router.endpoint, "--speed", "max") as replay:
            assert eventually(lambda: list(node.session.liveliness().get("fleet/a/telemetry/@adv/pub/**")))
            assert eventually(lambda: rests(replay.pid))
            assert replay.poll() is None, "it waits for the subscriber"
            began = time.monotonic()
            replay.terminate()
            _, err = replay.communicate(timeout=20)
    assert time.monotonic() - began < 5.0
    assert err.count("stopped while nobody reads") == 1
    assert "Traceback" not in err


def test_replay_loses_nothing_over_an_outage_of_the_router(tmp_path):
    recording, cars, each, step_ns = tmp_path / "shift.mcap", 20, 40, 500_000_000
    sent = [
        Message(f"fleet/{car}/telemetry", b'{"time_s":%d}' % number, START_NS + number * step_ns)
        for number in range(each)
        for car in range(cars)
    ]
    with replace_recording(recording) as sink:
        sink.put(sent)
    got: set[tuple[str, bytes]] = set()
    stop = Event()
    with RouterProcess() as router, router.join() as node:

        def take():
            for messages in ZenohSource(node, stop):
                got.update((message.key, message.payload) for message in messages)

        thread = Thread(target=take)
        thread.start()
        with replaying(recording, "--connect", router.endpoint, "--speed", 4) as replay:
            assert eventually(lambda: len(got) > cars * each // 4)
            router.kill()
            assert eventually(lambda: not node.session.info.routers_zid())
            router.start()
            try:
                assert eventually(lambda: len(got) == len(sent))
            finally:
                stop.set()
                thread.join(20)
            _, err = replay.communicate(timeout=20)
    assert got == {(message.key, message.payload) for message in sent}
    assert err.count("no router; waiting for it") == 1
    assert f"published {len(sent)} messages" in err
