"""Sum products of columns over the shifts of each car, so that any effect of any car and date is tested from them.

The columns of a window are, in this order: what the model may refit (base), directions in which cars of a model differ,
candidate effects, and the measured energy. Sums of products Q'WQ of rides, and then those of shifts (vehicle-days), are
integrated over random effects of rides and of days, whose variances are estimated by restricted likelihood. What
remains of a shift is all that the tests read: an effect within one car from its k-th shift on has the sums of these
shifts.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Floats, Ints
from socast.core.diagnose.candidates import Candidates
from socast.core.diagnose.dataset import Windows
from socast.core.diagnose.projection import BaseProjection, orthonormalise
from socast.core.fit.distortions import gather_distortions
from socast.core.fit.ride_blocks import get_names, get_numbers
from socast.core.stats.mixed_model import FixedColumns, MixedModel
from socast.core.stats.random_effects import integrate_out, number_units, sum_products, sum_units
from socast.core.stats.variances import estimate_variances

DIRECTIONS: Final = {
    "rolling": 0.05,
    "drag": 0.035,
    "mass": 0.02,
    "traction": 0.012,
    "constant": 0.04,
    "heating": 0.08,
    "cooling": 0.08,
    "climb": 0.04,
    "braking": 0.04,
    "inertia": 0.03,
    "lag": 0.3,
}
"""Expected standard deviation of cars of a model in each direction: relative, but for a constant [kW] and a lag [s].

