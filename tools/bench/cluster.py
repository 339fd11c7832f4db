"""Measure commands by workers with serial ones: `python -m socast.tools.bench.cluster --cars 9 --hours 9 --folder DIR`.

The measure simulates a fleet by workers, and makes its tables three times: by workers, serially, and by workers of
which one is killed. It then fits a model and evaluates recipes both ways, and simulates a few cars both ways. Commands
run one after the other, each in processes of its own, and their progress bars go to standard error. The recording stays
in the folder, and a later run with the same cars and hours uses it.
"""

import argparse
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from math import ceil
from pathlib import Path
from typing import Any, Final, NamedTuple

import pyarrow.parquet as pq

from socast.core.fit.ride_blocks import list_parts
from socast.tools.cluster.run import REPORT
from socast.tools.cluster.simulation import TRUTH
from socast.tools.terminal.ride_source import RIDES, WINDOWS
from socast.tools.terminal.table_files import QUALITY

LONGEST_SHIFT_H: Final = 8.0
SAMPLES_PER_HOUR: Final = 1200
BYTES_PER_SAMPLE: Final = 300
"""Room that the measure needs: recording, the waiting messages of cars, and intermediate files of tables. [B]"""
FEW_CARS: Final = 8
"""Number of cars that are simulated both ways."""
RECIPE: Final = "hybrid"
EVALUATED: Final = ("--recipes", "basic_physical,fitted_physical", "--repeats", "2")
COMMAND: Final = [sys.executable, "-m", "socast"]


class Run(NamedTuple):
    """Hold what a command took: time, processor time of all its processes [s], and largest memory of one [B]."""

    wall_s: float
    cpu_s: float
    peak_bytes: int


class Plan(NamedTuple):
    """Hold the arguments of a measure."""

    folder: Path
    cars: int
    hours: float
    workers: int
    worker_memory: float

    def list_options(self) -> list[str]:
        """Return the options of a command by workers."""
        return ["--cluster", f"local:{self.workers}", "--worker-memory", f"{self.worker_memory:g}"]


