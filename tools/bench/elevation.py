"""Measure what maps and two-sided smoothing of elevation bring: `python -m socast.tools.bench.elevation`.

Each seed simulates a fleet whose true elevation is known. A map is learned from six days. Two months later, models are
fitted to some days and predict the rides of other days, and the state of charge at the end of shifts is forecast. The
clocks of the loggers do not step then, because the true climb of a window is found by its time. The
coarse map is like a tile of SRTM: nodes 3 arc seconds apart in whole metres, with the error that the product assumes.
"""

import json
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from math import nan, radians, sqrt
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd

from socast.core import effects
from socast.core.batch import Floats, Lanes
from socast.core.cleaning.elevation_map import ElevationMap, ElevationRaster
from socast.core.cleaning.kernel import Cleaner
from socast.core.fit.elevation_learning import learn_elevation, select_fixes
from socast.core.fit.recipes import get_recipe
from socast.core.pipeline import Pipeline
from socast.core.settings import Settings
from socast.core.wire.decoder import Decoder
from socast.core.wire.messages import Message
from socast.stream.elevation_files import read_places, write_places
from socast.stream.elevation_tiles import SRTM_VOID, TILE_SD
from socast.stream.loop import feed
from socast.tools.bench import measures
from socast.tools.bench.figures.published import make_parser, publish, write_json, write_table
from socast.tools.bench.measures import cut_blocks
from socast.tools.commands.evaluate_soc import SocForecasts
from socast.tools.simulator.fleet import simulate
from socast.tools.simulator.settings import LOW, NIGHT, STEP, Faults, Simulation
from socast.tools.simulator.truth import Truth
from socast.tools.simulator.world import compute_elevation, to_plane, to_wgs84

SEEDS: Final = (5001, 5002, 5003, 5004, 5005, 5006)
"""Seeds on which nothing was chosen."""
CARS: Final = 5
MAP_DAYS: Final = datetime(2018, 1, 15, tzinfo=UTC), 6
FIT_DAYS: Final = datetime(2018, 3, 19, tzinfo=UTC), 4
TEST_DAYS: Final = datetime(2018, 5, 14, tzinfo=UTC), 3
SOC_DAYS: Final = datetime(2018, 4, 9, tzinfo=UTC), 9
"""First day and number of days: of the map, of the fit, of the rides that it predicts, of the forecasts of charge."""
TILE_OFFSET: Final = -30.0
"""Offset of the coarse map: that of the geoid to the ellipsoid in Montreal. [m]"""
RECIPE: Final = "fitted_physical"
"""Model that is fitted to each kind of table."""
MAPS: Final = ("no map", "tile like SRTM", "learned map")
WAYS: Final = ("causal", "smoothed")


@dataclass
class HeightTruth(Truth):
    """Collect the true elevation of every car in addition.

    Attributes
    ----------
    heights : dict of str to list of (time, elevation)
        Unix time of each step [s], and the elevation of the ground at it [m], one pair of arrays for each shift.
    """

    heights: dict[str, list[tuple[Floats, Floats]]] = field(default_factory=lambda: defaultdict(list))

    def add_shift(self, name: str, shift: Any, *others: Any) -> None:
        """Record the elevation of a shift, as `Truth.add_shift` does."""
        super().add_shift(name, shift, *others)
        heights = compute_elevation(*to_plane(shift.timeline.u, shift.timeline.v))
        self.heights[name].append((shift.time + STEP * np.arange(1, len(heights) + 1), heights))

    def find_climbs(self, table: pd.DataFrame) -> tuple[Floats, Floats]:
        """Return the true climb, and the true gained height, of each ride or window. [m], [m]"""
        climb, gained = np.zeros(len(table)), np.zeros(len(table))
        for name, rows in table.groupby("vehicle_id").indices.items():
            parts = self.heights[str(name)]
            time, height = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
            total = np.cumsum(np.maximum(np.diff(height, prepend=height[0]), 0.0))
            end, duration = (table[column].to_numpy()[rows] for column in ("end_s", "duration_s"))
            start = end - duration  # the step to the first sample counts
            climb[rows] = np.interp(end, time, height) - np.interp(start, time, height)
            gained[rows] = np.interp(end, time, total) - np.interp(start, time, total)
        return climb, gained


