"""Divide a simulated fleet among consumers over real Zenoh, compare their forecasts with replays, and kill one.

`python -m tests.support.shards --shards 4 --cars 200 --hours 2 --kill` prints one JSON object. Router and consumers are
separate processes on loopback. The cars drive over midnight UTC.
"""

import argparse
import json
import os
import signal
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from socast.core.pipeline import Pipeline
from socast.core.wire.messages import Message
from socast.core.wire.shard import Shard
from socast.stream.mcap_reader import McapSource
from socast.stream.zenoh_sink import ZenohSink
from tests.support.live_consumers import Start, consumers, logged
from tests.support.router_process import RouterProcess
from tests.support.zenoh_sessions import eventually

MIDNIGHT_NS = 1_516_060_800 * 10**9
"""Beginning of this day."""
ROUND_S = 6.0
"""Time of the stream that is published at once. [s]"""


@dataclass
class Outcome:
    """Hold the result of a run."""

    shards: int = 0
    cars: int = 0
    messages: int = 0
    seconds: float = 0.0
    forecasts: int = 0
    different: int = 0
    forecasts_after_midnight: int = 0
    forecasts_of_replay: int = 0
    cars_with_forecasts: int = 0
    takeover_s: float | None = None
    lost: int = 0


class Fleet:
    """Run a router and the consumers of all shards, and publish to them.

    Parameters
    ----------
    folder : Path
        Folder for the files of the consumers.
    start : callable
        Function that starts a consumer.
    count : int
        Number of shards.
    standbys : sequence of int
        Shards with a second consumer.
    """

    def __init__(self, folder: Path, start: Start, count: int, standbys: Sequence[int]) -> None:
        self.router = RouterProcess()
        self.node = self.router.join()
        self.received: list[tuple[float, str, str, bytes]] = []
        self.node.session.declare_subscriber("fleet/*/forecast", self._take)
        self.running: dict[tuple[int, int], tuple[Any, Path]] = {}
        for member in (0, 1):
            for shard in range(1, count + 1):
                if member == 0 or shard in standbys:
                    name = f"{shard}-{member}"
                    files = "--state", folder / f"{name}.state", "--record", folder / f"kept-{name}"
                    where = "--connect", self.router.endpoint, "--shard", f"{shard}/{count}"
                    self.running[shard, member] = start(*where, *["--standby"] * (shard in standbys), *files)

    def publish(self, messages: Sequence[Message], rate: float) -> Iterator[int]:
        """Publish messages in rounds at a rate [1/s], and yield the number of those that were published."""
        sink, place = ZenohSink(self.node), 0
        while place < len(messages):
            began = time.monotonic()
            until = messages[place].receipt_ns + int(ROUND_S * 1e9)
            end = place
            while end < len(messages) and messages[end].receipt_ns < until:
                end += 1
            sink.put(messages[place:end])
            yield end
            time.sleep(max(0.0, (end - place) / rate - (time.monotonic() - began)))
            place = end

    def kill_active(self, shard: Shard) -> float:
        """Kill the active consumer of a shard; return the time until the other one publishes. [s]"""
        mine = [each for each in self.received if shard.has(each[2])]
        old = mine[-1][1]
        pair = [self.running[shard.index, member] for member in (0, 1)]
        process = next(p for p, log in pair if any(old in str(e.get("token")) for e in logged(log)))
        seen, began = len(self.received), time.monotonic()
        process.send_signal(signal.SIGKILL)
        process.wait()

        def find_first() -> float | None:
            others = (at for at, zid, car, _ in self.received[seen:] if shard.has(car) and zid != old)
            return next(others, None)

        assert eventually(find_first)
        return (find_first() or 0.0) - began

    def end(self) -> list[dict[str, Any]]:
        """Stop the consumers that run; return the last counters of one consumer of each shard."""
        left = [process for process, _ in self.running.values() if process.poll() is None]
        for process in left:
            process.terminate()
        assert [process.wait(120) for process in left] == [0] * len(left)
        last = {
            shard: next(e for e in reversed(logged(log)) if e["event"] == "finished")
            for (shard, _), (process, log) in self.running.items()
            if process.returncode == 0
        }
        return list(last.values())

    def close(self) -> None:
        """End everything."""
        self.node.close()
        self.router.kill()

    def _take(self, sample: Any) -> None:
        zid, key = str(sample.source_info.source_id.zid), str(sample.key_expr)
        self.received.append((time.monotonic(), zid, key.split("/")[1], sample.payload.to_bytes()))


