"""Measure models and diagnosis on three real cars, and publish the page "Real cars".

The drives are fetched by whoever measures: `docs/real-cars.md` says from where. Nothing of them is kept in the project.

Example: python -m socast.tools.bench.real_cars --ved ved/ --i3 i3/ --model3 model3/ --keep build/real --publish
"""

from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from math import log
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import pandas as pd
from threadpoolctl import threadpool_limits

from socast.core.batch import Floats, Ints
from socast.core.columns import GRAVITY, KMH, STANDARD_AIR_DENSITY
from socast.core.diagnose.candidates import build_candidates
from socast.core.fit.recipes import fit_to_windows
from socast.core.models import ANY, LinearModel
from socast.core.stats.splits import deal_folds
from socast.tools.bench.figures.evaluation import run_once
from socast.tools.bench.figures.published import NEEDED, make_parser, publish, write_table
from socast.tools.bench.hidden.baselines import BASELINES, DESCRIPTIONS, LONGEST, RANKED
from socast.tools.simulator.hidden import EFFECTS
from socast.tools.simulator.hidden_shapes import OTHER
from socast.tools.spikein.choice import ScoreChoice
from socast.tools.spikein.records import VISIBLE, SpikeScore, SpikeScores
from socast.tools.spikein.score import RECIPE as DIAGNOSED
from socast.tools.spikein.score import Study, score_spikes

RECIPE: Final = "road_load_full_constant"
"""Recipe that `socast.fit_model` uses by default where no curve of the accessories is known."""
LUMPED: Final = "road_load_constant"
"""Recipe whose coefficients hold the losses of the drivetrain, as the ratio `WHEELS` supposes."""
FOLDS: Final = 18
"""Largest number of parts of the dates."""
DRAWS: Final = 20
"""Number of times that some drives are drawn to fit to."""
FEW: Final = (6, 40)
"""Numbers of drives to fit to."""
SPACE: Final = pd.Timedelta(minutes=2)
"""Least time between two drives of the Model 3, some of whose clocks overlap."""
SIZES: Final = (0.03, 0.05)
"""Energies of the effects that are put in. [1]"""
HALVES: Final = ("neither half", "one half", "both halves")
"""In how many halves of the dates an effect is named again."""
WHEELS: Final = 1.099
"""Energy at the battery over that at the wheels of the Model 3, by its dynamometer. [1]"""
DYNAMOMETER: Final = (179.4, 0.28, 0.0235)
"""Road load A, B and C of the Model 3. [N, N/(km/h), N/(km/h)^2]"""
MASS: Final = 1919.0
"""Mass of the Model 3 on its dynamometer, DOI 10.1016/j.patter.2024.100950. [kg]"""
SPEEDS: Final = (30.0, 60.0, 90.0, 120.0)
"""Speeds at which road loads are compared. [km/h]"""
P90: Final = 1.645
"""Half width of a 90 % interval over the standard error. [1]"""
MODEL3: Final = """[model3]
mass_kg = 1745
nominal_capacity_kwh = 60
drag_area_m2 = 0.51
"""
MAP: Final = """[vehicle]
name = "model3"
model = "model3"

[time]
column = "time"
zone = "Asia/Shanghai"

[fields]
latitude_deg = { column = "latitude_deg", unit = "deg" }
longitude_deg = { column = "longitude_deg", unit = "deg" }
elevation_m = { column = "elevation_m", unit = "m" }
speed_kmh = { column = "speed_kmh", unit = "km/h" }
battery_voltage_v = { column = "voltage_v", unit = "V" }
battery_current_a = { column = "current_a", unit = "A", sign = -1 }
ambient_c = { column = "ambient_c", unit = "degC" }
"""


def rank_by(method: str, study: Study) -> list[str]:
    """Return the effects of a study as a method of the field ranks them."""
    return BASELINES[method](study.selection.base, build_candidates(study.seen, study.model))[:LONGEST]


def rank_by_probability(study: Study) -> list[str]:
    """Return the names of a diagnosis, then the other effects by their probability."""
    chances = study.inference.chances | {each.effect: each.probability for each in study.inference.expected}
    others = sorted(chances, key=lambda name: -chances[name])
    return list(dict.fromkeys([*(each.effect for each in study.selection.effects), *others]))[:LONGEST]


