"""Compute the tables of leg energy from sums over rides and idle periods.

The model predicts a ride of typical length for each pace and temperature, with the mean amounts of the rides there or
at the nearest temperature (`socast.core.forecast.learning.temperature_transfer`). The measured over the predicted
energy of rides and idle periods corrects it: first by a factor and a power for each temperature, then by a factor for
each pace. Averages blur quantities that change fast with pace or temperature, so `fit_leg_energy` then fits the rides
as sums of their terms. A waiting car takes the mean power of cars that stood, with the corrected model as prior; an
empty way to a ride takes the energy of idle periods beyond that.
"""

from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Floats, Ints, Lanes
from socast.core.columns import GRAVITY
from socast.core.forecast.learning.leg_energy import (
    LEAST_ENERGY_PER_KM,
    PACES,
    TEMPERATURES,
    TYPICAL_KM,
    LegEnergyTables,
)
from socast.core.forecast.learning.temperature_transfer import (
    Corrections,
    fit_corrections,
    make_standing_amounts,
    shift_amounts,
)
from socast.core.totals.accumulator import AMOUNTS, EDGES, Totals
from socast.core.totals.context import RunContext
from socast.core.totals.display_record import create_unknown_yields
from socast.core.totals.tables import model_columns
from socast.core.vehicles.fleet import CarParameters

GRID: Final = len(PACES), len(TEMPERATURES)
"""Shape of a table by pace and temperature."""
CELLS: Final = len(PACES) * len(TEMPERATURES)
"""Number of its cells."""

ENERGY_SUMS: Final = np.dtype(
    [
        ("predicted", "f8"),  # [kWh]
        ("measured", "f8"),  # [kWh]
        ("hours", "f8"),  # [h]
        # products of p (predicted), h (hours) and m (measured) over the variance of the measured energy
        ("pp", "f8"),
        ("ph", "f8"),
        ("hh", "f8"),
        ("pm", "f8"),
        ("hm", "f8"),
    ]
)
"""Sums over rides or idle periods with a measured energy, for a regression of measured on predicted energy."""

IDLE_SUMS: Final = np.dtype(
    [
        ("energy", "f8"),  # measured, of all [kWh]
        ("hours", "f8"),  # of all [h]
        ("standing_energy", "f8"),  # measured, of those in which the car stood [kWh]
        ("standing_hours", "f8"),  # of those [h]
    ]
)
"""Sums over idle periods with a measured energy."""

FIT_TERMS: Final = np.dtype(
    [
        ("km", "f8", GRID),  # kilometres in each cell [km]; coefficient [kWh/km]
        ("climb", "f8"),  # metres gained beyond the usual [m]; coefficient [kWh/m]
        ("descent", "f8"),  # metres lost beyond the usual [m]; coefficient [kWh/m]
        ("start", "f8"),  # ride beginnings [1]; coefficient [kWh]
    ]
)
"""Terms of the energy of a ride, or their coefficients."""
TERMS: Final = CELLS + 3
"""Number of those."""

READING_ENERGY_SD: Final = 0.08
"""Standard deviation of an energy that is read from the charge, about 0.5 % of a small battery. [kWh]"""
PRIOR_KWH: Final = 3.0
"""Weight of the value at neighbouring knots where little energy was measured. [kWh]"""
PRIOR_HOURS: Final = 0.5
"""The same weight for powers of standing cars. [h]"""
PRIOR_MEAN_POWER_HOURS: Final = 1.0
"""The same weight for the mean power over rides and idle periods. [h]"""
PRIOR_KM: Final = 20.0
"""The same weight for energies per kilometre. [km]"""
PRIOR_CLIMB_SD: Final = 0.002
"""Standard deviation of the energy of a metre gained, and of a metre lost, about the model's. [kWh/m]"""
PRIOR_START_SD: Final = 0.1
"""Standard deviation of the energy of a ride's beginning. [kWh]"""
PRIOR_CELL_SD: Final = 0.1
"""Relative standard deviation of the energy per kilometre of a cell about that from averages. [1]"""
CORRECTION_LIMITS: Final = 0.2, 5.0
"""Limits of the correction of a model. [1]"""
LEAST_DISTANCE: Final = 100.0
"""Distance from which a cell is known. [m]"""
LEAST_STANDING_POWER: Final = 0.05
"""Smallest power of a car that is switched on. [kW]"""
TEST_CLIMB: Final = 100.0
"""Climb for which the model predicts the energy per metre. [m]"""
_CLIMB_EFFECTS: Final = {"climbing": (1.0, -1.0), "climbing_up": (1.0, 0.0), "climbing_down": (0.0, -1.0)}
"""Effects of climbing, with the share of m g per metre gained and per metre lost that each of them has."""
_ONE_HOUR: Final = np.ones(len(TEMPERATURES))
_DURATION: Final = AMOUNTS.index("duration")
_DISTANCE: Final = AMOUNTS.index("distance")
_GAINED: Final = AMOUNTS.index("gained")
_LOST: Final = AMOUNTS.index("lost")


