"""Build the mixed model of windows: fixed columns of the diagnosed model, and loads of rides, days and cars."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import pandas as pd

from socast.core.batch import Floats, Ints
from socast.core.diagnose.dataset import Windows
from socast.core.diagnose.error_location.kinds import KindColumns, gather_kinds
from socast.core.diagnose.error_location.window_noise import LAGS, WindowNoise, estimate_window_noise
from socast.core.diagnose.projection import BaseProjection, Rows, orthonormalise
from socast.core.fit.ride_blocks import get_names
from socast.core.stats.mixed_model import FixedColumns, MixedModel
from socast.core.stats.random_effects import number_units
from socast.core.stats.variances import Variances, estimate_variances

ROUNDS: Final = 2
"""Number of times that the noise of windows is estimated anew beside the loads of rides and days."""
LEAST_UNITS: Final = 8
"""Fewest units of a level from which their differences are estimated."""
LEAST_RATIO: Final = 1.25
"""Least number of units of the level below per unit of a level; with fewer, the two cannot be told apart."""

LEAST_KNOWN: Final = 0.8
"""Least share of vehicle-days whose driver must be known."""

Blocks = list[tuple[Rows, Floats]]


@dataclass(frozen=True)
class Levels:
    """Hold the levels of the windows, from the lowest up.

    Parameters
    ----------
    names : tuple of str
        Names of the levels: `ride`, `day`, and further ones.
    units : tuple of (n,) int64
        Unit of each window at each level.
    """

    names: tuple[str, ...]
    units: tuple[Ints, ...]

    def with_top(self, name: str, unit: Ints) -> "Levels | None":
        """Return the levels with another one above, None where the data do not distinguish or nest it."""
        below = self.units[-1] if self.units else np.arange(len(unit))
        if not _is_distinct(unit, below) or not _is_nested(below, unit):
            return None
        return Levels((*self.names, name), (*self.units, unit))


@dataclass(frozen=True)
class LocationModel:
    """Hold what is estimated from: windows, their noise, their levels and kinds.

    Parameters
    ----------
    joint : Variances
        Most probable variances of all kinds at all levels together.
    """

    windows: Windows
    base: BaseProjection
    levels: Levels
    kinds: KindColumns
    noise: WindowNoise
    model: MixedModel
    joint: Variances

    def replace_top(self, name: str, unit: Ints) -> "LocationModel | None":
        """Return the model with another level above, under the same noise, or None where there can be none."""
        levels = self.levels.with_top(name, unit)
        if levels is None:
            return None
        own, shared = self.base.list_columns()
        mixed, _ = build_mixed_model(self.windows, own, shared, self.kinds, self.noise, levels)
        joint = Variances(np.vstack([self.joint.relative, np.zeros(mixed.size)]), self.joint.criterion)
        return LocationModel(self.windows, self.base, levels, self.kinds, self.noise, mixed, joint)


def build_location_model(windows: Windows, base: BaseProjection) -> LocationModel | None:
    """Return the model of rides and vehicle-days, with the noise of windows estimated beside their loads."""
    levels = Levels((), ())
    for name, unit in (("ride", windows.ride), ("day", windows.day)):
        levels = levels.with_top(name, unit) or levels
    kinds = gather_kinds(windows.table)
    if not levels.names or not kinds.kinds:
        return None
    own, shared = base.list_columns()
    noise = WindowNoise(base.weight, windows.ride, np.zeros(LAGS))
    free, found = np.ones((len(levels.names), len(kinds.kinds)), dtype=bool), None
    for again in range(ROUNDS):
        mixed, fixed = build_mixed_model(windows, own, shared, kinds, noise, levels)
        found = estimate_variances(mixed, free, None if found is None else found.relative)
        if again < ROUNDS - 1:
            left = _subtract_expected(windows, kinds, noise, levels, mixed, fixed, found)
            noise = estimate_window_noise(windows.table, windows.ride, left)
    assert found is not None  # there is at least one round
    return LocationModel(windows, base, levels, kinds, noise, mixed, found)


def build_car_model(located: LocationModel, found: Variances) -> LocationModel | None:
    """Return the model in which cars of a vehicle model share their coefficients and differ by chance."""
    windows, base = located.windows, located.base
    levels = Levels((*located.levels.names, "car"), (*located.levels.units, windows.vehicle))
    many = [len(set(windows.vehicle[rows].tolist())) for rows in base.kinds.values()]
    if sum(many) - len(many) < LEAST_UNITS - len(many) or max(many) < 2:
        return None
    own, shared = base.list_columns()
    columns = np.zeros((len(windows.measured), max(block.shape[1] for _, block in own)))
    for rows, block in own:
        columns[rows, : block.shape[1]] = block
    blocks = [(rows, columns[rows]) for rows in base.kinds.values()]
    mixed, _ = build_mixed_model(windows, blocks, shared, located.kinds, located.noise, levels)
    cars = Levels(("car",), (windows.vehicle,))
    joint = Variances(np.zeros((1, mixed.size)), found.criterion)
    return LocationModel(windows, base, cars, located.kinds, located.noise, mixed.condense(found.relative), joint)


def build_mixed_model(
    windows: Windows, blocks: Blocks, shared: Floats, kinds: KindColumns, noise: WindowNoise, levels: Levels
) -> tuple[MixedModel, FixedColumns]:
    """Return the mixed model of whitened columns, and its fixed columns made orthonormal."""
    n = len(windows.measured)
    widest = max(block.shape[1] for _, block in blocks)
    own = np.zeros((n, widest))
    for rows, block in blocks:
        own[rows, : block.shape[1]] = block
    white = noise.whiten(np.column_stack([own, shared, kinds.columns, windows.measured]))
    common, effects = white[:, widest : widest + shared.shape[1]], white[:, widest + shared.shape[1] : -1]
    cars = int(windows.vehicle.max()) + 1
    columns, place, at = np.zeros((n, widest)), np.full((cars, widest), -1), 0
    for rows, _ in blocks:
        basis = orthonormalise(white[rows, :widest])
        columns[rows, : basis.shape[1]] = basis
        common[rows] -= basis @ (basis.T @ common[rows])
        for car in set(windows.vehicle[rows].tolist()):
            place[car, : basis.shape[1]] = at + np.arange(basis.shape[1])
        at += basis.shape[1]
    common = orthonormalise(common)
    places = np.column_stack([place, np.tile(at + np.arange(common.shape[1]), (cars, 1))])
    fixed = FixedColumns(np.column_stack([columns, common]), windows.vehicle, places)
    return MixedModel(effects, fixed, white[:, -1], np.ones(n), levels.units), fixed


def get_drivers(windows: Windows) -> Ints | None:
    """Return the driver of each window, None where a vehicle-day has several or most are unknown.

    A vehicle-day without a known driver counts as one of a driver of its own.
    """
    named = pd.DataFrame({"day": windows.day_of_ride, "driver": get_names(windows.rides, "driver_id")})
    known = named[named["driver"] != ""].drop_duplicates()
    days = int(windows.day.max()) + 1
    if known["day"].duplicated().any() or len(known) < LEAST_KNOWN * days:
        return None
    driver = np.arange(days) + days
    driver[known["day"].to_numpy()] = pd.factorize(known["driver"])[0]
    return np.asarray(driver[windows.day], dtype=np.int64)


def _subtract_expected(
    windows: Windows,
    kinds: KindColumns,
    noise: WindowNoise,
    levels: Levels,
    model: MixedModel,
    fixed: FixedColumns,
    found: Variances,
) -> Floats:
    """Return the errors of windows less the expected random effects. [kWh]"""
    coefficients = np.append(found.criterion.coefficients, 0.0)[fixed.place[fixed.group]]
    white = noise.whiten(np.column_stack([kinds.columns, windows.measured]))
    left = white[:, -1] - (fixed.columns * coefficients).sum(axis=1)
    for unit, effects in zip(levels.units, model.expect_effects(found.relative), strict=True):
        left -= (effects[number_units(unit)] * white[:, :-1]).sum(axis=1)
    return noise.convert_to_energy(left)


def _is_distinct(unit: Ints, below: Ints) -> bool:
    """Return whether a level has enough units, and enough units of the level below in each."""
    units = len(np.unique(unit))
    return units >= LEAST_UNITS and units * LEAST_RATIO <= len(np.unique(below))


def _is_nested(below: Ints, unit: Ints) -> bool:
    """Return whether all windows of a unit below belong to one unit."""
    pairs = np.unique(np.column_stack([below, unit]), axis=0)
    return len(pairs) == len(np.unique(below))
