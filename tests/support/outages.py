"""Run a fleet over real Zenoh while consumers and routers are killed, and compare the outcome with an uninterrupted
run.

`python -m tests.support.outages --kills 100 --restarts 20 --routers 5` plays a simulated shift of 200 cars at the rate
at which its loggers sent it. The publisher, the router and the consumer are separate processes. The result is one JSON
object. Caches hold 64 samples of each car, 192 s at this rate, and `--speed 20` shortens them to 10 s:
`--faults none --cars 20 --hours 1.5 --speed 20 --kills 5 --restarts 2 --routers 3 --up 15 20 --down 5 25`
has outages beyond them, after which the loss that the consumer tells of each car equals the truth.
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

import msgspec

from socast.core.models import EXTENDED_PHYSICAL
from socast.core.pipeline import Pipeline
from socast.core.snapshot import open_snapshot
from socast.core.wire.messages import Message, Telemetry
from socast.stream.mcap_reader import McapSource
from socast.stream.mcap_writer import McapSink
from socast.stream.recorder import list_recordings
from tests.support.commands import SOCAST
from tests.support.router_process import RouterProcess
from tests.support.zenoh_sessions import eventually

PUBLISHER = """
import sys
from socast.stream.mcap_reader import McapSource
from socast.stream.source import pace_source
from socast.stream.zenoh_sink import ZenohSink
from socast.stream.zenoh_session import Connection, Node
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
    """Compare what a consumer kept with what was sent.

    The loss of a car is that of its samples that can be decoded. What was lost before the first sample that the
    consumer has of a car is counted apart, because no consumer can tell it: a counter may begin anywhere. The told loss
    is what the state holds, less the gaps that the logger itself left, which an uninterrupted run tells too.
    """

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
    lost_before_first_by_car: dict[str, int] = field(default_factory=dict)
    cars_told_otherwise: int = 0
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
        self.folder, self.router = folder, RouterProcess()
        self.node, self.starts = self.router.join(), 0
        command = [sys.executable, "-c", PUBLISHER, self.router.endpoint, str(shift), str(speed)]
        self.publisher = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.consumer = self.start_consumer()

    def start_consumer(self) -> "subprocess.Popen[str]":
        """Start the consumer; return once it listens."""
        self.starts += 1
        log = self.folder / f"{self.starts}.log"
        files = "--record", self.folder / "kept", "--state", self.folder / "cars.state"
        options = "--connect", self.router.endpoint, *files, "--flush", 1, "--json-log"
        with log.open("w") as file:
            command = [*SOCAST, "live", *map(str, options)]
            process = subprocess.Popen(command, stderr=file, stdout=subprocess.DEVNULL, text=True)
        if not eventually(lambda: '"listening"' in log.read_text() or process.poll() is not None, 120.0):
            raise TimeoutError(f"the consumer does not listen: {log.read_text()}")
        if process.poll() is not None:
            raise RuntimeError(f"the consumer has ended: {log.read_text()}")
        return process

    def close(self) -> None:
        """Kill what runs."""
        for process in (self.consumer, self.publisher):
            process.kill()
            process.wait()
        self.node.close()
        self.router.kill()


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
    sent = read_messages([shift])
    random_, fleet = random.Random(seed), Fleet(folder, shift, speed)
    outcome = Outcome(kills=kills, clean_restarts=restarts, router_kills=routers)
    forecasts: set[tuple[str, bytes]] = set()
    began = time.monotonic()
    events = ["kill"] * kills + ["restart"] * restarts
    random_.shuffle(events)
    for _ in range(routers):
        events.insert(random_.randrange(len(events) + 1), "router")
    try:
        fleet.node.session.declare_subscriber(
            "fleet/*/forecast", lambda each: forecasts.add((str(each.key_expr), each.payload.to_bytes()))
        )
        assert fleet.publisher.stdin
        assert fleet.publisher.stdout
        fleet.publisher.stdin.write("go\n")
        fleet.publisher.stdin.flush()
        for number, event in enumerate(events):
            time.sleep(random_.uniform(*up_s))
            if event == "router":
                fleet.router.kill()
                time.sleep(random_.uniform(*down_s))
                fleet.router.start()
                continue
            fleet.consumer.send_signal(signal.SIGKILL if event == "kill" else signal.SIGTERM)
            if (code := fleet.consumer.wait(30)) not in (0, -signal.SIGKILL):
                raise RuntimeError(f"the consumer ended with {code}")
            time.sleep(random_.uniform(*down_s))
            fleet.consumer = fleet.start_consumer()
            print(f"{number + 1} of {len(events)}: {event}", file=sys.stderr)
        assert fleet.publisher.stdout.readline() == "sent\n"
        wait_for_newest(sent, folder)
        fleet.consumer.send_signal(signal.SIGTERM)
        assert fleet.consumer.wait(30) == 0
    finally:
        fleet.close()
    outcome.seconds = round(time.monotonic() - began, 1)
    compare_outcome(outcome, sent, folder, forecasts)
    return outcome