They are those of production and wear of road vehicles and the first guess of an estimate from the fleet itself.
"""
KINDS: Final = {"hours": 0.2, "rolling": 0.1, "drag": 0.1, "mass": 0.05, "braking": 0.1}
"""Size of a typical random effect of a ride on each column: relative, but for hours [kW]."""
COMFORT_C: Final = (18.0, 21.0)
"""Temperatures below which a cabin is heated and above which it is cooled. [°C]"""
NOMINAL_CLIMATE: Final = 0.1
"""Heating and cooling of a nominal car by each degree. [kW/K]"""


class Places(NamedTuple):
    """Hold the columns of the sums: base, directions, candidates; the last one is the measured energy."""

    base: slice
    directions: slice
    candidates: slice

    @property
    def energy(self) -> int:
        """Column of the measured energy."""
        return self.candidates.stop


@dataclass(frozen=True)
class Siblings:
    """Hold the cars of one vehicle model.

    Parameters
    ----------
    car : (s,) int64
        Index of the car of each shift, in ascending order; shifts of a car are in order of time.
    start : (s,) float
        Unix time of the begin of each shift. [s]
    sums : (s, q, q) float
        Sums of products of the columns over each shift, in units of the variance of a window.
    measured, hours, distance : (s,) float
        Energy [kWh], duration [h] and distance [km] of each shift.
    size, net : (s, k) float
        Absolute and net energy of each candidate. [kWh per unit of the coefficient]
    direction : (s, d) float
        Energy of each direction at its expected spread. [kWh]
    day : (s,) int64
        Code of the vehicle-day in the windows.
    """

    cars: tuple[str, ...]
    car: Ints
    start: Floats
    sums: Floats
    places: Places
    measured: Floats
    hours: Floats
    distance: Floats
    size: Floats
    net: Floats
    direction: Floats
    day: Ints

    def add_fixed(self, at: int, weight: Floats) -> "Siblings":
        """Return the siblings with one more column of the base: a candidate times a weight of each shift, (s,)."""
        row = weight[:, np.newaxis] * self.sums[:, self.places.candidates.start + at, :]
        corner = weight**2 * self.sums[:, self.places.candidates.start + at, self.places.candidates.start + at]
        wide = np.concatenate([row[:, :, np.newaxis], self.sums], axis=2)
        top = np.concatenate([corner[:, np.newaxis], row], axis=1)[:, np.newaxis, :]
        sums = np.concatenate([top, wide], axis=1)
        moved = [slice(part.start + 1, part.stop + 1) for part in self.places[1:]]
        return replace(self, sums=sums, places=Places(slice(0, self.places.base.stop + 1), *moved))


def gather_siblings(base: BaseProjection, candidates: Candidates, known: Floats) -> list[Siblings]:
    """Return the cars of each vehicle model with the sums of their shifts.

    Parameters
    ----------
    known : (n, m) float
        Effects that all cars have beyond the model, which are not held against one. [kWh per unit]
    """
    windows = base.windows
    kinds, directions = _make_kinds(base), _make_directions(base)
    every = np.column_stack([base.get_unweighted_columns(), known])
    root = np.sqrt(base.weight)[:, np.newaxis]
    terms = [orthonormalise(every[rows] * root[rows]) / root[rows] for rows in base.kinds.values()]
    relative, scale = _estimate_variances(base, kinds, terms)
    weight = base.weight / scale
    return [
        _sum_shifts(windows, rows, weight, (kinds, part, directions), candidates, relative * scale)
        for rows, part in zip(base.kinds.values(), terms, strict=True)
    ]


def _make_kinds(base: BaseProjection) -> Floats:
    """Return the columns on which rides and days have random effects, (n, kinds). [kWh]"""
    part = _split_energy(base)
    columns = {
        "hours": part["hours"],
        "rolling": part["rolling"],
        "drag": part["drag"],
        "mass": part["rolling"] + part["climb"] + part["inertia"],
        "braking": part["braking"],
    }
    return np.column_stack([size * columns[name] for name, size in KINDS.items()])


def _make_directions(base: BaseProjection) -> Floats:
    """Return the columns in which cars of a model differ, times their expected standard deviation, (n, d). [kWh]"""
    part = _split_energy(base)
    ambient = np.nan_to_num(get_numbers(base.windows.table, "ambient_c"), nan=15.0)
    columns = {
        "rolling": part["rolling"],
        "drag": part["drag"],
        "mass": part["rolling"] + part["climb"] + part["inertia"],
        "traction": part["rolling"] + part["drag"] + part["climb"] + part["inertia"] + part["braking"],
        "constant": part["hours"],
        "heating": NOMINAL_CLIMATE * part["hours"] * np.maximum(COMFORT_C[0] - ambient, 0.0),
        "cooling": NOMINAL_CLIMATE * part["hours"] * np.maximum(ambient - COMFORT_C[1], 0.0),
        "climb": part["climb"],
        "braking": part["braking"],
        "inertia": part["inertia"],
        "lag": part["lag"],
    }
    return np.column_stack([size * columns[name] for name, size in DIRECTIONS.items()])


def _split_energy(base: BaseProjection) -> dict[str, Floats]:
    """Return the nominal energy of each part of the road load, the hours, and the energy of a lag of 1 s."""
    table = base.windows.table
    known = {
        "rolling": get_numbers(table, "effect_rolling") * get_numbers(table, "rolling_resistance"),
        "drag": get_numbers(table, "effect_aero_drag") * get_numbers(table, "drag_area_m2"),
        "climb": get_numbers(table, "effect_climbing"),
        "inertia": get_numbers(table, "effect_inertia"),
        "braking": 0.3 * get_numbers(table, "effect_braking"),
        "hours": get_numbers(table, "duration_s") / 3600.0,
        "lag": gather_distortions(table)[:, 0],
    }
    return {name: np.nan_to_num(values, nan=0.0) for name, values in known.items()}


def _estimate_variances(base: BaseProjection, kinds: Floats, terms: list[Floats]) -> tuple[Floats, float]:
    """Return the relative variances of the random effects of rides and of days, (2, kinds), and the scale φ.

    `terms` has orthonormal columns of what the model may refit, for each vehicle model.
    """
    windows = base.windows
    order = np.concatenate(list(base.kinds.values()))
    widths = [part.shape[1] for part in terms]
    fixed, place = np.zeros((len(order), max(widths))), np.full((len(terms), max(widths)), -1)
    first = 0
    for g, part in enumerate(terms):
        fixed[first : first + len(part), : widths[g]] = part
        place[g, : widths[g]] = sum(widths[:g]) + np.arange(widths[g])
        first += len(part)
    group = np.repeat(np.arange(len(terms)), [len(part) for part in terms])
    units = [windows.ride, windows.day]
    if len(base.cars) > len(base.kinds):  # the only car of a model does not deviate from it
        units.append(windows.vehicle)
    levels = [unit[order] for unit in units]
    model = MixedModel(
        kinds[order], FixedColumns(fixed, group, place), windows.measured[order], base.weight[order], levels
    )
    found = estimate_variances(model, np.ones((len(levels), kinds.shape[1]), np.bool_))
    return found.relative[:2], found.criterion.scale


def _sum_shifts(
    windows: Windows,
    rows: Ints,
    weight: Floats,
    parts: tuple[Floats, Floats, Floats],
    candidates: Candidates,
    variance: Floats,
) -> Siblings:
    """Return the cars of one vehicle model; `parts` are kinds, the terms of these rows, and directions."""
    kinds, terms, directions = parts
    sorting = np.lexsort((get_numbers(windows.table, "start_s")[rows], windows.vehicle[rows]))
    order, terms = rows[sorting], terms[sorting]
    columns = np.column_stack(
        [kinds[order], terms, directions[order], candidates.columns[order], windows.measured[order]]
    )
    k = kinds.shape[1]
    swept = [
        _sweep_car(columns[at], weight[order][at], windows.ride[order][at], windows.day[order][at], variance)
        for at in _split(windows.vehicle[order])
    ]
    sums = np.concatenate([part[:, k:, k:] for part in swept])
    first = np.flatnonzero(np.r_[True, np.diff(windows.day[order]) != 0])
    days = windows.day[order][first]
    per_shift = number_units(windows.day[order])
    table = windows.table.iloc[order]

    def total(values: Floats) -> Floats:
        return np.asarray(np.bincount(per_shift, values, len(first)))

    places = Places(
        slice(0, terms.shape[1]),
        slice(terms.shape[1], terms.shape[1] + directions.shape[1]),
        slice(terms.shape[1] + directions.shape[1], columns.shape[1] - k - 1),
    )
    return Siblings(
        cars=tuple(dict.fromkeys(get_names(table, "vehicle_id"))),
        car=number_units(windows.vehicle[order])[first],
        start=get_numbers(table, "start_s")[first],
        sums=sums,
        places=places,
        measured=total(windows.measured[order]),
        hours=total(get_numbers(table, "duration_s") / 3600.0),
        distance=total(np.nan_to_num(get_numbers(table, "distance_km"))),
        size=np.add.reduceat(np.abs(candidates.columns[order]), first, axis=0),
        net=np.add.reduceat(candidates.columns[order], first, axis=0),
        direction=np.add.reduceat(directions[order], first, axis=0),
        day=days,
    )


def _sweep_car(columns: Floats, weight: Floats, ride: Ints, day: Ints, variance: Floats) -> Floats:
    """Return the sums of each shift of a car after integration over the effects of rides and days."""
    at = slice(0, variance.shape[1])
    rides = integrate_out(sum_products(columns, weight, ride), at, variance[0]).sums
    first = np.flatnonzero(np.r_[True, np.diff(ride) != 0])
    days = sum_units(rides, number_units(day[first]))
    return integrate_out(days, at, variance[1]).sums


def _split(codes: Ints) -> Iterator[NDArray[np.int64]]:
    """Yield the places of each run of equal codes."""
    edges = np.r_[0, np.flatnonzero(np.diff(codes)) + 1, len(codes)]
    for start, end in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        yield np.arange(start, end)
