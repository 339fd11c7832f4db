"""Diagnose data sets in parallel processes, or write them as Parquet files with a card, to judge other methods."""

import json
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from itertools import groupby
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import numpy as np
import pandas as pd
from joblib import Parallel, delayed, parallel_config
from threadpoolctl import threadpool_limits

from socast.core import effects
from socast.core.diagnose.candidates import Candidates, build_candidates
from socast.core.diagnose.dataset import Windows, gather_windows
from socast.core.diagnose.projection import BaseProjection
from socast.core.errors import SocastError
from socast.core.fit.block_sums import build_design
from socast.core.fit.recipes import fit_to_windows
from socast.core.models import ANY, LinearModel
from socast.core.models.features import Columns
from socast.tools.bench.hidden.cases import ABSORBED, Case, SeedData
from socast.tools.bench.hidden.evaluation import (
    RATIO,
    Diagnose,
    Record,
    compute_true_energy,
    describe_case,
    evaluate_case,
    list_truths,
    measure_visibility,
)
from socast.tools.bench.hidden.judge import GOALS
from socast.tools.simulator.hidden import EFFECTS
from socast.tools.simulator.hidden_shapes import get_right_names, strip_shape

PROCESSES: Final = 2
TIMED: Final = 20
"""One data set out of this many is timed against sparse regression."""
Task = tuple[str, list[Case]]
CASES: Final = "cases.json"
TRUTH: Final = "truth.json"
PUBLIC: Final = ("measurement", "weather", "recipe")
"""Entries of the description of a data set that do not tell its truth."""
SEED: Final = 13
CONDITIONS: Final = MappingProxyType(
    {
        "ride": "number of the ride",
        "vehicle": "number of the car",
        "vehicle_model": "vehicle model",
        "day": "number of the vehicle-day; errors of different vehicle-days are independent",
        "start_s": "start of the window, seconds since 1970 [s]",
        "duration_s": "duration [s]",
        "average_speed_kmh": "mean speed [km/h]",
        "ambient_c": "outside temperature [°C]",
    }
)
"""Columns of a window besides energies."""
CARD: Final = """\
# Hidden effects in the energy of electric cars

{count} simulated data sets: {parts}.
In each, the energy of a small fleet holds an effect that the base model lacks, two of them, or none. The task: name the
missing effect from the measured energy.

## Files

- `cases.json`: description of each data set without its truth.
- `windows/NAME.parquet`: the windows of a data set. With voltage and current (`vi`) a window is about one minute, with
  the state of charge only (`soc`) a whole ride.
- `truth.json` and `truth/NAME.parquet`: what is hidden, its right names, and its energy in each window [kWh]. Only the
  judge may read them.

## Columns of the windows

| column | meaning |
|---|---|
{conditions}
| `measured_kwh` | measured energy [kWh] |
| `predicted_kwh` | energy that the base model predicts [kWh] |
| `base_TERM` | energy of a term of the base model [kWh per unit of its coefficient] |
| `effect_VARIANT` | energy of a candidate effect [kWh per unit of its coefficient] |

A candidate may have several variants, `EFFECT@PARAMETER=VALUE`. The answer is the name of the effect. Every data set
lacks the candidates of one effect at random, so a missing column says nothing about the truth. Cars whose base model is
`road_load_constant` have no climate control, and only heating or cooling of the cabin is hidden in them; a method must
not use that.

| effect | unit of the coefficient | power |
|---|---|---|
{effects}

## How it was made

A simulator drives 8 cars of 2 models on 39 days each over ten months, with weather, traffic, passengers and noisy
loggers. A hidden effect adds to the power of the cars, with a stated share of the energy, in one of three families of
shapes: linear ones as in the library, others that bend, saturate or lag, and random bends. The tables are those of the
product for the recorded messages. The base model is fitted to the data set that holds the effect.

`python -m socast.tools.bench.hidden --export DIR` in the repository of `socast` makes these files. The same options
make the same data.

## How to be judged

Write a JSON file with a ranking for each data set:

    {{"00000": ["snow", "wet_road"], "00001": []}}

The first name counts; of two effects, the first two. Answer `none` or an empty list where nothing is missing, and where
no candidate fits. Then run in the repository:

    python -m socast.tools.bench.hidden.judge DIR answers.json

It prints with Wilson intervals:

{goals}

An effect is *visible* if its true energy is at least {ratio:g} times more likely than the best form of every other
effect. Effects that the base model absorbs ({absorbed}) do not count.

## Licence

The data have the licence of the repository that made them: that of its file `LICENSE`. If there is none, ask the
authors before you pass the data on.
"""


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


