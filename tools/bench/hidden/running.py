"""Diagnose data sets in parallel processes, each of which handles the drives of one seed at a time."""

import json
import os
from collections.abc import Iterable, Sequence
from functools import lru_cache
from itertools import groupby
from pathlib import Path
from typing import Any, Final

from joblib import Parallel, delayed, parallel_config
from threadpoolctl import threadpool_limits

from socast.core.errors import SocastError
from socast.tools.bench.hidden.cases import Case, SeedData
from socast.tools.bench.hidden.evaluation import Diagnose, Record, describe_case, evaluate_case

PROCESSES: Final = 2
TIMED: Final = 20
"""One data set out of this many is timed against sparse regression."""
Task = tuple[str, list[Case]]


def make_tasks(part: str, cases: Sequence[Case]) -> list[Task]:
    """Return the data sets of a part by seed."""
    ordered = sorted(cases, key=lambda case: case.seed)
    return [(part, list(same)) for _, same in groupby(ordered, key=lambda case: case.seed)]


def run_tasks(
    todo: Iterable[Task], diagnose: Diagnose, keep: Path | None = None, processes: int = PROCESSES
) -> Iterable[list[Record]]:
    """Yield the records of each task when it is finished."""
    with parallel_config(backend="loky", inner_max_num_threads=1):
        jobs = (delayed(run_cases)(part, cases, diagnose, keep) for part, cases in todo)
        yield from Parallel(n_jobs=processes, return_as="generator_unordered")(jobs)


def run_cases(part: str, cases: Sequence[Case], diagnose: Diagnose, keep: Path | None = None) -> list[Record]:
    """Return the records of data sets of one seed."""
    path = None if keep is None else keep / f"{part}-{cases[0].seed}.json"
    known = _read(path)
    records = []
    with threadpool_limits(limits=1):
        for number, case in enumerate(cases):
            key = json.dumps(describe_case(case))
            if key not in known:
                known[key] = {"part": part, **_record(case, diagnose, timed=number % TIMED == 0)}
                if path is not None and (number % TIMED == 0 or number == len(cases) - 1):
                    _write(path, known)
            records.append(known[key])
    return records


def _record(case: Case, diagnose: Diagnose, *, timed: bool) -> Record:
    """Return the record of a data set, or the reason why it cannot be made."""
    try:
        return evaluate_case(case, _source(case.seed).tables(case), diagnose, timed=timed)
    except SocastError as error:
        return {**describe_case(case), "refused": str(error)}


@lru_cache(maxsize=1)
def _source(seed: int) -> SeedData:
    """Return the drives of a seed; only one is kept because each takes some gigabytes."""
    return SeedData(seed)


def _read(path: Path | None) -> dict[str, Any]:
    """Return the records of a file by the description of their data set."""
    if path is None or not path.exists():
        return {}
    records: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return records


def _write(path: Path, records: dict[str, Any]) -> None:
    """Write records atomically."""
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_suffix(f".{os.getpid()}")
    beside.write_text(json.dumps(records) + "\n", encoding="utf-8")
    beside.replace(path)