def wait_for_newest(sent: list[Message], folder: Path) -> None:
    """Return once the newest message of each key is in the recording of a consumer."""
    newest = {message.key: message.payload for message in sent}.items()
    assert eventually(lambda: newest <= set(read_kept(folder)), 120.0), "the newest messages were not recorded"


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
    kept = read_kept(folder)
    outcome.sent = len(once)
    times = Counter(kept)
    lost = [each for each in once if each not in times]
    outcome.lost, outcome.counted_twice = len(lost), sum(n - 1 for n in times.values())
    outcome.lost_by_car, outcome.lost_before_first_by_car = count_lost_samples(once, times)
    place = {each: number for number, each in enumerate(once)}
    numbers = [place[each] for each in kept if each in place]
    outcome.out_of_order = sum(a > b for a, b in pairwise(numbers))
    pipeline = Pipeline(EXTENDED_PHYSICAL)
    reference = {(forecast.key, forecast.payload) for forecast in pipeline.push(sent)}
    outcome.forecasts, outcome.other_forecasts = len(forecasts), len(forecasts - reference)
    content = open_snapshot((folder / "cars.state").read_bytes())["state"]
    expected = open_snapshot(pipeline.snapshot())["state"]
    outcome.state_differs_in = [name for name in expected if repr(content[name]) != repr(expected[name])]
    restored = Pipeline(EXTENDED_PHYSICAL)
    restored.restore((folder / "cars.state").read_bytes())
    told = Counter(read_losses(restored))
    told.subtract(read_losses(pipeline))
    outcome.told_lost_by_car = {car: lost for car, lost in told.items() if lost}
    truth = Counter(outcome.lost_by_car)
    outcome.cars_told_otherwise = sum(told[car] != truth[car] for car in told | truth)


def count_lost_samples(
    sent: list[tuple[str, bytes]], kept: Counter[tuple[str, bytes]]
) -> tuple[dict[str, int], dict[str, int]]:
    """Return the number of lost samples of each car after its first kept sample, and before it."""
    after, before = Counter[str](), Counter[str]()
    heard = set[str]()
    for key, payload in sent:
        if is_sample(key, payload):
            car = key.split("/")[1]
            if (key, payload) in kept:
                heard.add(car)
            else:
                (after if car in heard else before)[car] += 1
    return dict(after), dict(before)


def is_sample(key: str, payload: bytes) -> bool:
    """Return whether a message is a sample of telemetry that can be decoded."""
    try:
        return key.endswith("/telemetry") and bool(msgspec.json.decode(payload, type=Telemetry))
    except (msgspec.DecodeError, UnicodeDecodeError):
        return False


def read_losses(pipeline: Pipeline) -> dict[str, int]:
    """Return the number of lost samples of each car, as a pipeline tells it."""
    return dict(zip(pipeline.lanes.names, pipeline.decoder.losses.lost().tolist(), strict=True))


def read_kept(folder: Path) -> list[tuple[str, bytes]]:
    """Return the keys and payloads that a consumer has recorded."""
    return [(message.key, message.payload) for message in read_messages(list_recordings(folder / "kept"))]


def read_messages(paths: Sequence[Path]) -> list[Message]:
    """Return the messages of recordings, one recording after the other."""
    return [message for path in paths for messages in McapSource(path) for message in messages]


def make_shift(path: Path, cars: int, hours: float, seed: int, faults: str = "default") -> None:
    """Write the recording of some hours of a simulated shift, at the time at which most cars are under way."""
    from socast import simulate_fleet  # noqa: PLC0415 - slow to import

    whole = path.with_name("whole.mcap")
    simulate_fleet(whole, vehicles=cars, shift_hours=3.0, faults=faults, seed=seed)
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
    parser.add_argument("--up", type=float, nargs=2, default=(1.0, 6.0))
    parser.add_argument("--down", type=float, nargs=2, default=(0.0, 1.0))
    parser.add_argument("--faults", default="default")
    parser.add_argument("--keep", type=Path)
    options = parser.parse_args()
    with TemporaryDirectory() as made:
        folder = options.keep or Path(made)
        folder.mkdir(exist_ok=True)
        make_shift(folder / "shift.mcap", options.cars, options.hours, options.seed, options.faults)
        outcome = run_outages(
            folder / "shift.mcap",
            folder,
            kills=options.kills,
            restarts=options.restarts,
            routers=options.routers,
            speed=options.speed,
            up_s=options.up,
            down_s=options.down,
            seed=options.seed,
        )
    print(json.dumps(asdict(outcome), indent=2), flush=True)


if __name__ == "__main__":
    main()
    os._exit(0)
