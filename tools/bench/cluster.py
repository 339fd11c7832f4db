"""Measure tables by workers against serial ones: `python -m tools.bench.cluster --cars 1000 --hours 42`.

The recording holds copies of a simulated fleet: each copy has other names, and its messages come some seconds later.
Both commands run one after the other, each in processes of its own. One worker is killed in the middle.
"""

import argparse
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from heapq import merge
from math import ceil
from operator import attrgetter
from pathlib import Path
from typing import Any, Final, NamedTuple

import pyarrow.parquet as pq

from core.fit.ride_blocks import list_parts
from core.wire.messages import Message
from stream.mcap_reader import McapSource
from stream.mcap_writer import McapSink
from tools.cluster.run import REPORT
from tools.commands.tables import QUALITY, RIDES, WINDOWS

SIMULATED_CARS: Final = 100
"""Number of cars that are simulated; the others are copies."""
SHIFT_HOURS: Final = 8.0
DELAY_S: Final = 1.7
"""Time by which each copy comes after the one before. [s]"""
COMMAND: Final = [sys.executable, "-m", "tools.cli"]
BATCH: Final = 10_000


class Run(NamedTuple):
    """Hold what a command took: time, processor time of all its processes [s], and largest memory of one [B]."""

    wall_s: float
    cpu_s: float
    peak_bytes: int


def record_fleet(folder: Path, cars: int, hours: float) -> Path:
    """Write a recording of a fleet to a folder, if it is not there, and return it.

    Parameters
    ----------
    folder : Path
    cars : int
    hours : float
        Time for which each car sends samples. [h]
    """
    path = folder / f"fleet-{cars}-{hours:g}h.mcap"
    if path.exists():
        return path
    days, own = ceil(hours / SHIFT_HOURS), min(cars, SIMULATED_CARS)
    base = folder / f"base-{own}-{hours:g}h.mcap"
    given = ["--vehicles", str(own), "--days", str(days), "--shift-hours", f"{hours / days:g}"]
    subprocess.run([*COMMAND, "simulate", "--out", str(base), *given], check=True, stdout=subprocess.DEVNULL)  # noqa: S603
    copies = merge(*(_copy(base, number) for number in range(ceil(cars / own))), key=attrgetter("receipt_ns"))
    part = path.with_suffix(".part")
    with McapSink(part) as sink:
        messages: list[Message] = []
        for message in copies:
            messages.append(message)
            if len(messages) == BATCH:
                sink.put(messages)
                messages = []
        sink.put(messages)
    part.rename(path)
    base.unlink()
    return path


def _copy(base: Path, number: int) -> Iterator[Message]:
    """Yield the messages of a fleet with the names of a copy; the weather comes with the first copy only."""
    delay_ns = round(DELAY_S * number * 1e9)
    for messages in McapSource(base):
        for key, payload, receipt_ns in messages:
            if not key.startswith("fleet/"):
                if number == 0:
                    yield Message(key, payload, receipt_ns)
                continue
            vehicle = key.split("/")[1]
            name = f"{vehicle}-{number:03d}"
            renamed = payload.replace(f'"{vehicle}"'.encode(), f'"{name}"'.encode(), 1)
            yield Message(key.replace(vehicle, name, 1), renamed, receipt_ns + delay_ns)