METHODS: Final = {RANKED: rank_by_probability} | {name: partial(rank_by, name) for name in BASELINES}
"""Rankings that are judged on the same effects."""


class Car(NamedTuple):
    """Hold the recording of a car, and its rides that are fit for training with their windows."""

    name: str
    recording: Path
    rides: pd.DataFrame
    windows: pd.DataFrame
    left_out_km: float = 0.0

    def fit(self, rows: Ints) -> LinearModel:
        """Return a model of some rides."""
        return fit_to_windows(RECIPE, self.rides.iloc[rows], self.windows, covariance=False)

    def predict(self, fitted: Ints, rows: Ints) -> Floats:
        """Return the errors of some rides by a model of others. [kWh]"""
        held_out = self.rides.iloc[rows]
        error = self.fit(fitted).predict_energy(held_out) - held_out["energy_kwh"].to_numpy(dtype=np.float64)
        return np.asarray(error, dtype=np.float64)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print, and publish if asked to."""
    parser = make_parser("real_cars", __doc__, ved=NEEDED, i3=NEEDED, model3=NEEDED, keep=NEEDED, publish=False)
    given = parser.parse_args(arguments)
    given.keep.mkdir(parents=True, exist_ok=True)
    with threadpool_limits(1):
        cars = list(import_cars(given.keep, given.ved, given.i3, given.model3))
        errors = measure_errors(cars)
        lines = [*list_errors(errors), "", *list_coefficients(cars[-1])]
    spikes, values = list_spikes(cars)
    lines += ["", *spikes]
    values |= list_values(errors)
    print("\n".join(lines))
    if given.publish:
        words = "--ved ved/ --i3 i3/ --model3 model3/ --keep build/real --publish"
        publish("real-cars", f"python -m socast.tools.bench.real_cars {words}", lines, values)


def import_cars(keep: Path, ved: Path, i3: Path, model3: Path) -> Iterator[Car]:
    """Yield the three cars, the Model 3 last."""
    sheet, mapping, joined = keep / "sheet.toml", keep / "map.toml", keep / "model3.csv"
    sheet.write_text(MODEL3, encoding="utf-8")
    mapping.write_text(MAP, encoding="utf-8")
    join_drives(sorted(model3.glob("road/*.csv*"))).to_csv(joined, index=False)
    for name, words in (
        ("Nissan Leaf 2013", ("ved", ved, "--vehicle", 455)),
        ("BMW i3 2014", ("bmw-i3", i3)),
        ("Tesla Model 3", ("csv", joined, "--map", mapping, "--vehicles", sheet)),
    ):
        recording, tables = keep / f"{words[0]}.mcap", keep / words[0]
        run_once(recording, "import", *words, "--out", recording)
        run_once(tables, "tables", recording, "--out", tables)
        rides = pd.read_parquet(tables / "rides.parquet")
        is_used = rides["fit_for_training"] & rides["energy_kwh"].notna()
        windows, left_out = pd.read_parquet(tables / "windows.parquet"), float(rides["distance_km"][~is_used].sum())
        yield Car(name, recording, rides[is_used].reset_index(drop=True), windows, left_out)


def join_drives(files: Sequence[Path]) -> pd.DataFrame:
    """Return the road drives of the Model 3 in one table: in the order of its counter of energy, without overlap."""
    drives = [pd.read_csv(file) for file in files]
    drives.sort(key=lambda drive: (drive["discharged_kwh"].iloc[0], drive["time"].iloc[0]))
    last: pd.Timestamp | None = None
    for drive in drives:
        begin = pd.Timestamp(drive["time"].iloc[0])
        begin = begin if last is None else max(begin, last + SPACE)
        stamp = begin + pd.to_timedelta(drive["time_s"] - drive["time_s"].iloc[0], unit="s")
        last = stamp.iloc[-1]
        drive["time"] = stamp.dt.strftime("%Y-%m-%dT%H:%M:%S")
    return pd.concat(drives).drop(columns=["time_s", "gear", "charged_kwh", "discharged_kwh"])


def measure_errors(cars: Sequence[Car]) -> list[list[str]]:
    """Return the row of each car in the table of errors."""
    rows = []
    for car in cars:
        used = car.rides["energy_kwh"].to_numpy(dtype=np.float64)
        dates, date = np.unique(car.rides["date"].to_numpy(dtype=str), return_inverse=True)
        fold = deal_folds(len(dates), FOLDS, 0)[date]
        error = np.zeros(len(used))
        for part in range(int(fold.max()) + 1):
            error[fold == part] = car.predict(np.flatnonzero(fold != part), np.flatnonzero(fold == part))
        few = [f"{100.0 * _measure_few(car, count):.1f} %" for count in FEW if count < len(used) - 10]
        rows.append(
            [
                car.name,
                f"{len(used)}",
                f"{car.rides['distance_km'].sum():,.0f}",
                f"{car.left_out_km:,.0f}",
                f"{len(dates)}",
                f"{np.mean(np.abs(error)):.3f}",
                f"{100.0 * np.mean(np.abs(error) / np.abs(used)):.1f} %",
                f"{100.0 * np.abs(error).sum() / np.abs(used).sum():.1f} %",
                *(few + ["too few drives"] * len(FEW))[: len(FEW)],
            ]
        )
    return rows


def list_values(rows: Sequence[Sequence[str]]) -> dict[str, str]:
    """Return the errors of the Model 3 for the table of results."""
    name, drives, *_, mape, _, from_few, _ = rows[-1]
    figure = f"{mape}; fitted to {FEW[0]} other drives {from_few}"
    return {"error": figure, "error_on": f"{drives} road drives of a {name}, dates held out"}


def list_errors(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the table of errors."""
    heads = [
        "car",
        "drives",
        "km",
        "km left out",
        "dates",
        "MAE, kWh",
        "MAPE",
        "wMAPE",
        *(f"MAPE from {count} drives" for count in FEW),
    ]
    note = (
        f"Models of the recipe `{RECIPE}`. MAE, MAPE and wMAPE: each date held out in turn, or one of {FOLDS} parts of "
        f"the dates. The last columns: fitted to some drives, evaluated on all others, also of the same dates, mean of "
        f"{DRAWS} draws. Left out: drives that are unfit for training, such as those of more than an hour."
    )
    return [*write_table(heads, rows), "", note]