class RideSums(NamedTuple):
    """Hold sums over the rides of a vehicle model, by pace and temperature.

    Parameters
    ----------
    amounts : (paces * temperatures, amounts) float
        Sums of `AMOUNTS` and of the effects.
    energy : (paces * temperatures,) ENERGY_SUMS
    """

    amounts: Floats
    energy: NDArray[np.void]


class IdleSums(NamedTuple):
    """Hold sums over the idle periods of a vehicle model, by temperature.

    Parameters
    ----------
    energy : (temperatures,) ENERGY_SUMS
    standing : (temperatures,) IDLE_SUMS
    number : float
        Number of idle periods with a measured energy.
    """

    energy: NDArray[np.void]
    standing: NDArray[np.void]
    number: float

    def compute_power(self, expected: Floats) -> tuple[Floats, Floats]:
        """Return the power of a standing car [kW], and the energy of an idle period beyond that [kWh].

        Units: expected [kW].
        """
        stood, hours = self.standing["standing_energy"], self.standing["standing_hours"]
        expected = np.maximum(expected, LEAST_STANDING_POWER)
        whole = float((stood.sum() + PRIOR_KWH) / (hours @ expected + PRIOR_KWH))
        power = _ratio(stood, hours, PRIOR_HOURS, whole * expected)
        excess = float((self.standing["energy"] - power * self.standing["hours"]).sum()) / max(self.number, 1.0)
        return power, np.full(len(TEMPERATURES), max(excess, 0.0))

    def compute_mean_pause(self) -> float:
        """Return the mean duration of an idle period; half an hour without data. [h]"""
        return float((self.standing["hours"].sum() + PRIOR_HOURS) / (self.number + 1.0))


class RideEdges(NamedTuple):
    """Hold the first and last sample of some ride, (edges,) float each, for models that read them."""

    first: Floats
    last: Floats


class LegEquations(NamedTuple):
    """Sum the normal equations of ride energies on `FIT_TERMS`, each ride over the variance of its energy.

    Parameters
    ----------
    matrix : (TERMS, TERMS) float
    right : (TERMS,) float
        Right-hand side.
    """

    matrix: Floats
    right: Floats


def as_matrix(records: NDArray[np.void]) -> Floats:
    """Return a view of contiguous records of floats as numbers, with one more axis for the fields."""
    return records.view(np.float64).reshape(*records.shape, -1)


def _sum_energy(sums: NDArray[np.void], axis: int) -> NDArray[np.void]:
    """Return records of energy sums, added up along an axis."""
    return np.ascontiguousarray(as_matrix(sums).sum(axis=axis)).view(ENERGY_SUMS)[..., 0]


