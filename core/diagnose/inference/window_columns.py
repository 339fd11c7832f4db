"""Gather the columns of windows that the inference reads: base, shapes of random effects, and effects of the library.

All columns are energies per unit of their coefficient [kWh per unit]. Those of the base are scaled by the standard
deviation of the prior of their coefficient, and the prior means are subtracted from the measured energy, so that every
coefficient of the base is a standard normal variable beforehand.
"""

from collections.abc import Collection
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from socast.core import effects
from socast.core.batch import Floats, Ints
from socast.core.columns import SECONDS_PER_DAY
from socast.core.diagnose.candidates import LEAST_KNOWN
from socast.core.diagnose.dataset import Windows
from socast.core.diagnose.forms.terms import FormTerm
from socast.core.effects import ROAD_LOAD
from socast.core.effects.declaration import VARIANT
from socast.core.fit.block_sums import build_design
from socast.core.fit.priors import build_prior, is_curved
from socast.core.fit.recipes import ROAD_LOAD_TERMS
from socast.core.fit.ride_blocks import get_names, get_numbers
from socast.core.fit.row_noise import DISTORTIONS, build_variance_parts, gather_distortions
from socast.core.models import VEHICLE_MODEL, LinearModel, Term, make_physical_term
from socast.core.models.features import EFFECT_PREFIX, Columns
from socast.core.stats.random_effects import number_units

SHAPES: Final = ("rolling", "constant", "drag", "inertia")
"""Loads by which rides, days, cars and dates differ at random."""
CAR_DIRECTIONS: Final = ("heating", "cooling", "braking", "climbing")
"""Further loads by which cars differ."""
USUAL_SPREADS: Final = (0.05, 30.0, 0.05, 0.03, 10.0, 10.0, 0.1, 0.05)
"""Usual standard deviations of the shapes and directions: shares [1]; of the constant load, a power [W]; of heating and
cooling, a power per kelvin [W/K]."""
POWERTRAIN: Final = 1.25, 1.2
"""Energy at the battery over that at the wheels, of rolling and of drag, by the priors of the road load. [1]"""
FORM_ERROR: Final = 0.15
"""Standard deviation of the force over speed that the terms of the road load lack, over the rolling force. [1]

The force is a smooth function of speed, because bends, traffic and slip depend on it."""
SPEED_LENGTH: Final = 2.0
"""Number of classes of the speed over which that force changes. [1]"""
TENT_POWER: Final = 300.0
"""Standard deviation of the accessory power around the curve of the model at a temperature. [W]"""
TENT_STEP: Final = 6.0
"""Distance of the temperatures between which that power is interpolated. [K]"""
CURVE_SPREAD: Final = 0.4
"""Standard deviation of the factor of the accessory curve. [1]"""
STANDBY: Final = 800.0, 500.0
"""Mean and standard deviation of the constant power where a model has no accessory curve. [W]"""
AT_LIMIT: Final = 2.0
"""Standard deviations of the widest prior of an expected effect at the farther end of its plausible range."""
SEASON: Final = 85.0
"""Length of the data from which rolling and constant load may drift with the season. [days]"""
SEASON_STEP: Final = 45.0
"""Distance of the times between which the drift is interpolated. [days]"""
SEASON_SPREAD: Final = (0.03, 40.0)
"""Standard deviation of the drift of rolling, as a share [1], and of the constant load [W]."""
LEAST_RANK: Final = 1e-3
"""Variance of a combination of classes of the speed, over the largest one, below which it is left out. [1]"""


@dataclass(frozen=True)
class Expected:
    """Hold an effect whose coefficient physics expects to differ from zero in every car.

    Parameters
    ----------
    at : int
        Column of `WindowColumns.common`.
    mean, sd : float
        Its coefficient beforehand. [unit of the coefficient]
    widest : float
        Factor of `sd` at which the plausible range ends at `AT_LIMIT` standard deviations, at least 1. [1]
    """

    effect: str
    at: int
    mean: float
    sd: float
    widest: float


class UnknownForm(NamedTuple):
    """Hold a form outside the library.

    Parameters
    ----------
    size : float
        Standard deviation of its coefficient beforehand. [unit of the coefficient]
    log_share : float
        Logarithm of its share of the prior probability that something outside the library is missing.
    """

    term: FormTerm
    size: float
    log_share: float


