"""Run a fleet over real Zenoh while consumers and routers are killed, and compare the outcome with an uninterrupted
run.

`python -m tests.support.outages --kills 100 --restarts 20 --routers 5` plays a simulated shift of 200 cars at the rate
at which its loggers sent it. The publisher, the router and the consumer are separate processes. The result is one JSON
object.
"""

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import time
from bisect import bisect_left
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

from core.models import EXTENDED_PHYSICAL
from core.pipeline import Pipeline
from core.snapshot import open_snapshot
from core.wire.messages import Message
from stream.mcap_reader import McapSource
from stream.mcap_writer import McapSink
from stream.recorder import list_recordings
from stream.zenoh_session import Connection, Node, find_free_port
from tests.support.commands import SOCAST
from tests.support.zenoh_sessions import eventually

ROUTER = """
import sys, time
from stream.zenoh_session import Connection, Node
with Node(Connection(listen=(sys.argv[1],), mode="router")):
    time.sleep(1e6)
"""
PUBLISHER = """
import sys
from stream.mcap_reader import McapSource
from stream.source import pace_source
from stream.zenoh_pubsub import ZenohSink
from stream.zenoh_session import Connection, Node
with Node(Connection(connect=(sys.argv[1],))) as node:
    sink = ZenohSink(node)
    sys.stdin.readline()
    for messages in pace_source(McapSource(sys.argv[2]), float(sys.argv[3])):
        sink.put(messages)
    print("sent", flush=True)
    sys.stdin.readline()  # the caches stay until then
"""


@dataclass
class Outcome:
    """Compare what a consumer kept with what was sent."""

    sent: int = 0
    kills: int = 0
    clean_restarts: int = 0
    router_kills: int = 0
    seconds: float = 0.0
    lost: int = 0
    counted_twice: int = 0
    out_of_order: int = 0
    lost_by_car: dict[str, int] = field(default_factory=dict)
    told_lost_by_car: dict[str, int] = field(default_factory=dict)
    forecasts: int = 0
    other_forecasts: int = 0
    state_differs_in: list[str] = field(default_factory=list)


class Fleet:
    """Hold the processes of a run.

    Parameters
    ----------
    folder : Path
        Folder of recordings, state and logs.
    shift : Path
        Recording to publish.
    speed : float
        Ratio of recorded time to real time. [1]
    """

    def __init__(self, folder: Path, shift: Path, speed: float) -> None:
        self.folder, self.endpoint = folder, f"tcp/127.0.0.1:{find_free_port()}"
        self.starts = 0
        self.router = self._run(ROUTER, self.endpoint)
        self.publisher = self._run(PUBLISHER, self.endpoint, shift, speed, stdin=subprocess.PIPE)
        self.consumer = self.start_consumer()

    def start_consumer(self) -> "subprocess.Popen[str]":
        """Start the consumer; return once it listens."""
        self.starts += 1
        log = self.folder / f"{self.starts}.log"
        options = ("--connect", self.endpoint, "--record", self.folder / "kept", "--state", self.folder / "cars.state")
        with log.open("w") as file:
            command = [*SOCAST, "live", *map(str, options), "--flush", "1", "--json-log"]
            process = subprocess.Popen(command, stderr=file, stdout=subprocess.DEVNULL, text=True)
        if not eventually(lambda: '"listening"' in log.read_text() or process.poll() is not None, 120.0):
            raise TimeoutError(f"the consumer does not listen: {log.read_text()}")
        if process.poll() is not None:
            raise RuntimeError(f"the consumer has ended: {log.read_text()}")
        return process

    def restart_router(self, down_s: float) -> None:
        """Kill the router, and start it again."""
        self.router.kill()
        self.router.wait()
        time.sleep(down_s)
        self.router = self._run(ROUTER, self.endpoint)

    def close(self) -> None:
        """Kill what runs."""
        for process in (self.consumer, self.publisher, self.router):
            process.kill()
            process.wait()

    def _run(self, code: str, *arguments: object, stdin: int | None = None) -> "subprocess.Popen[str]":
        """Run code in a process of its own."""
        command = [sys.executable, "-c", code, *map(str, arguments)]
        return subprocess.Popen(command, stdin=stdin, stdout=subprocess.PIPE, text=True)