def _measure_few(car: Car, count: int) -> float:
    """Return the mean absolute percentage error of drives by models of few others. [1]"""
    used = np.abs(car.rides["energy_kwh"].to_numpy(dtype=np.float64))
    errors = []
    for draw in range(DRAWS):
        order = np.random.default_rng(draw).permutation(len(used))
        fitted, rest = np.sort(order[:count]), np.sort(order[count:])
        errors.append(float(np.mean(np.abs(car.predict(fitted, rest)) / used[rest])))
    return float(np.mean(errors))


def list_coefficients(car: Car) -> list[str]:
    """Return the road load and the mass of the Model 3 from its road drives beside those of the dynamometer."""
    model = fit_to_windows(LUMPED, car.rides, car.windows)
    fit, names = model.fits[ANY], [term.name for term in model.terms]
    covariance = np.asarray(fit.covariance)
    first = car.rides.iloc[0]
    mass = float((car.rides["effect_rolling"] * 3.6e3 / GRAVITY / car.rides["distance_km"]).median())
    rolling = float(first["rolling_resistance"]) * mass * GRAVITY
    drag = 0.5 * STANDARD_AIR_DENSITY * float(first["drag_area_m2"]) * KMH**2
    a, b, c = DYNAMOMETER
    wanted = [
        (f"road load at {v:g} km/h, N", {"rolling": rolling, "aero_drag": drag * v**2}, a + b * v + c * v**2)
        for v in SPEEDS
    ]
    wanted.append(("mass in acceleration, kg", {"inertia_positive": mass}, MASS))
    rows = []
    for what, parts, truth in wanted:
        share = np.array([parts.get(name, 0.0) for name in names]) / WHEELS
        value, half = float(share @ fit.coefficients), P90 * float(np.sqrt(share @ covariance @ share))
        inside = "inside" if abs(value - truth) <= half else "outside"
        rows.append([what, f"{value:,.4g} ± {half:,.2g}", f"{truth:,.4g}", inside])
    note = (
        f"Tesla Model 3: road load from its road drives (recipe `{LUMPED}`), with 90 % intervals, and from the "
        f"dynamometer. The tyres of its road drives are others. Energy at the battery counts {WHEELS} times that at "
        "the wheels, also while the car accelerates, where the losses are larger than on average: the mass holds them."
    )
    return [note, "", *write_table(["quantity", "road drives", "dynamometer", "dynamometer in the interval"], rows)]