@dataclass(frozen=True)
class WindowColumns:
    """Hold the columns of n windows in r rides on d vehicle-days.

    Parameters
    ----------
    residual : (n,) float
        Measured energy less what the prior means of the base explain. [kWh]
    shapes, directions : (n, 4), (n, 4) float
        Energy of each shape and direction at its usual spread. [kWh]
    base : (n, b) float
        Terms whose coefficients differ between vehicle models.
    common : (n, m) float
        Columns whose coefficients all cars share.
    expected : tuple of Expected
        Effects among the common columns that every car is expected to have.
    names : tuple of str
        Effects of the library and their variants.
    effects : (n, k + u) float
        Their energy, and that of the forms outside the library.
    parts : (n, 4) float
        Parts of the variance of the windows, see `build_variance_parts`. [kWh^2]
    ignored : (n,) bool
        Windows that do not count, because they belong to an episode.
    ride, day : (n,), (n,) int64
        Ride and vehicle-day of each window.
    day_of_ride : (r,) int64
        Vehicle-day of each ride.
    car_of_day, date_of_day, kind_of_day : (d,) int64
        Car, date and vehicle model of each vehicle-day.
    start : (d,) float
        Begin of each vehicle-day. [Unix s]
    measured : (n,) float
        Measured energy. [kWh]
    unknown : tuple of UnknownForm
        Forms outside the library.
    guessed : frozenset of str
        Signals of effects for which another one has to stand.
    """

    residual: Floats
    shapes: Floats
    directions: Floats
    base: Floats
    common: Floats
    expected: tuple[Expected, ...]
    names: tuple[str, ...]
    effects: Floats
    parts: Floats
    ignored: NDArray[np.bool_]
    ride: Ints
    day: Ints
    day_of_ride: Ints
    car_of_day: Ints
    date_of_day: Ints
    kind_of_day: Ints
    start: Floats
    cars: tuple[str, ...]
    dates: tuple[str, ...]
    measured: Floats
    unknown: tuple[UnknownForm, ...] = ()
    guessed: frozenset[str] = frozenset()

    def find_largest(self, at: int) -> float:
        """Return the upper end of the plausible range of an effect, or the usual size of a form."""
        if at >= len(self.names):
            return self.unknown[at - len(self.names)].size
        return effects.get(self.names[at]).largest

    def sum_days(self, values: Floats) -> Floats:
        """Return the sum of values of windows over each vehicle-day."""
        return np.asarray(np.bincount(self.day, values, len(self.start)), dtype=np.float64)

    def stack(self, *more: Floats) -> Floats:
        """Return the shapes, directions, base and common columns, further ones, and the residual, in this order."""
        return np.column_stack([self.shapes, self.directions, self.base, self.common, *more, self.residual])


def gather_window_columns(
    seen: Windows, model: LinearModel, without: Collection[str] = (), ignored: NDArray[np.bool_] | None = None
) -> WindowColumns:
    """Return the columns of windows for the inference.

    Parameters
    ----------
    without : collection of str
        Effects of the library that do not count as candidates.
    ignored : (n,) bool, optional
        Windows that do not count.
    """
    table, n = seen.table, len(seen.measured)
    day = number_units(seen.day)
    first = np.unique(day, return_index=True)[1]
    kind = pd.factorize(pd.Series(get_names(table, VEHICLE_MODEL)))[0].astype(np.int64)
    base, mean = _gather_base(table, model, kind)
    common, expected, more = _gather_common(table, model, without)
    names, columns = _gather_effects(table, without)
    vehicles = get_names(table, "vehicle_id")
    loads = _gather_loads(table) * np.array(USUAL_SPREADS)
    ride = number_units(seen.ride)
    known = np.isfinite(get_numbers(table, "battery_temperature_c"))
    return WindowColumns(
        residual=seen.measured - mean - more,
        shapes=loads[:, : len(SHAPES)],
        directions=loads[:, len(SHAPES) :],
        base=base,
        common=common,
        expected=expected,
        names=names,
        effects=columns,
        parts=build_variance_parts(table),
        ignored=np.zeros(n, dtype=np.bool_) if ignored is None else ignored,
        ride=ride,
        day=day,
        day_of_ride=day[np.unique(ride, return_index=True)[1]],
        car_of_day=seen.vehicle[first],
        date_of_day=seen.date[first],
        kind_of_day=kind[first],
        start=get_numbers(table, "start_s")[first],
        cars=tuple(str(vehicles[np.flatnonzero(seen.vehicle == car)[0]]) for car in range(int(seen.vehicle.max()) + 1)),
        dates=tuple(sorted(set(get_names(table, "date")))),
        measured=seen.measured,
        guessed=frozenset() if known.mean() >= LEAST_KNOWN else frozenset({"pack_temperature"}),
    )