def simulate_days(seed: int, start: datetime, days: int, charging: str = LOW) -> tuple[list[Message], HeightTruth]:
    """Return the messages of a fleet, and their truth."""
    truth, faults = HeightTruth(), Faults(clock_step=0.0)
    simulation = Simulation(vehicles=CARS, start=start, days=days, seed=seed, faults=faults, charging=charging)
    return list(simulate(simulation, truth)), truth


def make_tile(seed: int) -> ElevationMap:
    """Return a map like SRTM of the simulated city."""
    (south, north), (west, east) = to_wgs84(*(np.array([-15_000.0, 15_000.0]),) * 2)
    step = 1.0 / 1200.0
    latitude, longitude = np.arange(south, north, step), np.arange(west, east, step)
    # the inverse of `to_wgs84`, by its value at the centre
    (origin_latitude,), (origin_longitude,) = to_wgs84(np.zeros(1), np.zeros(1))
    per_degree = 1000.0 / (to_wgs84(np.zeros(1), np.array([1000.0]))[0][0] - origin_latitude)
    y = (latitude - origin_latitude)[:, np.newaxis] * per_degree
    x = (longitude - origin_longitude)[np.newaxis, :] * per_degree * np.cos(np.radians(latitude))[:, np.newaxis]
    truth = compute_elevation(*np.broadcast_arrays(x, y))
    noise = np.random.default_rng([seed, 7]).normal(0.0, TILE_SD, truth.shape)
    nodes = np.rint(truth + noise + TILE_OFFSET)
    place = radians(latitude[0]), radians(longitude[0]), radians(step), radians(step)
    return ElevationMap([ElevationRaster(*place, nodes, float(SRTM_VOID), TILE_SD)])


def learn_map(seed: int, keep: Path | None = None) -> ElevationMap:
    """Return the map that a fleet's own fixes give.

    Parameters
    ----------
    keep : Path, optional
        Folder in which maps are kept, and from which they are taken the next time.
    """
    path = None if keep is None else keep / f"elevation-{seed}.parquet"
    if path is not None and path.exists():
        return ElevationMap([read_places(path)])
    lanes = Lanes()
    start, days = MAP_DAYS
    batch, _ = Decoder(lanes).decode(list(simulate(Simulation(vehicles=CARS, start=start, days=days, seed=seed))))
    places, _ = learn_elevation(select_fixes(batch, Cleaner(Settings()).clean(batch, len(lanes))))
    if path is not None:
        write_places(places, path)
    return ElevationMap([places])