def make_night(path: Path, cars: int, before_s: float, after_s: float, seed: int = 3) -> list[Message]:
    """Return the messages of a simulated fleet around midnight UTC, the weather first.

    Nothing orders weather and samples on the way to two consumers, so that they may disagree for a few samples.

    Parameters
    ----------
    path : Path
        Recording to write.
    cars : int
        Number of cars.
    before_s, after_s : float
        Time before and after midnight. [s]
    seed : int
    """
    from socast import simulate_fleet  # noqa: PLC0415 - slow to import

    begin = datetime.fromtimestamp(MIDNIGHT_NS / 1e9 - before_s, UTC)
    simulate_fleet(path, vehicles=cars, shift_hours=(before_s + after_s) / 3600.0, start=begin, seed=seed)
    last = MIDNIGHT_NS + int(after_s * 1e9)
    messages = [m for batch in McapSource(path) for m in batch if m.receipt_ns < last]
    weather = [m._replace(receipt_ns=messages[0].receipt_ns) for m in messages if m.key.startswith("weather/")]
    return weather + [m for m in messages if not m.key.startswith("weather/")]


def run_shards(folder: Path, messages: Sequence[Message], count: int, *, kill: bool, rate: float) -> Outcome:
    """Publish messages to the consumers of all shards, and compare their forecasts with those of replays.

    Parameters
    ----------
    folder : Path
        Folder for the files of the consumers.
    messages : sequence of Message
    count : int
        Number of shards.
    kill : bool
        Whether the first shard has a standby, and its active consumer is killed after two thirds of the messages.
    rate : float
        Number of messages per second. [1/s]
    """
    outcome, began = Outcome(shards=count, messages=len(messages)), time.monotonic()
    with consumers(folder) as start:
        fleet = Fleet(folder, start, count, [1] if kill else [])
        try:
            for published in fleet.publish(messages, rate):
                if kill and outcome.takeover_s is None and published > len(messages) * 2 // 3:
                    outcome.takeover_s = round(fleet.kill_active(Shard(1, count)), 3)
            wait_until_quiet(fleet)
            outcome.lost = sum(int(line.get("lost", 0)) for line in fleet.end())
        finally:
            fleet.close()
    outcome.seconds = round(time.monotonic() - began, 1)
    compare(outcome, messages, fleet, count)
    return outcome


def wait_until_quiet(fleet: Fleet, seconds: float = 2.0) -> None:
    """Return once no forecast has come for some time."""
    seen, since = len(fleet.received), time.monotonic()
    while time.monotonic() - since < seconds:
        time.sleep(0.1)
        if len(fleet.received) > seen:
            seen, since = len(fleet.received), time.monotonic()


def compare(outcome: Outcome, messages: Sequence[Message], fleet: Fleet, count: int) -> None:
    """Compare the published forecasts with those of a pipeline for each shard that takes its messages alone."""
    reference: dict[tuple[str, bytes], int] = {}
    for shard in (Shard(index, count) for index in range(1, count + 1)):
        pipeline = Pipeline()
        mine = [m for m in messages if m.key.startswith("weather/") or shard.has(m.key.split("/")[1])]
        reference |= {(m.key.split("/")[1], m.payload): m.receipt_ns for m in pipeline.push(mine)}
        outcome.cars += len(pipeline.lanes)
        outcome.lost -= int(pipeline.decoder.losses.lost().sum())  # those that the loggers left out
    published = {(car, payload) for _, _, car, payload in fleet.received}
    outcome.cars_with_forecasts = len({car for car, _ in published})
    outcome.forecasts, outcome.forecasts_of_replay = len(published), len(reference)
    outcome.different = len(published - set(reference))
    outcome.forecasts_after_midnight = sum(reference.get(each, 0) >= MIDNIGHT_NS for each in published)


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(prog="python -m tests.support.shards", description=__doc__)
    parser.add_argument("--shards", type=int, default=4)
    parser.add_argument("--cars", type=int, default=200)
    parser.add_argument("--hours", type=float, default=2.0, help="half before midnight and half after it")
    parser.add_argument("--rate", type=float, default=3000.0, help="messages per second")
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--kill", action="store_true")
    options = parser.parse_args()
    with TemporaryDirectory() as made:
        half_s = 1800.0 * options.hours
        messages = make_night(Path(made) / "night.mcap", options.cars, half_s, half_s, options.seed)
        outcome = run_shards(Path(made), messages, options.shards, kill=options.kill, rate=options.rate)
    print(json.dumps(asdict(outcome)), flush=True)


if __name__ == "__main__":
    main()
    os._exit(0)
