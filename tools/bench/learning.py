"""Measure time and memory of a fit, against scikit-learn's least squares of the same columns."""

import subprocess
import sys
import tempfile
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from sklearn.linear_model import LinearRegression

from socast.core import effects
from socast.core.fit.block_sums import build_design
from socast.core.fit.recipes import RECIPES, LinearRecipe
from socast.core.models import ANY, LinearModel
from socast.core.models.features import Columns
from socast.core.pipeline import Pipeline
from socast.stream.loop import feed
from socast.tools.bench.measures import Measure, alternate_timings, cut_blocks, time_action
from socast.tools.simulator.fleet import simulate
from socast.tools.simulator.settings import Simulation
from socast.tools.terminal.ride_source import ROW_GROUP

MANY, FEW = 200_000, 20_000
RECIPE: Final = "hybrid_interactions"
NOISE: Final = 0.02

FIT: Final = """
import sys
from socast.core.fit.recipes import RECIPES
for path in sys.argv[1:]:
    RECIPES[{recipe!r}].fit_parquet(path)
    status = open("/proc/self/status").read()
    print(status.partition("VmHWM:")[2].split()[0])
"""


def measure_fit(repeats: int = 3) -> Measure:
    """Measure a fit from a Parquet file of many rides, against scikit-learn's of the same columns in memory."""
    recipe = RECIPES[RECIPE]
    if not isinstance(recipe, LinearRecipe):
        raise TypeError(recipe)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "rides.parquet"
        write_rides(path, _simulated(), MANY)
        model = recipe.fit_parquet(path)
        ours, plain = alternate_timings(
            lambda: time_action(lambda: recipe.fit_parquet(path)), lambda: _plain(model, path), repeats
        )
    return Measure(
        f"fitting {RECIPE} to {MANY:,} rides, file to model",
        "scikit-learn's LinearRegression of the same columns in memory",
        plain / ours,
        ">= 0.6",
        plain >= 0.6 * ours,
        {"fit_s": ours, "plain_s": plain, "terms": len(model.terms), "fits": len(model.fits)},
        "A fit reads the file once. Reading takes a fifth of the time; converting the columns and keeping them in a "
        "temporary file, a sixth; fills and accessory curve, a tenth. The passes for normal equations and residuals "
        "read the temporary file: they spend a sixth of the time on making the columns of the model, and a third on "
        "sums of products, leverages and sums by vehicle-day. The interval, from a tenth of the rides, takes the rest. "
        "Scikit-learn's figure covers the same five fits, "
        "one for each car model and one for all, without reading the file and making the columns; it "
        "decomposes the columns themselves.",
    )


def measure_fit_memory() -> Measure:
    """Measure how peak memory grows with the number of rides: first a tenth of them, then all, in one process."""
    with tempfile.TemporaryDirectory() as folder:
        base = _simulated()
        paths = [Path(folder) / f"{n}.parquet" for n in (FEW, MANY)]
        for path, n in zip(paths, (FEW, MANY), strict=True):
            write_rides(path, base, n)
        code = FIT.format(recipe=RECIPE)
        done = subprocess.run(  # noqa: S603 - this interpreter, on files made here
            [sys.executable, "-c", code, *map(str, paths)], capture_output=True, text=True, check=True
        )
    few, many = (int(line) / 1024.0 for line in done.stdout.split())
    return Measure(
        f"peak memory of a fit to {MANY:,} rides",
        f"to {FEW:,}",
        many / few,
        "<= 1.1",
        many <= 1.1 * few,
        {"many_mb": many, "few_mb": few, "table_mb": MANY * 8 * len(base.columns) / 2**20},
        "The imports take 250 MB of both. The rest is a block of 8,192 rides, its products, and what the "
        "allocator keeps. The whole table would take `table_mb`, and its products as much again.",
    )


def _simulated() -> pd.DataFrame:
    """Return the ride table of one day of a small fleet."""
    start = datetime(2018, 1, 16, 12, tzinfo=UTC)
    pipeline = Pipeline(also=list(effects.get_library()), keep_forecasts=False)
    messages = list(simulate(Simulation(vehicles=12, start=start, shift_hours=4.0, seed=5)))
    for _ in feed(cut_blocks(messages), pipeline):
        pass
    rides = pipeline.take_rides()
    return rides[rides["fit_for_training"]].reset_index(drop=True)


def write_rides(path: Path, base: pd.DataFrame, rides: int, seed: int = 1) -> None:
    """Write a ride table of any size."""
    rng = np.random.default_rng(seed)
    fixed = {"winter", "summer", "fit_for_training"}
    noisy = [name for name in base.columns if name not in fixed and pd.api.types.is_float_dtype(base[name])]
    writer = None
    for start in range(0, rides, ROW_GROUP):
        n = min(ROW_GROUP, rides - start)
        part = base.iloc[rng.integers(0, len(base), n)].reset_index(drop=True)
        part[noisy] = part[noisy].to_numpy() * (1.0 + NOISE * rng.standard_normal((n, len(noisy))))
        part["ambient_c"] = rng.uniform(-30.0, 30.0, n)
        day = 365 * (start + np.arange(n)) // rides
        part["date"] = (np.datetime64("2018-01-01") + day).astype(str)
        part["winter"] = ((day < 74) | (day > 348)).astype(np.int64)
        part["summer"] = 1 - part["winter"]
        table = pa.Table.from_pandas(part, preserve_index=False)
        writer = writer or pq.ParquetWriter(path, table.schema, compression="zstd")
        writer.write_table(table.cast(writer.schema))
    if writer is not None:
        writer.close()


def _plain(model: LinearModel, path: Path) -> float:
    """Return the time of scikit-learn's fits with the columns already made. [s]"""
    rides = pd.read_parquet(path)
    took = 0.0
    for key, fit in model.fits.items():
        group = rides if key == ANY else rides[rides["vehicle_model"] == key]
        table = build_design(model.terms, Columns(group, fit.fills, fit.curve), len(group))
        energy = group["energy_kwh"].to_numpy()
        took += time_action(lambda table=table, energy=energy: LinearRegression().fit(table, energy))  # type: ignore[misc]
    return took