def list_spikes(cars: Sequence[Car]) -> tuple[list[str], dict[str, str]]:
    """Return how many known effects the diagnosis names in each car, and what it names without them."""
    effects = tuple(f"{name}{ending}" for name in EFFECTS for ending in ("", OTHER))
    rows, sizes_of, placebos, every = [], [], [], list[SpikeScore]()
    for car in cars:
        scores = score_spikes([car.recording], ScoreChoice(effects, SIZES), methods=METHODS)
        shown = [one for one in scores.scores if one.visible and one.plausible]
        every += shown
        rows.append(
            [
                car.name,
                f"{len(scores.scores)}",
                f"{len(shown)}",
                _count(one.rank is not None for one in shown),
                _count(one.rank is not None for one in shown if (one.form_evidence or 0.0) > log(VISIBLE)),
                _count(one.new_rank == 1 for one in shown),
                _count(one.rank == 1 for one in shown),
                *(_count(one.methods[name] for one in shown) for name in METHODS),
            ]
        )
        sizes_of.append(
            [
                car.name,
                _median(one.ratio for one in shown),
                _count(bool(one.covered) for one in shown if one.covered is not None),
                _median(one.way for one in shown),
            ]
        )
        placebos.append(f"- {car.name}: {_word_placebo(scores)}")
    sizes = " and ".join(f"{100.0 * size:g} %" for size in SIZES)
    heads = [
        "car",
        "put in",
        "visible and plausible",
        "named",
        "named, if visible by a formula of the library",
        "first new name",
        "first name",
        *(f"{name}: first new name" for name in METHODS),
    ]
    note = (
        f"Known effects of {sizes} of the energy, put into the recordings by `socast spikein --score`, in all forms of "
        "the simulator. Visible: the likelihood ratio of the true energies exceeds 20. Plausible: an effect of the "
        "library explains them with a coefficient in its range. Visible by a formula of the "
        "library: so does that of the formula that resembles the true energies most; it may not be the formula that "
        f"was put in. Rankings have at most {LONGEST} effects. Other methods receive the same windows, without the "
        "terms of the model. "
        f"{'. '.join(f'{name[0].upper()}{name[1:]}' for name in DESCRIPTIONS.values())}."
    )
    size_heads = [
        "car",
        "estimated over true size, median",
        "95 % interval of it holds 1",
        "share of the possible fall of the error, median",
    ]
    size_note = (
        "Sizes of the visible effects that are named. Estimated over true size: fitted energy with the added effect "
        "less that without it, over the part of the added energy that the formula can represent; 1 is exact. Share of "
        "the possible fall: fall of the error on held-out days by the named effect, over the fall by the true "
        "energies; 1 is all."
    )
    values = {
        "named": (
            f"{_count(one.rank is not None for one in every)}, as the first new name "
            f"{_count(one.new_rank == 1 for one in every)}"
        ),
        "named_on": f"effects of {sizes} of the energy put into drives of {len(cars)} real cars, visible",
    }
    title = f"What the diagnosis of a model of the recipe `{DIAGNOSED}` names without an added effect:"
    tables = [note, "", *write_table(heads, rows), "", size_note, "", *write_table(size_heads, sizes_of)]
    return [*tables, "", title, "", *placebos], values


def _count(holds: Iterable[bool]) -> str:
    """Return of how many cases something holds."""
    cases = list(holds)
    return f"{sum(cases)} of {len(cases)}"


def _median(values: Iterable[float | None]) -> str:
    """Return the median of the known values."""
    known = [value for value in values if value is not None]
    return f"{np.median(known):.2f}" if known else ""


def _word_placebo(scores: SpikeScores) -> str:
    """Return the names of a diagnosis of the recording as it is."""
    names = [
        f"`{one.effect}`{'' if one.where == 'all cars' else f' ({one.where})'} {100.0 * one.probability:.0f} %"
        f"{'' if one.coefficient.plausible else ', not plausible'}"
        f"{'' if one.halves is None else f', in {HALVES[one.halves]} of the dates'}"
        for one in scores.placebo
    ]
    return "; ".join(names) or "nothing"


if __name__ == "__main__":
    main()