def tabulate(
    messages: Sequence[Message], elevation_map: ElevationMap | None, *, two_sided: bool
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return the ride table and the window table of messages."""
    also = list(effects.get_library())
    return measures.tabulate(messages, also=also, two_sided=two_sided, elevation_map=elevation_map)


def measure_climb(rides: pd.DataFrame, windows: pd.DataFrame, truth: HeightTruth) -> dict[str, float]:
    """Return the error of the climb of a window [m], and the gained height over the true one [1].

    Both are of the cars that send elevation; `climb_all_m` is the error of all cars.
    """
    silent = [name for name, car in truth.cars.items() if "elevation_m" in car["logger_lacks"]]
    error = (windows["gained_m"] - windows["lost_m"]).to_numpy() - truth.find_climbs(windows)[0]
    sends, sends_in = (~table["vehicle_id"].isin(silent).to_numpy() for table in (windows, rides))
    gained = rides["gained_m"][sends_in].sum() / truth.find_climbs(rides)[1][sends_in].sum()
    return {
        "climb_m": sqrt(float(np.mean(error[sends] ** 2))),
        "climb_all_m": sqrt(float(np.mean(error**2))),
        "gained": float(gained),
    }


def measure_model(fitted: pd.DataFrame, tested: pd.DataFrame) -> float:
    """Return the mean absolute error of a model on rides of other dates. [kWh]"""
    model = get_recipe(RECIPE).fit(fitted)
    some = tested[tested["fit_for_training"]]
    return float(np.abs(model.predict_energy(some) - some["energy_kwh"]).mean())


def measure_forecasts(messages: Sequence[Message], elevation_map: ElevationMap | None) -> float:
    """Return the mean absolute error of the forecasts of the charge at the end of shifts. [percentage points]"""
    forecasts = SocForecasts(Pipeline(keep_outlooks=True, elevation_map=elevation_map))
    for _ in feed(forecasts.cut(cut_blocks(messages)), forecasts.pipeline):
        forecasts.pipeline.forecasts()
        forecasts()
    error = forecasts.evaluated().overall.pooled.mae_pct.value
    return nan if error is None else error


def measure_fleet(seed: int, keep: Path | None = None) -> dict[str, Any]:
    """Return all figures of one fleet: by map and way, and by map for the forecasts."""
    maps = dict(zip(MAPS, (None, make_tile(seed), learn_map(seed, keep)), strict=True))
    days = {name: simulate_days(seed, *when) for name, when in (("fit", FIT_DAYS), ("test", TEST_DAYS))}
    figures: dict[str, Any] = {}
    for name, elevation_map in maps.items():
        for way in WAYS:
            tables = {
                key: tabulate(messages, elevation_map, two_sided=way == "smoothed")
                for key, (messages, _) in days.items()
            }
            rows = measure_climb(*tables["fit"], days["fit"][1])
            rows["mae_kwh"] = measure_model(tables["fit"][0], tables["test"][0])
            figures[f"{name}, {way}"] = rows
            print(f"{seed} {name}, {way}: {rows}")
    messages, _ = simulate_days(seed, *SOC_DAYS, NIGHT)
    figures["soc_mae_pct"] = {name: measure_forecasts(messages, maps[name]) for name in (MAPS[0], MAPS[-1])}
    print(f"{seed} forecasts: {figures['soc_mae_pct']}")
    return figures


def make_lines(results: dict[int, dict[str, Any]]) -> list[str]:
    """Return the tables of all fleets as Markdown."""
    kinds = [f"{name}, {way}" for name in MAPS for way in WAYS]

    def mean(kind: str, name: str) -> float:
        return float(np.mean([figures[kind][name] for figures in results.values()]))

    causal = mean(kinds[0], "climb_m")
    seeds = [[str(seed), *(f"{each[kind]['climb_m']:.2f}" for kind in kinds)] for seed, each in results.items()]
    rows = []
    for kind in kinds:
        climb = mean(kind, "climb_m")
        change = f"{100.0 * (climb / causal - 1.0):+.0f} %"
        gained = f"{100.0 * (mean(kind, 'gained') - 1.0):+.1f} %"
        every = f"{mean(kind, 'climb_all_m'):.2f}"
        rows.append([kind, f"{climb:.2f}", change, every, gained, f"{mean(kind, 'mae_kwh'):.4f}"])
    forecasts = [[name, f"{mean('soc_mae_pct', name):.2f}"] for name in (MAPS[0], MAPS[-1])]
    heads = ["elevation", "climb error [m]", "change", "of all cars [m]", "gained height", "MAE [kWh]"]
    return [
        *(*write_table(["seed", *kinds], seeds), ""),
        *(*write_table(heads, rows), ""),
        *write_table(["forecasts", "MAE of the charge [points]"], forecasts),
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure the fleets of some seeds, and print the tables."""
    parser = make_parser("elevation", __doc__, keep=None, json=None, publish=False)
    parser.add_argument("seeds", nargs="*", type=int, default=SEEDS, help="seeds of the fleets")
    options = parser.parse_args(arguments)
    known = json.loads(options.json.read_text(encoding="utf-8")) if options.json and options.json.exists() else {}
    results = {}
    for seed in options.seeds:
        results[seed] = known.get(str(seed)) or measure_fleet(seed, options.keep)
        write_json(options.json, results)
    lines = make_lines(results)
    print("\n".join(lines))
    if options.publish:
        seeds = " ".join(map(str, options.seeds))
        publish("elevation", f"python -m socast.tools.bench.elevation {seeds}", lines)


if __name__ == "__main__":
    main()
