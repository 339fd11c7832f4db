"""Send lists of 1 MB faster than a live consumer can take them, and measure its memory, its stop and what it counts.

`python -m tests.support.overload --seconds 60 --times 3` first measures the rate that the consumer takes from a
publisher that waits. It then sends at a multiple of this rate, with publishers that drop what the network does not
take. At the end it sends SIGTERM while lists are still queued. The result is one JSON object.
"""

import argparse
import json
import os
import re
import signal
import subprocess
import sys
import time
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import psutil
import zenoh

from socast.stream.zenoh_session import Connection, Node, find_free_port
from tests.support.commands import SOCAST
from tests.support.zenoh_sessions import eventually

CARS = 20
SAMPLES = 4000
"""Samples in a list; a sample takes 250 bytes."""
START_S = 1_700_000_000
_PADDING = "x" * 70


class Lists:
    """Make lists of the samples of one car, each with the next times and sequence numbers.

    Parameters
    ----------
    car : str
        Name of the car.
    """

    def __init__(self, car: str) -> None:
        self.key = f"fleet/{car}/telemetry"
        self.sent = 0
        sample = (
            f'{{"vehicle_id":"{car}","time_s":{START_S:010d}.0,"seq":1000000000,"latitude_deg":45.5,"longitude_deg":-73.6,'
            f'"speed_kmh":0.0,"soc_pct":80.0,"ambient_c":-5.0,"note":"{_PADDING}"}}'
        )
        self._row = np.frombuffer((sample + ",").encode(), np.uint8)
        self._time_at = sample.index('"time_s":') + 9
        self._seq_at = sample.index('"seq":') + 6

    def make(self) -> bytes:
        """Return the next list."""
        rows = np.tile(self._row, (SAMPLES, 1))
        numbers = self.sent * SAMPLES + np.arange(SAMPLES)
        for at, values in ((self._time_at, START_S + 3 * numbers), (self._seq_at, 1_000_000_000 + numbers)):
            for digit in range(10):
                rows[:, at + 9 - digit] = values // 10**digit % 10 + ord("0")
        self.sent += 1
        return b"[" + rows.tobytes()[:-1] + b"]"


def publish(endpoint: str, rate: float, seconds: float, name: str) -> None:
    """Publish lists of cars at a rate, or as fast as they are taken if it is 0; print how many lists were made."""
    drop, block = zenoh.CongestionControl.DROP, zenoh.CongestionControl.BLOCK
    with Node(Connection(connect=(endpoint,))) as node:
        lists = [Lists(f"{name}-{i}") for i in range(CARS)]
        publishers: list[Any] = [
            node.session.declare_publisher(each.key, congestion_control=drop if rate else block) for each in lists
        ]
        began, count = time.monotonic(), 0
        while time.monotonic() - began < seconds:
            publishers[count % CARS].put(lists[count % CARS].make())
            count += 1
            if rate:
                time.sleep(max(0.0, began + count / rate - time.monotonic()))
        print(count, flush=True)
        sys.stdin.readline()


@dataclass
class Overload:
    """Hold what was measured.

    Parameters
    ----------
    capacity : float
        Lists per second that the consumer takes. [1/s]
    sent_per_s : float
        Lists per second that were sent. [1/s]
    sent, taken, lost : int
        Samples of the fast cars that were sent, were taken, and were told as lost.
    dropped : int
        Samples of the fast cars that were dropped and counted after SIGTERM.
    unseen : int
        Other samples after the last ones taken, of which no later sample can tell that they are lost.
    before_mb, most_mb : float
        Resident memory before the overload, and the largest afterwards. [MB]
    stop_s : float
        Time from SIGTERM to the end of the process. [s]
    exit_code : int
    """

    capacity: float
    sent_per_s: float
    sent: int
    taken: int
    lost: int
    dropped: int
    unseen: int
    before_mb: float
    most_mb: float
    stop_s: float
    exit_code: int


def run_overload(folder: Path, *, seconds: float, times: int) -> Overload:
    """Measure the capacity of a consumer, overload it, and stop it.

    Parameters
    ----------
    folder : Path
        Folder for the log.
    seconds : float
        Time of the overload. [s]
    times : int
        Number of publishers, each of which sends at the rate that the consumer can take.
    """
    endpoint, log = f"tcp/127.0.0.1:{find_free_port()}", folder / "live.log"
    state = folder / "fleet.state"
    arguments = ["live", "--listen", endpoint, "--state", state, "--json-log", "--report", "1"]
    with log.open("w") as errors:
        consumer = subprocess.Popen([*SOCAST, *map(str, arguments)], stdout=subprocess.DEVNULL, stderr=errors)
        try:
            assert eventually(lambda: "listening" in log.read_text()), log.read_text()
            process = psutil.Process(consumer.pid)
            settle_s = min(10.0, seconds)
            with _open_publisher(endpoint, 0.0, settle_s, "slow") as slow:
                count = int(slow.stdout.readline())
                assert eventually(lambda: _read_counts(log).get("received.telemetry", 0) >= count * SAMPLES)
                slow.communicate("\n")
            before, capacity = process.memory_info().rss, count / settle_s
            most = before
            with ExitStack() as ending:
                fast = [
                    ending.enter_context(_open_publisher(endpoint, capacity, seconds, f"fast-{number}"))
                    for number in range(times)
                ]
                deadline = time.monotonic() + seconds
                while time.monotonic() < deadline:
                    most = max(most, process.memory_info().rss)
                    time.sleep(0.1)
                began = time.monotonic()
                consumer.send_signal(signal.SIGTERM)
                exit_code = consumer.wait(60.0)
                stop_s = time.monotonic() - began
                sent = sum(int(each.stdout.readline()) for each in fast)
                for each in fast:
                    each.communicate("\n")
        finally:
            consumer.kill()
    counts = _read_counts(log)
    taken = int(counts["received.telemetry"]) - count * SAMPLES
    lost = int(counts.get("lost", 0))
    told = re.search(r"(\d+) messages dropped", log.read_text())
    dropped = int(told[1]) * SAMPLES if told else 0
    return Overload(
        capacity,
        sent / seconds,
        sent * SAMPLES,
        taken,
        lost,
        dropped,
        sent * SAMPLES - taken - lost - dropped,
        before / 1e6,
        most / 1e6,
        stop_s,
        exit_code,
    )


def _open_publisher(endpoint: str, rate: float, seconds: float, name: str) -> Any:
    """Start a process that publishes."""
    arguments = [sys.executable, "-m", "tests.support.overload", "--publish", endpoint, str(rate), str(seconds), name]
    return subprocess.Popen(arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def _read_counts(log: Path) -> dict[str, Any]:
    """Return the newest counters in the log."""
    lines = [line for line in log.read_text().splitlines() if '"received.telemetry"' in line]
    return dict(json.loads(lines[-1])) if lines else {}


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(prog="python -m tests.support.overload", description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--times", type=int, default=3)
    parser.add_argument("--publish", nargs=4, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.publish:
        endpoint, rate, seconds, name = options.publish
        publish(endpoint, float(rate), float(seconds), name)
        return
    with TemporaryDirectory() as made:
        result = run_overload(Path(made), seconds=options.seconds, times=options.times)
    print(json.dumps(asdict(result), indent=2), flush=True)


if __name__ == "__main__":
    main()
    os._exit(0)