def run_outages(
    shift: Path,
    folder: Path,
    *,
    kills: int,
    restarts: int,
    routers: int,
    speed: float = 1.0,
    up_s: tuple[float, float] = (1.0, 6.0),
    down_s: tuple[float, float] = (0.0, 1.0),
    seed: int = 1,
) -> Outcome:
    """Play a shift while consumers and routers are killed, and compare the outcome.

    Parameters
    ----------
    shift : Path
        Recording of the shift.
    folder : Path
        Folder for the consumer's files.
    kills, restarts, routers : int
        Number of kills of the consumer, of its clean restarts, and of kills of the router.
    speed : float
        Ratio of recorded time to real time. [1]
    up_s, down_s : (float, float)
        Ranges of the times for which a consumer runs, and is down. [s]
    seed : int
        Seed of the times and of the order of events.
    """
    random_, fleet = random.Random(seed), Fleet(folder, shift, speed)
    outcome = Outcome(kills=kills, clean_restarts=restarts, router_kills=routers)
    forecasts: set[tuple[str, bytes]] = set()
    began = time.monotonic()
    events = ["kill"] * kills + ["restart"] * restarts
    random_.shuffle(events)
    for _ in range(routers):
        events.insert(random_.randrange(len(events) + 1), "router")
    try:
        with Node(Connection(connect=(fleet.endpoint,))) as listener:
            listener.session.declare_subscriber(
                "fleet/*/forecast", lambda each: forecasts.add((str(each.key_expr), each.payload.to_bytes()))
            )
            assert fleet.publisher.stdin
            assert fleet.publisher.stdout
            fleet.publisher.stdin.write("go\n")
            fleet.publisher.stdin.flush()
            for number, event in enumerate(events):
                time.sleep(random_.uniform(*up_s))
                if event == "router":
                    fleet.restart_router(random_.uniform(*down_s))
                    continue
                fleet.consumer.send_signal(signal.SIGKILL if event == "kill" else signal.SIGTERM)
                if (code := fleet.consumer.wait(30)) not in (0, -signal.SIGKILL):
                    raise RuntimeError(f"the consumer ended with {code}")
                time.sleep(random_.uniform(*down_s))
                fleet.consumer = fleet.start_consumer()
                print(f"{number + 1} of {len(events)}: {event}", file=sys.stderr)
            assert fleet.publisher.stdout.readline() == "sent\n"
            time.sleep(5.0)
            fleet.consumer.send_signal(signal.SIGTERM)
            assert fleet.consumer.wait(30) == 0
    finally:
        fleet.close()
    outcome.seconds = round(time.monotonic() - began, 1)
    compare_outcome(outcome, read_messages([shift]), folder, forecasts)
    return outcome


def compare_outcome(outcome: Outcome, sent: list[Message], folder: Path, forecasts: set[tuple[str, bytes]]) -> None:
    """Compare recording, forecasts and state of a consumer with those of an uninterrupted run.

    Parameters
    ----------
    outcome : Outcome
        Receives the result.
    sent : list of Message
        Messages in the order in which they were published.
    folder : Path
        Folder of the consumer's files.
    forecasts : set of (str, bytes)
        Forecasts that the consumer published.
    """
    once = list(dict.fromkeys((message.key, message.payload) for message in sent))
    kept = [(message.key, message.payload) for message in read_messages(list_recordings(folder / "kept"))]
    outcome.sent = len(once)
    times = Counter(kept)
    lost = [each for each in once if each not in times]
    outcome.lost, outcome.counted_twice = len(lost), sum(n - 1 for n in times.values())
    outcome.lost_by_car = dict(Counter(key.split("/")[1] for key, _ in lost if key.endswith("telemetry")))
    place = {each: number for number, each in enumerate(once)}
    numbers = [place[each] for each in kept if each in place]
    outcome.out_of_order = sum(a > b for a, b in pairwise(numbers))
    pipeline = Pipeline(EXTENDED_PHYSICAL)
    reference = {(forecast.key, forecast.payload) for forecast in pipeline.push(sent)}
    outcome.forecasts, outcome.other_forecasts = len(forecasts), len(forecasts - reference)
    content = open_snapshot((folder / "cars.state").read_bytes(), list(pipeline.context.effects))["state"]
    expected = open_snapshot(pipeline.snapshot(), list(pipeline.context.effects))["state"]
    outcome.state_differs_in = [name for name in expected if repr(content[name]) != repr(expected[name])]
    restored = Pipeline(EXTENDED_PHYSICAL)
    restored.restore((folder / "cars.state").read_bytes())
    outcome.told_lost_by_car = restored.quality().get("lost_by_car", {})


def read_messages(paths: Sequence[Path]) -> list[Message]:
    """Return the messages of recordings, one recording after the other."""
    return [message for path in paths for messages in McapSource(path) for message in messages]


def make_shift(path: Path, cars: int, hours: float, seed: int) -> None:
    """Write the recording of some hours of a simulated shift, at the time at which most cars are under way."""
    from socast import simulate_fleet  # noqa: PLC0415 - slow to import

    whole = path.with_name("whole.mcap")
    simulate_fleet(whole, vehicles=cars, shift_hours=3.0, seed=seed)
    messages = read_messages([whole])
    span = int(hours * 3600e9)
    times = [m.receipt_ns for m in messages]
    begin = max(times[::1000], key=lambda first: bisect_left(times, first + span) - bisect_left(times, first))
    before = [m for m in messages if m.receipt_ns < begin and not m.key.endswith("telemetry")]
    newest = list({m.key: m for m in before}.values())
    moved = [m._replace(receipt_ns=begin) for m in newest]
    with McapSink(path) as sink:
        sink.put(moved + [m for m in messages if begin <= m.receipt_ns < begin + span])


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(prog="python -m tests.support.outages", description=__doc__)
    for name, default in (("kills", 100), ("restarts", 20), ("routers", 5), ("cars", 200), ("seed", 1)):
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--speed", type=float, default=1.0)
    parser.add_argument("--hours", type=float, default=0.33)
    parser.add_argument("--down", type=float, default=1.0)
    parser.add_argument("--keep", type=Path)
    options = parser.parse_args()
    with TemporaryDirectory() as made:
        folder = options.keep or Path(made)
        folder.mkdir(exist_ok=True)
        make_shift(folder / "shift.mcap", options.cars, options.hours, options.seed)
        outcome = run_outages(
            folder / "shift.mcap",
            folder,
            kills=options.kills,
            restarts=options.restarts,
            routers=options.routers,
            speed=options.speed,
            down_s=(0.0, options.down),
            seed=options.seed,
        )
    print(json.dumps(asdict(outcome), indent=2))


if __name__ == "__main__":
    main()
    os._exit(0)