def _read(table: pd.DataFrame, name: str) -> Floats:
    """Return a column, zero where it is unknown."""
    return np.nan_to_num(get_numbers(table, name)) if name in table else np.zeros(len(table))


def _hours(table: pd.DataFrame) -> Floats:
    """Return the energy of 1 W in each window. [kWh/W]"""
    return get_numbers(table, "duration_s") / 3.6e6


def _gather_loads(table: pd.DataFrame) -> Floats:
    """Return the energy of each shape and direction, of some per watt or per watt and kelvin, (n, 8). [kWh]"""
    rolling, drag = _compute_motion(table)
    others = [
        _read(table, f"effect_{name}") for name in ("inertia", "cabin_heating", "cabin_cooling", "braking", "climbing")
    ]
    return np.column_stack([rolling, _hours(table), drag, *others])


def _compute_motion(table: pd.DataFrame) -> tuple[Floats, Floats]:
    """Return the energies of rolling and of drag at the battery by the catalogue. [kWh]"""
    rolling = _read(table, "effect_rolling") * get_numbers(table, "rolling_resistance")
    drag = _read(table, "effect_aero_drag") * get_numbers(table, "drag_area_m2")
    return rolling * POWERTRAIN[0], drag * POWERTRAIN[1]


def _gather_base(table: pd.DataFrame, model: LinearModel, kind: Ints) -> tuple[Floats, Floats]:
    """Return the terms of the road load and of a model, scaled by their priors, and the energy of the prior means.

    A constant power is always among them, so that no cause is named for what standby power alone would explain.
    """
    has_curve = any(is_curved(term) for term in model.terms)
    standby = make_physical_term("auxiliary", ("effect_auxiliary",))
    road: tuple[Term, ...] = (*ROAD_LOAD_TERMS, standby) if "effect_auxiliary" in table else ROAD_LOAD_TERMS
    known = {term.columns for term in road}
    terms = (*road, *(term for term in model.terms if term.columns not in known and not is_curved(term)))
    scaled, mean = np.zeros((len(table), len(terms))), np.zeros(len(table))
    for of_kind in range(int(kind.max()) + 1):
        rows = np.flatnonzero(kind == of_kind)
        columns = Columns(table.iloc[rows])
        design = np.nan_to_num(build_design(terms, columns, len(rows)))
        prior = build_prior(terms, columns, len(rows))
        scaled[rows] = design * np.sqrt(np.diag(prior.covariance))
        mean[rows] = design @ prior.mean
    blocks, hours = [scaled], _hours(table)
    if standby not in road:
        blocks.append((hours * STANDBY[1])[:, np.newaxis])
        mean += 0.0 if has_curve else hours * STANDBY[0]
    if has_curve:
        by_curve = _read(table, "effect_accessories")
        blocks += [(by_curve * CURVE_SPREAD)[:, np.newaxis], _build_tents(table) * (hours * TENT_POWER)[:, np.newaxis]]
        mean += by_curve
    return np.column_stack(blocks), mean


def _build_tents(table: pd.DataFrame) -> Floats:
    """Return linear interpolation weights between temperatures, (n, temperatures)."""
    ambient = get_numbers(table, "ambient_c")
    known = np.isfinite(ambient)
    ambient = np.where(known, ambient, np.mean(ambient[known]) if known.any() else 20.0)
    low, high = float(ambient.min()), float(ambient.max())
    if high - low < TENT_STEP / 2.0:
        return np.ones((len(ambient), 1))
    knots = np.linspace(low, high, max(2, round((high - low) / TENT_STEP) + 1))
    return np.maximum(1.0 - np.abs(ambient[:, np.newaxis] - knots) / (knots[1] - knots[0]), 0.0)