def run_command(arguments: Sequence[object], watched: Path | None = None) -> tuple[Run, int]:
    """Run a command, and return what it took, and the process that was killed."""
    words = list(map(str, arguments))
    print(f"$ socast {' '.join(words)}", file=sys.stderr, flush=True)
    before, began, killed, peak = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic(), 0, 0
    with subprocess.Popen([*COMMAND, *words], stdout=subprocess.DEVNULL) as process:  # noqa: S603
        while process.poll() is None:
            if watched and not killed and (begun := sorted(watched.glob(".scratch-*/begun-clean-*"))):
                time.sleep(1.0)
                killed = int(begun[0].name.split("-")[3])
                os.kill(killed, signal.SIGKILL)
            peak = max(peak, _read_peak(process.pid))
            time.sleep(0.1)
    if process.returncode:
        raise SystemExit(f"{' '.join(words)} ended with {process.returncode}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    run = Run(time.monotonic() - began, cpu_s, peak)
    print(
        f"  {run.wall_s:,.1f} s, {run.cpu_s:,.1f} s of CPU, {run.peak_bytes / 1e9:.2f} GB", file=sys.stderr, flush=True
    )
    return run, killed


def _read_peak(process: int) -> int:
    """Return the largest memory that a process has had, zero after its end. [B]"""
    try:
        lines = Path(f"/proc/{process}/status").read_text("ascii").splitlines()
    except OSError:
        return 0
    return max((1024 * int(line.split()[1]) for line in lines if line.startswith("VmHWM")), default=0)


def record_fleet(plan: Plan) -> tuple[Path, Run | None]:
    """Return the recording of a fleet, and what it took to simulate it, None if it was there."""
    path = plan.folder / f"fleet-{plan.cars}-{plan.hours:g}h.mcap"
    if path.exists():
        return path, None
    days = ceil(plan.hours / LONGEST_SHIFT_H)
    part = path.with_suffix(".part.mcap")
    size = ["--vehicles", plan.cars, "--days", days, "--shift-hours", f"{plan.hours / days:g}"]
    run, _ = run_command(["simulate", "--out", part, *size, *plan.list_options()])
    part.with_suffix(TRUTH).unlink()
    part.rename(path)
    return path, run


def measure_tables(plan: Plan, recording: Path) -> dict[str, Any]:
    """Return what tables take serially, by workers, and while one is killed, and whether they are equal."""
    outs = [plan.folder / name for name in ("by-workers", "serial", "one-killed")]
    for out in outs:
        out.mkdir(exist_ok=True)
    by_workers, serial, one_killed = outs
    fast, _ = run_command(["tables", recording, "--out", by_workers, *plan.list_options()])
    alone, _ = run_command(["tables", recording, "--out", serial])
    lamed, killed = run_command(["tables", recording, "--out", one_killed, *plan.list_options()], one_killed)
    quality = [json.loads((out / QUALITY).read_text("utf-8")) for out in outs]
    different = {
        f"{out.name}/{name}": list_differences(serial / name, out / name)
        for out in (by_workers, one_killed)
        for name in (RIDES, WINDOWS)
    }
    report, report_of_lamed = (json.loads((out / REPORT).read_text("utf-8")) for out in (by_workers, one_killed))
    stages = Counter[str]()
    for task in report["tasks"]:
        stages[task["stage"]] += task["cpu_s"]
    return {
        "samples": quality[1]["received"]["telemetry"],
        "recording_bytes": recording.stat().st_size,
        "serial": alone._asdict(),
        "by_workers": fast._asdict(),
        "ratio": alone.wall_s / fast.wall_s,
        "ratio_of_cpu": alone.cpu_s / fast.cpu_s,
        "cpu_s_of_stages": dict(stages),
        "peak_bytes_of_workers": {name: each["peak_bytes"] for name, each in report["processes"].items()},
        "one_killed": lamed._asdict() | {"process": killed, "repeated_tasks": report_of_lamed["repeated_tasks"]},
        "different_columns": different,
        "equal": not any(different.values()) and quality[0] == quality[1] == quality[2],
    }


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


def compare_both_ways(plan: Plan, arguments: Sequence[object], option: str, suffix: str) -> dict[str, Any]:
    """Return what a command takes serially and by workers, and whether its files are equal."""
    name = str(arguments[0])
    paths = [plan.folder / f"{name}-{how}{suffix}" for how in ("serial", "by-workers")]
    alone, _ = run_command([*arguments, option, paths[0]])
    fast, _ = run_command([*arguments, option, paths[1], *plan.list_options()])
    contents = [_drop_seconds(path) if name == "evaluate" else path.read_bytes() for path in paths]
    return {"serial": alone._asdict(), "by_workers": fast._asdict(), "equal": contents[0] == contents[1]}


def _drop_seconds(path: Path) -> Any:
    """Return an evaluation without the time that it took."""
    result = json.loads(path.read_text("utf-8"))
    del result["about"]["seconds"]
    return result


def measure(plan: Plan) -> dict[str, Any]:
    """Return what all commands take, serially and by workers, and whether their results are equal."""
    recording, simulated = record_fleet(plan)
    result: dict[str, Any] = {"cars": plan.cars, "hours": plan.hours, "workers": plan.workers}
    result["simulate_all"] = simulated and simulated._asdict()
    result["tables"] = measure_tables(plan, recording)
    tables = plan.folder / "by-workers"
    result["fit"] = compare_both_ways(plan, ["fit", tables, "--recipe", RECIPE], "--out", ".json")
    result["evaluate"] = compare_both_ways(plan, ["evaluate", tables, *EVALUATED], "--json", ".json")
    few = ["simulate", "--vehicles", min(plan.cars, FEW_CARS), "--shift-hours", min(plan.hours, LONGEST_SHIFT_H)]
    result["simulate_few"] = compare_both_ways(plan, few, "--out", ".mcap")
    parts = ("tables", "fit", "evaluate", "simulate_few")
    return result | {"equal": all(result[part]["equal"] for part in parts)}


def check_room(plan: Plan) -> None:
    """Say how much room the measure needs, and end if the folder has less."""
    needed = plan.cars * plan.hours * SAMPLES_PER_HOUR * BYTES_PER_SAMPLE / 1e9
    free = shutil.disk_usage(plan.folder).free / 1e9
    print(f"{plan.folder}: needs up to {needed:,.1f} GB, {free:,.1f} GB are free", file=sys.stderr)
    if free < needed:
        raise SystemExit("choose another --folder, fewer --cars or fewer --hours")


def main() -> None:
    """Print the measures as JSON; the exit code is 1 where results differ."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cars", type=int, default=1000)
    parser.add_argument("--hours", type=float, default=42.0, help="time for which each car sends samples [h]")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--worker-memory", type=float, default=2.0, help="[GB]")
    parser.add_argument("--folder", type=Path, help="where recording and results are kept; by default nothing is kept")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = (given.folder or Path(temporary)).resolve()
        folder.mkdir(exist_ok=True)
        plan = Plan(folder, given.cars, given.hours, given.workers, given.worker_memory)
        check_room(plan)
        result = measure(plan)
        text = json.dumps(result, indent=2)
        (folder / "measures.json").write_text(text + "\n", "utf-8")
    print(text)
    sys.exit(0 if result["equal"] else 1)


if __name__ == "__main__":
    main()
