"""The golden record: a digest of everything the product computes from three recordings.

The record holds one entry per column of every table, forecast stream, model file and JSON report. An entry has a hash
of the exact values and, for numbers, their count and two sums. `python -m tests.support.golden_record` prints how the
record differs from the code; `--renew` writes it anew. A commit that renews it says which entries changed and why.

Numpy and OpenBLAS select their routines by the processor, and the routines differ in the last digits. The record is
therefore made in a process of its own that is restricted to the routines that every processor with AVX2 has.
"""

import argparse
import hashlib
import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterable
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd

from socast.stream.mcap_reader import McapSource
from socast.tools.cli import main as socast

ROOT: Final = Path(__file__).parents[2]
RECORD: Final = ROOT / "tests" / "laws" / "golden_record.json"
TOLERANCE: Final = 1e-9
"""Relative difference of two sums of a table or a forecast that another processor's arithmetic may cause."""
FITTED_TOLERANCE: Final = 1e-3
"""The same for fitted models and reports on them: an iterative fit stops at another last digit."""
FITTED: Final = ("model", "evaluate", "compare", "diagnose", "added")
"""Words that begin the names of the sections with fitted models, after the name of the recording."""
OF_EXACT_BITS: Final = ("payloads", "version (text)")
"""Ends of the entries that hash the last digits of numbers; only their counts hold on another processor."""
COMMON_ROUTINES: Final = {
    "OPENBLAS_CORETYPE": "Haswell",
    "OPENBLAS_NUM_THREADS": "1",
    "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR",
}
"""Environment in which numpy and OpenBLAS use the same routines on every x86-64 processor with AVX2."""
FLEET: Final = ("--vehicles", "3", "--days", "12", "--shift-hours", "2", "--seed", "5", "--charging", "night")
"""The simulated fleet, whose dispatch sends plans."""

NOT_REPEATABLE: Final = frozenset({"about.seconds"})
"""Paths of reports that differ between two runs of the same code."""

NUMBERS: Final = frozenset({int, float})
"""Types of numbers; truth values are none."""

Entry = dict[str, Any]
Record = dict[str, dict[str, Entry]]


def run(*arguments: object) -> None:
    """Run a command of the product in this process, without its output.

    Raises
    ------
    RuntimeError
        Where the command fails, with what it printed.
    """
    out, error = StringIO(), StringIO()
    with redirect_stdout(out), redirect_stderr(error):
        try:
            socast([str(argument) for argument in arguments])
        except SystemExit as ended:
            if ended.code:
                raise RuntimeError(f"socast {arguments} failed: {error.getvalue()}") from ended


def digest(values: Iterable[Any]) -> Entry:
    """Return the entry of one column: the hash of its values and, for numbers, their count and sums."""
    column = list(values)
    numbers = [value for value in column if type(value) in NUMBERS]
    text = json.dumps([value.hex() if type(value) is float else value for value in column], default=str)
    entry: Entry = {"hash": hashlib.sha256(text.encode()).hexdigest()[:12], "rows": len(column)}
    finite = np.array([value for value in numbers if np.isfinite(value)], dtype=float)
    if len(finite):
        place = np.cos(np.arange(len(finite)))  # a second sum, which an exchange of two values changes
        sums = float(np.abs(finite).sum()), float((place * finite).sum())
        entry |= {"sum": float(f"{sums[0]:.12g}"), "mixed": float(f"{sums[1]:.12g}")}
    return entry


def of_json(*values: Any, folder: Path | None = None) -> dict[str, Entry]:
    """Return the entries of JSON values, one for each path; text has a path of its own, without `folder`."""
    columns: dict[str, list[Any]] = defaultdict(list)
    for value in values:
        _collect_leaves(value, "", columns)
    out = {}
    for path, column in columns.items():
        if path not in NOT_REPEATABLE:
            texts = [leaf.replace(f"{folder}/", "") for leaf in column if type(leaf) is str]
            others = [leaf for leaf in column if type(leaf) is not str] if texts else column
            out |= {f"{path} (text)": digest(texts)} if texts else {}
            out |= {path: digest(others)} if others else {}
    return out


def _collect_leaves(value: Any, path: str, columns: dict[str, list[Any]]) -> None:
    """Append each leaf of a JSON value to the column of its path; all places of an array share one path."""
    kind = type(value)
    if kind is dict:
        for name, each in value.items():
            _collect_leaves(each, f"{path}.{name}" if path else name, columns)
    elif kind is list:
        for each in value:
            _collect_leaves(each, f"{path}[]", columns)
    else:
        columns[path].append(value)


def of_table(path: Path) -> dict[str, Entry]:
    """Return the entries of a Parquet table, one for each column."""
    table = pd.read_parquet(path)
    return {name: digest(table[name].tolist()) for name in table.columns}


def of_forecasts(path: Path) -> dict[str, Entry]:
    """Return the entries of the forecasts that a recording holds; the payloads' bytes are one more entry."""
    payloads = [
        message.payload for messages in McapSource(path) for message in messages if message.key.endswith("/forecast")
    ]
    return {"payloads": digest(p.decode() for p in payloads)} | of_json(*map(json.loads, payloads))


