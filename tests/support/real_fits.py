"""Measure fits to few rides of two real cars: the error on other dates, and coefficients outside their ranges.

`python -m tests.support.real_fits` prints a table. `--before FOLDER` adds the errors of another version, such as one
that `git archive COMMIT | tar x -C FOLDER` made, on the same tables.

The rides of a part of the dates are held out in turn. The fit is made to some rides of the other dates, drawn at
random. "All" are all rides of all other dates, with a date, or one of `MOST_PARTS` parts of the dates, held out at a
time.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pandas as pd

from socast.core import effects
from socast.core.columns import KMH
from socast.core.fit.recipes import fit_to_windows
from socast.core.models.plausibility import list_implausible
from socast.core.pipeline import Pipeline
from socast.core.settings import Settings
from socast.tools.commands.import_drives import collect_drives
from socast.tools.importers.data_sets import DATA_SETS
from socast.tools.importers.drive import make_messages

ROOT: Final = Path(__file__).parents[2]
DATA: Final = ROOT.parent / "shared" / "data"
CARS: Final = {"ved": "Nissan Leaf 2013", "bmw-i3": "BMW i3 2014"}
"""Data sets by the name of their importer, with the car."""
COUNTS: Final = (30, 60, None)
"""Numbers of rides to fit to; None for all of other dates."""
PARTS: Final = 5
"""Number of parts of the dates."""
MOST_PARTS: Final = 18
"""Largest number of parts of the dates for fits to all rides of the other dates."""
DRAWS: Final = 5
"""Number of times that parts and rides are drawn."""
RECIPE: Final = "road_load"


class Tables(NamedTuple):
    """Rides that are fit for training, and windows."""

    rides: pd.DataFrame
    windows: pd.DataFrame


class Result(NamedTuple):
    """Hold the error of rides of other dates [kWh], and in how many fits each coefficient is outside its range."""

    error: float
    outside: dict[str, int]


@cache
def load_tables(car: str) -> Tables:
    """Return the tables of a car, as `socast tables` makes them.

    Parameters
    ----------
    car : str
        Name of the importer, a key of `CARS`.

    Returns
    -------
    Tables
        Tables.
    """
    folder = DATA / {"ved": "ved_ev", "bmw-i3": "bmw_i3"}[car]
    settings = Settings() if car == "ved" else Settings(speed_limit=180 * KMH)
    pipeline = Pipeline(settings=settings, also=list(effects.list_tabulated()), keep_forecasts=False)
    pipeline.push(make_messages(collect_drives([folder], DATA_SETS[car]), 3.0))
    pipeline.finish()
    rides, windows = pipeline.take_rides(), pipeline.take_windows()
    return Tables(rides[rides["fit_for_training"] & rides["energy_kwh"].notna()].reset_index(drop=True), windows)


def draw_splits(dates: np.ndarray, count: int | None) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the rides to fit to, and whether each ride is held out.

    Parameters
    ----------
    dates : (n,) str
        Date of each ride.
    count : int, optional
        Number of rides to fit to; all of other dates without it.

    Yields
    ------
    train : (m,) int
        Rides to fit to, ascending.
    test : (n,) bool
        Which rides are held out.
    """
    days = np.unique(dates)
    for draw in range(DRAWS if count else 1):
        rng = np.random.default_rng(draw)
        for part in np.array_split(rng.permutation(days), PARTS if count else min(len(days), MOST_PARTS)):
            test = np.isin(dates, part)
            yield np.sort(rng.permutation(np.flatnonzero(~test))[:count]), test


@cache
def evaluate_fits(car: str, count: int | None, recipe: str) -> Result:
    """Return the error of rides of other dates, and the coefficients outside of their plausible ranges.

    Parameters
    ----------
    car : str
        Name of the importer, a key of `CARS`.
    count : int, optional
        Number of rides to fit to; all of other dates without it.
    recipe : str
        Name of the recipe to fit.

    Returns
    -------
    Result
        Mean over all draws.
    """
    tables = load_tables(car)
    errors: list[float] = []
    outside: dict[str, int] = {}
    for train, test in draw_splits(tables.rides["date"].to_numpy(dtype=str), count):
        model = fit_to_windows(recipe, tables.rides.iloc[train], tables.windows, covariance=False)
        held = tables.rides.loc[test]
        errors += np.abs(model.predict_energy(held) - held["energy_kwh"].to_numpy()).tolist()
        for name in {name for names in list_implausible(model).values() for name in names}:
            outside[name] = outside.get(name, 0) + 1
    return Result(float(np.mean(errors)), outside)


_OTHER: Final = """
import sys, json, warnings
import numpy as np, pandas as pd
warnings.filterwarnings("ignore")
try:
    from socast.core.fit.recipes import fit_to_windows as fit
except ImportError:
    from socast.core.diagnose.dataset import fit_to_windows as fit
rides, windows = (pd.read_parquet(path) for path in sys.argv[1:3])
errors = []
for train, test in json.load(open(sys.argv[3])):
    held = rides.iloc[test]
    model = fit("road_load", rides.iloc[train], windows, covariance=False)
    errors += np.abs(model.predict_energy(held) - held["energy_kwh"].to_numpy()).tolist()
print(float(np.mean(errors)))
"""
"""What another version runs: the same splits of the same tables."""


def measure_other(folder: Path, tables: Tables, count: int | None) -> float:
    """Return the error of rides of other dates by the code of another version. [kWh]

    Parameters
    ----------
    folder : Path
        Root of that version.
    tables : Tables
        Tables of a car.
    count : int, optional
        Number of rides to fit to.

    Returns
    -------
    float
        Mean absolute error.
    """
    with tempfile.TemporaryDirectory() as place:
        paths = [Path(place) / name for name in ("rides.parquet", "windows.parquet", "splits.json")]
        tables.rides.to_parquet(paths[0])
        tables.windows.to_parquet(paths[1])
        splits = draw_splits(tables.rides["date"].to_numpy(dtype=str), count)
        paths[2].write_text(json.dumps([(one.tolist(), np.flatnonzero(two).tolist()) for one, two in splits]))
        made = subprocess.run(
            [sys.executable, "-c", _OTHER, *map(str, paths)],
            cwd=folder,
            env=os.environ | {"PYTHONPATH": str(folder)},
            capture_output=True,
            text=True,
            check=True,
        )
    return float(made.stdout.split()[-1])


def list_cases() -> Iterator[tuple[str, int | None]]:
    """Yield each car with each number of rides of which it has more on other dates."""
    for car in CARS:
        for count in COUNTS:
            fewest = min(
                len(train) for train, _ in draw_splits(load_tables(car).rides["date"].to_numpy(dtype=str), 10**6)
            )
            if count is None or count <= fewest:
                yield car, count


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--before", type=Path, help="root of another version")
    options = parser.parse_args()
    warnings.filterwarnings("ignore")
    print(f"{'car':18} {'rides':>5} {'MAE, kWh':>9} {'before':>7}  outside of their ranges")
    for car, count in list_cases():
        tables, found = load_tables(car), evaluate_fits(car, count, RECIPE)
        before: Any = "" if options.before is None else f"{measure_other(options.before, tables, count):.4f}"
        names = ", ".join(f"{name} in {n} fits" for name, n in found.outside.items()) or "none"
        print(f"{CARS[car]:18} {count or 'all':>5} {found.error:9.4f} {before:>7}  {names}")


if __name__ == "__main__":
    main()