def export_tasks(todo: Sequence[Task], folder: Path, processes: int) -> int:
    """Write all data sets, their truth, and the card."""
    for name in ("windows", "truth"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    count = sum(len(cases) for _, cases in todo)
    names = iter(np.random.default_rng(SEED).permutation(count).tolist())  # so that no name tells the part
    jobs = [(part, {f"{next(names):05d}": case for case in cases}) for part, cases in todo]
    with parallel_config(backend="loky", inner_max_num_threads=1):
        parts = Parallel(n_jobs=processes)(delayed(export_cases)(part, cases, folder) for part, cases in jobs)
    made = dict(sorted((name, truth) for part in parts for name, truth in part.items()))
    described = {name: {key: truth[key] for key in PUBLIC} for name, truth in made.items()}
    for file, content in ((CASES, described), (TRUTH, made)):
        (folder / file).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    (folder / "README.md").write_text(make_card(made), encoding="utf-8")
    return len(made)


def export_cases(part: str, cases: Mapping[str, Case], folder: Path) -> dict[str, dict[str, Any]]:
    """Write the data sets of a seed and return the truth of each by its name."""
    data = SeedData(next(iter(cases.values())).seed)
    out = {}
    with threadpool_limits(1):
        for name, case in cases.items():
            with suppress(SocastError):
                out[name] = {"part": part, **export_case(case, data, folder, name)}
    return out


def export_case(case: Case, data: SeedData, folder: Path, name: str) -> dict[str, Any]:
    """Write a data set and return its truth.

    Returns
    -------
    dict
        Description of the data set; `truths`: right names of each cause; `absorbed`: whether the base explains the
        effect; `visible` and `ratios` as of `measure_visibility`.
    """
    tables = data.tables(case)
    model = fit_to_windows(case.recipe, tables.rides, tables.windows)
    windows = gather_windows(tables.rides, tables.windows, model)
    candidates = build_candidates(windows, model)
    shown = build_candidates(windows, model, case.without or draw_decoy(case, candidates))
    tabulate_windows(windows, model, shown).to_parquet(folder / "windows" / f"{name}.parquet", index=False)
    hidden = compute_true_energy(windows, tables.hidden)
    columns = {f"hidden_{effect}": hidden[:, i] for i, (effect, _) in enumerate(case.hidden)}
    pd.DataFrame(columns, index=range(len(hidden))).to_parquet(folder / "truth" / f"{name}.parquet", index=False)
    seen: dict[str, Any] = {"visible": None, "ratios": []}
    if case.hidden:
        measured = measure_visibility(case, BaseProjection(windows, model), candidates, hidden)
        seen = {key: measured[key] for key in seen}
    return {
        **describe_case(case),
        "recipe": case.recipe,
        "truths": [list(names) for names in list_truths(case)],
        "absorbed": any(strip_shape(effect) in ABSORBED for effect, _ in case.hidden),
        **seen,
    }


def draw_decoy(case: Case, candidates: Candidates) -> tuple[str, ...]:
    """Return the right names of an effect that is not hidden, drawn at random.

    They are left out of the candidates, as those of the truth are where it is not in the library. So a missing
    candidate says nothing about the truth.
    """
    hidden = {strip_shape(effect) for effect, _ in case.hidden}
    able = [effect for effect in EFFECTS if effect not in hidden and effect not in ABSORBED]
    able = [effect for effect in able if set(get_right_names(effect)) & set(candidates.names)]
    rng = np.random.default_rng([case.seed, SEED, *str(case.hidden).encode()])
    return get_right_names(str(rng.choice(able)))


def tabulate_windows(windows: Windows, model: LinearModel, candidates: Candidates) -> pd.DataFrame:
    """Return the windows of a data set: conditions, measured energy, terms of the base, and candidates.

    Returns
    -------
    DataFrame
        Columns of `CONDITIONS`, `measured_kwh`, `predicted_kwh`, `base_TERM` and `effect_VARIANT`. The latter two are
        energies per unit of a coefficient.
    """
    fit = model.fits[ANY]
    base = build_design(model.terms, Columns(windows.table, fit.fills, fit.curve), len(windows.measured))
    own = {"ride": windows.ride, "vehicle": windows.vehicle, "day": windows.day}
    columns: dict[str, Any] = {name: own.get(name, windows.table.get(name)) for name in CONDITIONS}
    columns |= {"measured_kwh": windows.measured, "predicted_kwh": windows.predicted}
    energies = {f"base_{term.name}": np.nan_to_num(base[:, i]) for i, term in enumerate(model.terms)}
    energies |= {f"effect_{variant}": candidates.columns[:, i] for i, variant in enumerate(candidates.variants)}
    return pd.DataFrame(columns | {name: values.astype(np.float32) for name, values in energies.items()})


def make_card(made: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the card of data sets, in Markdown."""
    parts = Counter(each["part"] for each in made.values())
    library = sorted(effects.get_library().items())
    return CARD.format(
        count=f"{len(made):,}",
        parts=", ".join(f"{count:,} of part `{part}`" for part, count in parts.items()),
        conditions="\n".join(f"| `{name}` | {what} |" for name, what in CONDITIONS.items()),
        effects="\n".join(f"| `{name}` | {effect.unit} | {_escape(effect.formula)} |" for name, effect in library),
        goals="\n".join(f"- {what}" for what in GOALS),
        ratio=RATIO,
        absorbed=", ".join(ABSORBED),
    )


def _escape(text: str) -> str:
    """Return text for a cell of a table."""
    return " ".join(text.split()).replace("|", r"\|")