def made(folder: Path) -> Record:
    """Run the product on the three recordings and return the record.

    Parameters
    ----------
    folder : Path
        An empty folder, for the files that the commands write.
    """
    fleet = folder / "fleet.mcap"
    run("simulate", "--out", fleet, *FLEET)
    recordings = {"shift": ROOT / "recordings/shift.mcap", "autumn": ROOT / "recordings/autumn.mcap", "fleet": fleet}
    record: Record = {}
    for name, recording in recordings.items():
        tables, forecasts, report = folder / name, folder / f"{name}.forecasts.mcap", folder / f"{name}.replay.json"
        beside = folder / recording.name
        if beside != recording:
            shutil.copy(recording, beside)  # so that its path from the tables is the same in every checkout
        run("tables", beside, "--out", tables)
        run("replay", recording, "--out", forecasts, "--json", report)
        record[f"{name}: rides"] = of_table(tables / "rides.parquet")
        record[f"{name}: windows"] = of_table(tables / "windows.parquet")
        record[f"{name}: quality"] = of_json(json.loads((tables / "quality.json").read_text()))
        record[f"{name}: forecasts"] = of_forecasts(forecasts)
        record[f"{name}: replay"] = of_json(json.loads(report.read_text()))
    autumn = folder / "autumn"
    for recipe in ("road_load", "fitted_physical", "hybrid_interactions", "pooled_hybrid", "boosted_hybrid"):
        run("fit", autumn, "--recipe", recipe, "-o", folder / f"{recipe}.json")
        record[f"autumn: model {recipe}"] = of_json(json.loads((folder / f"{recipe}.json").read_text()))
    base = folder / "road_load.json"
    reports = {
        "autumn: evaluate": ("evaluate", autumn, "--repeats", "2", "--jobs", "1"),
        "autumn: compare": ("compare", autumn, "--model", base, "--model", "extended_physical"),
        "shift: compare ride": ("compare", recordings["shift"], "--model", "basic_physical", "--ride", "taxi-005#1"),
        "autumn: diagnose": ("diagnose", autumn, "--model", base),
        "fleet: evaluate-soc": ("evaluate-soc", fleet),
    }
    for name, command in reports.items():
        report = folder / "report.json"
        run(*command, "--json", report)
        record[name] = of_json(json.loads(report.read_text()), folder=folder)
    run("add", "headwind", autumn, "--model", base, "-o", folder / "better.json")
    record["autumn: added"] = of_json(json.loads((folder / "better.json").read_text()))
    return record


def close(section: str, column: str, kept: Entry, new: Entry) -> bool:
    """Tell whether two entries of a column differ by no more than another processor's arithmetic."""
    if kept["rows"] == new["rows"] and column.endswith(OF_EXACT_BITS):
        return True
    if kept["rows"] != new["rows"] or ("sum" in kept) != ("sum" in new) or "sum" not in kept:
        return False
    is_fitted = section.partition(": ")[2].startswith(FITTED)
    scale = (FITTED_TOLERANCE if is_fitted else TOLERANCE) * max(abs(kept["sum"]), abs(new["sum"]))
    return abs(kept["sum"] - new["sum"]) <= scale and abs(kept["mixed"] - new["mixed"]) <= scale


def differences(kept: Record, new: Record, *, exact: bool) -> list[str]:
    """Return one line for each entry that differs.

    Parameters
    ----------
    kept, new : dict
        Records, as `made` returns them.
    exact : bool
        Report every entry whose hash differs; otherwise only those whose sums differ too.
    """
    lines = []
    for name in dict.fromkeys((*kept, *new)):
        before, after = kept.get(name, {}), new.get(name, {})
        for column in dict.fromkeys((*before, *after)):
            old, now = before.get(column), after.get(column)
            if old is None or now is None:
                lines.append(f"{name}: {column}: {'new' if old is None else 'gone'}")
            elif old["hash"] != now["hash"] and (exact or not close(name, column, old, now)):
                lines.append(f"{name}: {column}: {old} became {now}")
    return lines


def kept() -> Record:
    """Return the record that is kept beside the tests."""
    return json.loads(RECORD.read_text(encoding="utf-8")) if RECORD.exists() else {}


def run_with_common_routines(*options: str) -> "subprocess.CompletedProcess[str]":
    """Run this module in a process that uses the common routines, and capture what it prints.

    Parameters
    ----------
    *options : str
        Options of `main`.
    """
    routines = COMMON_ROUTINES if platform.machine() == "x86_64" else {}
    command = [sys.executable, "-W", "ignore", "-m", "tests.support.golden_record", "--here", *options]
    return subprocess.run(command, cwd=ROOT, env=os.environ | routines, capture_output=True, text=True, check=False)


def main() -> None:
    """Print how the record differs from the code; with `--renew` write it anew."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--renew", action="store_true", help="write the record anew after printing the differences")
    parser.add_argument("--tolerant", action="store_true", help="ignore differences by another processor's arithmetic")
    parser.add_argument("--here", action="store_true", help="use the routines that this processor selects")
    options = parser.parse_args()
    if not options.here:
        result = run_with_common_routines(*sys.argv[1:])
        sys.stdout.write(result.stdout)
        sys.stderr.write(result.stderr)
        sys.exit(result.returncode)
    with tempfile.TemporaryDirectory() as folder:
        new = made(Path(folder))
    lines = differences(kept(), new, exact=not options.tolerant)
    print("\n".join(lines) if lines else f"nothing differs{'' if options.tolerant else ', to the bit'}")
    if options.renew:
        entries = {name: dict(sorted(columns.items())) for name, columns in new.items()}
        RECORD.write_text(_readable(entries), encoding="utf-8")
    sys.exit(1 if lines and not options.renew else 0)


def _readable(record: Record) -> str:
    """Return the record as JSON with one entry a line."""
    parts = []
    for name, columns in record.items():
        rows = ",\n".join(f"  {json.dumps(column)}: {json.dumps(entry)}" for column, entry in columns.items())
        parts.append(f"{json.dumps(name)}: {{\n{rows}\n}}")
    return "{\n" + ",\n".join(parts) + "\n}\n"


if __name__ == "__main__":
    main()