def _gather_common(
    table: pd.DataFrame, model: LinearModel, without: Collection[str]
) -> tuple[Floats, tuple[Expected, ...], Floats]:
    """Return the common columns, the expected effects among them, and the energy of their prior means."""
    inside = {effects.get(name).base for name in model.effects}
    columns: list[Floats] = []
    expected: list[Expected] = []
    mean = np.zeros(len(table))
    road = {effect.name for effect in ROAD_LOAD}
    for name, effect in effects.get_library().items():
        prior = effect.expected
        if prior is None or name in road or name in inside or name in without:
            continue
        own = _read(table, f"{EFFECT_PREFIX}{name}")
        if not own.any():
            continue
        figure = get_numbers(table, prior.of) if prior.of else np.ones(len(table))
        size = float(np.nanmean(figure))
        mean_of, sd_of = prior.mean * size, prior.sd * size
        widest = max(effect.high - mean_of, mean_of - effect.low) / (AT_LIMIT * sd_of)
        expected.append(Expected(name, len(columns), mean_of, sd_of, max(widest, 1.0)))
        columns.append(own * figure * prior.sd)
        mean += own * figure * prior.mean
    blocks = [*columns, *_build_speed_forces(table).T, *_build_season(table).T]
    blocks += [lag * sd for lag, sd in zip(gather_distortions(table).T, DISTORTIONS.values(), strict=True)]
    return np.column_stack(blocks), tuple(expected), mean


def _build_speed_forces(table: pd.DataFrame) -> Floats:
    """Return the energies of smooth forces over the speed, (n, forces)."""
    bands = [name for name in map(str, table) if name.startswith("speed_") and name.endswith("_km")]
    if not bands:
        return np.empty((len(table), 0))
    distance = np.nan_to_num(table[bands].to_numpy(dtype=np.float64))
    at = np.arange(len(bands))
    smooth = np.exp(-0.5 * ((at[:, np.newaxis] - at) / SPEED_LENGTH) ** 2)
    variance, axes = np.linalg.eigh(smooth @ smooth.T)
    kept = variance > LEAST_RANK * variance.max()
    rolling, _ = _compute_motion(table)
    force = FORM_ERROR * float(rolling.sum()) / max(float(np.nansum(get_numbers(table, "distance_km"))), 1e-9)
    return np.asarray(distance @ (axes[:, kept] * np.sqrt(variance[kept])) * force)


def _build_season(table: pd.DataFrame) -> Floats:
    """Return the energies by which rolling and constant load drift over the season; none in short data."""
    time = get_numbers(table, "start_s") / SECONDS_PER_DAY
    low, high = float(time.min()), float(time.max())
    if high - low < SEASON:
        return np.empty((len(table), 0))
    knots = np.linspace(low, high, round((high - low) / SEASON_STEP) + 1)
    tents = np.maximum(1.0 - np.abs(time[:, np.newaxis] - knots) / (knots[1] - knots[0]), 0.0)
    rolling, _ = _compute_motion(table)
    loads = rolling * SEASON_SPREAD[0], _hours(table) * SEASON_SPREAD[1]
    return np.column_stack([tents * load[:, np.newaxis] for load in loads])


def _gather_effects(table: pd.DataFrame, without: Collection[str]) -> tuple[tuple[str, ...], Floats]:
    """Return the effects of the library and their variants that act in these windows, with their energies."""
    road = {effect.name for effect in ROAD_LOAD}
    names, columns = [], []
    for column in table:
        name = str(column).removeprefix(EFFECT_PREFIX)
        base = name.partition(VARIANT)[0]
        if not str(column).startswith(EFFECT_PREFIX) or base not in effects.get_library() or base in {*road, *without}:
            continue
        energy = get_numbers(table, str(column))
        if np.isfinite(energy).mean() >= LEAST_KNOWN and np.any(np.nan_to_num(energy)):
            names.append(name)
            columns.append(np.nan_to_num(energy))
    return tuple(names), np.column_stack(columns) if columns else np.empty((len(table), 0))