def build_leg_energy_tables(
    rides: RideSums, idle: IdleSums, edges: RideEdges, context: RunContext
) -> LegEnergyTables | None:
    """Return the tables of a vehicle model, None where the model cannot predict any of its rides."""
    grid, amounts = rides.energy.reshape(GRID), rides.amounts
    car = context.cars.parameters_of(np.array([int(edges.last[EDGES.index("kind")])]))
    of_rides = _sum_energy(grid, 0)
    both = (as_matrix(of_rides) + as_matrix(idle.energy)).view(ENERGY_SUMS)[..., 0]
    standing = make_standing_amounts(amounts.shape[1], TEMPERATURES, context, car)
    model_power = np.nan_to_num(_predict(standing, edges, context))
    corrections = fit_corrections(both, model_power, float(car.accessory_scale[0]))
    typical = _make_typical_rides(amounts, context, car)
    known = typical[:, _DISTANCE] > 0.0
    predicted, hours = np.full(CELLS, np.nan), np.full(CELLS, np.nan)
    predicted[known] = _predict(typical[known], edges, context) / TYPICAL_KM
    hours[known] = typical[known, _DURATION] / 3600.0 / TYPICAL_KM
    if not np.isfinite(predicted).any():
        return None
    by_pace = amounts.reshape(*GRID, -1).sum(axis=1)
    standing_power, approach_energy = idle.compute_power(corrections.compute_energy(model_power, _ONE_HOUR))
    climb_energy, descent_energy = _predict_climb(typical[known].mean(axis=0), edges, context)
    of_riding, of_idling = (_compute_level(sums, corrections) for sums in (of_rides, idle.energy))
    km = np.maximum(amounts[:, _DISTANCE].reshape(GRID).sum(axis=0) / 1000.0, 1e-9)
    mixed = _predict_mix(amounts.sum(axis=0), idle.energy["hours"].sum() * model_power, edges, context, car)
    mixed_hours = np.full(len(TEMPERATURES), max(float(both["hours"].sum()), 1e-9))
    level = corrections.compute_energy(mixed, mixed_hours)
    level *= float(both["measured"].sum()) / max(float(both["hours"] @ level / mixed_hours[0]), 1e-9)
    return LegEnergyTables(
        leg_energy_per_km=_correct_by_pace(predicted.reshape(GRID), hours.reshape(GRID), grid, corrections),
        climbed_per_km=_divide(by_pace[:, _GAINED], by_pace[:, _DISTANCE] / 1000.0),
        descended_per_km=_divide(by_pace[:, _LOST], by_pace[:, _DISTANCE] / 1000.0),
        climb_energy=climb_energy,
        descent_energy=descent_energy,
        start_energy=0.0,
        standing_power=standing_power,
        approach_energy=approach_energy,
        ride_factor=corrections.factor * of_riding,
        ride_power=corrections.power * of_riding,
        idle_factor=corrections.factor * of_idling,
        idle_power=corrections.power * of_idling,
        energy_per_km=_ratio(both["measured"], km, PRIOR_KM, level / km.sum()),
        mean_power=_ratio(both["measured"], both["hours"], PRIOR_MEAN_POWER_HOURS, level / mixed_hours),
        relative_sd=corrections.compute_relative_sd(mixed, mixed_hours),
        mean_pause=idle.compute_mean_pause(),
        ride_pace=float(amounts[:, _DURATION].sum() / 60.0 / km.sum()),
    )


def fit_leg_energy(tables: LegEnergyTables, equations: LegEquations) -> LegEnergyTables:
    """Return tables whose terms fit the measured rides, with the given tables as prior.

    Notes
    -----
    An average over the rides near a knot is blurred by their distances from it; a fit is not. The coefficients are the
    posterior mean of a linear regression with a normal prior.
    """
    prior, spread = np.zeros(1, FIT_TERMS), np.zeros(1, FIT_TERMS)
    prior["km"], prior["climb"], prior["descent"], prior["start"] = (
        tables.leg_energy_per_km,
        tables.climb_energy,
        tables.descent_energy,
        tables.start_energy,
    )
    spread["km"] = PRIOR_CELL_SD * np.maximum(tables.leg_energy_per_km, LEAST_ENERGY_PER_KM)
    spread["climb"] = spread["descent"] = PRIOR_CLIMB_SD
    spread["start"] = PRIOR_START_SD
    precision = as_matrix(spread)[0] ** -2.0
    solution = np.linalg.solve(equations.matrix + np.diag(precision), equations.right + precision * as_matrix(prior)[0])
    fit = solution.view(FIT_TERMS)[0]
    return tables._replace(
        leg_energy_per_km=np.maximum(fit["km"], LEAST_ENERGY_PER_KM),
        climb_energy=float(fit["climb"]),
        descent_energy=float(fit["descent"]),
        start_energy=float(fit["start"]),
    )


def _make_typical_rides(amounts: Floats, context: RunContext, car: CarParameters) -> Floats:
    """Return the sums of a ride of typical length at the pace and the temperature of each cell, (CELLS, amounts).

    They are those of the rides in the cell, or at the nearest temperature with rides of that pace, moved to the
    temperature of the knot. Cells of a pace without rides are zero.
    """
    known = (amounts[:, _DISTANCE] > LEAST_DISTANCE).reshape(GRID)
    source = np.arange(CELLS).reshape(GRID)
    for pace, there in enumerate(known):
        if there.any():
            places = np.flatnonzero(there)
            nearest = np.abs(TEMPERATURES[:, np.newaxis] - TEMPERATURES[places]).argmin(axis=1)
            source[pace] = source[pace, places[nearest]]
    of_cell = amounts[source.ravel()]
    has_rides = np.repeat(known.any(axis=1), len(TEMPERATURES))
    km = np.where(has_rides, of_cell[:, _DISTANCE] / 1000.0, np.inf)
    typical = of_cell * (TYPICAL_KM / km)[:, np.newaxis]
    return shift_amounts(typical, np.tile(TEMPERATURES, len(PACES)), context, car)