def run_command(arguments: Sequence[str], out: Path, *, kill: bool) -> tuple[Run, int]:
    """Run a command; kill the process of the first task that cleans, if told so. Return what it took, and what died.

    Parameters
    ----------
    arguments : sequence of str
    out : Path
        Folder of the tables.
    kill : bool
    """
    before, began, killed, peak = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic(), 0, 0
    with subprocess.Popen([*COMMAND, *arguments], stdout=subprocess.DEVNULL) as process:  # noqa: S603
        while process.poll() is None:
            if kill and not killed and (begun := sorted(out.glob(".scratch-*/begun-clean-*"))):
                time.sleep(1.0)
                killed = int(begun[0].name.split("-")[3])
                os.kill(killed, signal.SIGKILL)
            peak = max(peak, _read_peak(process.pid))
            time.sleep(0.1)
    if process.returncode:
        raise SystemExit(f"{' '.join(arguments)} ended with {process.returncode}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Run(time.monotonic() - began, cpu_s, peak), killed


def _read_peak(process: int) -> int:
    """Return the largest memory that a process has had, zero after its end. [B]"""
    try:
        lines = Path(f"/proc/{process}/status").read_text("ascii").splitlines()
    except OSError:
        return 0
    return max((1024 * int(line.split()[1]) for line in lines if line.startswith("VmHWM")), default=0)


def list_differences(one: Path, other: Path) -> list[str]:
    """Return the columns of two tables that differ in a bit, and what else differs."""
    tables = [[pq.ParquetFile(part) for part in list_parts(table)] for table in (one, other)]
    names, others = (parts[0].schema_arrow.names for parts in tables)
    if names != others:
        return ["names of columns"]
    return [name for name in names if _read_bytes(tables[0], name) != _read_bytes(tables[1], name)]


def _read_bytes(parts: Sequence[Any], name: str) -> bytes | list[Any]:
    """Return a column: numbers as bytes, text as a list."""
    columns = [part.read([name]).column(0) for part in parts]
    if columns[0].type in {"string", "large_string"} or str(columns[0].type).endswith("string"):
        return [value for column in columns for value in column.to_pylist()]
    return b"".join(column.to_numpy().tobytes() for column in columns)


def measure(folder: Path, cars: int, hours: float, workers: int, worker_memory: float) -> dict[str, Any]:
    """Return what tables of a fleet take, serially and by workers, and whether they are equal."""
    recording = record_fleet(folder, cars, hours)
    serial, parallel = folder / "serial", folder / "parallel"
    for out in (serial, parallel):
        out.mkdir(exist_ok=True)
    given = ["tables", str(recording), "--out"]
    options = ["--cluster", f"local:{workers}", "--worker-memory", f"{worker_memory:g}"]
    by_workers, killed = run_command([*given, str(parallel), *options], parallel, kill=True)
    alone, _ = run_command([*given, str(serial)], serial, kill=False)
    report = json.loads((parallel / REPORT).read_text("utf-8"))
    quality = [json.loads((out / QUALITY).read_text("utf-8")) for out in (serial, parallel)]
    different = {name: list_differences(serial / name, parallel / name) for name in (RIDES, WINDOWS)}
    stages: dict[str, float] = {}
    for task in report["tasks"]:
        stages[task["stage"]] = stages.get(task["stage"], 0.0) + task["cpu_s"]
    return {
        "cars": cars,
        "samples": quality[0]["received"]["telemetry"],
        "recording_bytes": recording.stat().st_size,
        "serial": alone._asdict(),
        "workers": workers,
        "by_workers": by_workers._asdict(),
        "ratio": alone.wall_s / by_workers.wall_s,
        "ratio_of_cpu": alone.cpu_s / by_workers.cpu_s,
        "cpu_s_of_stages": stages,
        "peak_bytes_of_workers": {name: each["peak_bytes"] for name, each in report["processes"].items()},
        "killed_process": killed,
        "repeated_tasks": report["repeated_tasks"],
        "different_columns": different,
        "equal": not any(different.values()) and quality[0] == quality[1],
    }


def main() -> None:
    """Print the measures as JSON; the exit code is 1 where tables differ."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cars", type=int, default=1000)
    parser.add_argument("--hours", type=float, default=42.0, help="time for which each car sends samples [h]")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--worker-memory", type=float, default=2.0, help="[GB]")
    parser.add_argument("--folder", type=Path, help="where recording and tables are kept; by default nothing is kept")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = given.folder or Path(temporary)
        folder.mkdir(exist_ok=True)
        result = measure(folder, given.cars, given.hours, given.workers, given.worker_memory)
    print(json.dumps(result, indent=2))
    sys.exit(0 if result["equal"] else 1)


if __name__ == "__main__":
    main()