def _predict_mix(
    rides: Floats, idle_energy: Floats, edges: RideEdges, context: RunContext, car: CarParameters
) -> Floats:
    """Return the energy of all rides and idle periods as the model predicts it at each knot of temperature. [kWh]"""
    driven = max(float(rides[_DISTANCE]), LEAST_DISTANCE)
    typical = np.repeat(rides[np.newaxis] * (1000.0 * TYPICAL_KM / driven), len(TEMPERATURES), axis=0)
    energy = _predict(shift_amounts(typical, TEMPERATURES, context, car), edges, context)
    return np.asarray(np.nan_to_num(energy) * (driven / 1000.0 / TYPICAL_KM) + idle_energy)


def _correct_by_pace(per_km: Floats, hours: Floats, grid: NDArray[np.void], corrections: Corrections) -> Floats:
    """Return the energy per kilometre of each cell, as predicted and corrected by the measured energy. [kWh/km]

    `hours` is the time per kilometre in each cell. [h/km]
    """
    factor, power = corrections.factor, corrections.power
    expected = np.maximum(grid["predicted"] * factor + grid["hours"] * power, 0.0)
    of_pace = (grid["measured"].sum(axis=1) + PRIOR_KWH) / (expected.sum(axis=1) + PRIOR_KWH)
    ratio = _ratio(grid["measured"], expected, PRIOR_KWH, of_pace[:, np.newaxis])
    return _fill_unknown_paces((per_km * factor + hours * power) * ratio)


def _divide(above: Floats, below: Floats) -> Floats:
    """Return quotients, 0 where the divisor is 0."""
    return np.divide(above, below, out=np.zeros(len(above)), where=below > 0.0)


def _compute_level(sums: NDArray[np.void], corrections: Corrections) -> Floats:
    """Return measured over corrected energy at each temperature, with the ratio over all temperatures as prior."""
    expected = np.maximum(corrections.compute_energy(sums["predicted"], sums["hours"]), 0.0)
    whole = float((sums["measured"].sum() + PRIOR_KWH) / (expected.sum() + PRIOR_KWH))
    return np.clip(_ratio(sums["measured"], expected, PRIOR_KWH, whole), *CORRECTION_LIMITS)


def _ratio(above: Floats, below: Floats, weight: float, prior: float | Floats) -> Floats:
    """Return ratios with a prior of a given weight, in units of the divisor."""
    return np.asarray((above + weight * prior) / (below + weight))


def _predict(amounts: Floats, edges: RideEdges, context: RunContext) -> Floats:
    """Return the energy of rides of these amounts, (n,), that begin and end as a known ride did. [kWh]"""
    n = len(amounts)
    zero: Ints = np.zeros(n, np.int64)
    first, last = (np.repeat(edge[np.newaxis], n, axis=0) for edge in edges)
    totals = Totals(zero, zero, zero, zero, amounts, first, last, np.zeros((n, 1)), create_unknown_yields(n))
    unnamed = replace(context, lanes=Lanes([""]))
    return context.model.predict_energy(model_columns(totals, unnamed, context.model.needs))


def _predict_climb(typical: Floats, edges: RideEdges, context: RunContext) -> tuple[float, float]:
    """Return the energy that a metre gained, and a metre lost, adds to a typical ride. [kWh/m]"""
    kind = int(edges.last[EDGES.index("kind")])
    weight = GRAVITY * float(context.cars.parameters_of(np.array([kind])).mass_kg[0])
    level, climbing, descending = typical.copy(), typical.copy(), typical.copy()
    climbing[_GAINED] += TEST_CLIMB
    descending[_LOST] += TEST_CLIMB
    for name, (up, down) in _CLIMB_EFFECTS.items():
        if name in context.effects:
            place = len(AMOUNTS) + list(context.effects).index(name)
            climbing[place] += up * weight * TEST_CLIMB
            descending[place] += down * weight * TEST_CLIMB
    of_level, of_climb, of_descent = _predict(np.array([level, climbing, descending]), edges, context)
    return float(of_climb - of_level) / TEST_CLIMB, float(of_descent - of_level) / TEST_CLIMB


def _fill_unknown_paces(grid: Floats) -> Floats:
    """Return a grid in which paces without rides have the values of the nearest pace."""
    there = np.flatnonzero(np.isfinite(grid).all(axis=1))
    nearest = np.abs(np.arange(len(grid))[:, np.newaxis] - there).argmin(axis=1)
    return grid[there[nearest]]
