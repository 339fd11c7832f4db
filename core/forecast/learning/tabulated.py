"""From sums of rides and rests to what is expected of legs: `core.forecast.habits` to `core.forecast.expected`.

Of each pace and temperature a ride of usual length is asked of the model, as the rides there were on average. What was
measured of rides and rests, against what was predicted of them, corrects it: a factor and a power for each temperature,
then what is left for each pace. Averages blur what changes fast with pace or temperature: so rides are fitted then, as
sums of their terms. A car that waits takes the mean power of those that stood; an empty way to a ride, what
rests took beyond that.
"""

from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from core.batch import Floats, Ints, Lanes
from core.forecast.learning.leg_energy import PACES, TEMPERATURES, TYPICAL_KM, Tables
from core.totals.accumulator import AMOUNTS, EDGES, Totals
from core.totals.context import RunContext
from core.totals.tables import model_columns

CELLS: Final = len(PACES) * len(TEMPERATURES)
TERMS: Final = CELLS + 3
"""Of a ride: kilometres in each cell, metres gained and lost beyond the usual, its beginning."""
BESIDE: Final = ("predicted", "measured", "hours", "pp", "ph", "hh", "pm", "hm")
"""What is summed beside the amounts, of rides and rests whose energy was measured: kWh predicted, kWh measured, hours;
and the products of these that a regression is made of, each over the variance of the measured energy."""
PREDICTED, MEASURED, HOURS = range(3)
READ: Final = 0.08
"""Standard deviation of an energy that is read from the charge, about half a per cent of a small battery. [kWh]"""
PRIOR: Final = 0.5, 0.5
"""Standard deviations of the factor and of the power [kW] about those over all temperatures."""
PRIOR_KWH: Final = 3.0
"""Energy that stands for what is known of neighbours where little was measured. [kWh]"""
PRIOR_HOURS: Final = 0.5
"""The same for powers. [h]"""
USUAL_KM: Final = 20.0
"""The same for an energy of a kilometre. [km]"""
PRIOR_EXTRAS: Final = 0.002, 0.002, 0.1
"""Standard deviations of what a metre gained, a metre lost [kWh/m], and a ride's beginning [kWh] add to the model."""
CORRECTIONS: Final = 0.2, 5.0
"""A model that is off by more is not corrected further. [1]"""
PRIOR_CELL: Final = 0.1
"""The same of the energy of a kilometre at a pace and temperature, over what averages tell. [1]"""
LEAST: Final = 0.01
"""No way takes less. [kWh/km]"""
LEAST_DISTANCE: Final = 100.0
"""Distance from which on a cell is known. [m]"""
GRAVITY: Final = 9.81
"""[m/s^2]"""
HILL: Final = 100.0
"""Climb by which the energy of a metre of climbing is asked of the model. [m]"""
_SHAPE: Final = len(PACES), len(TEMPERATURES)
_DURATION: Final = AMOUNTS.index("duration")
_DISTANCE: Final = AMOUNTS.index("distance")
_GAINED: Final = AMOUNTS.index("gained")
_LOST: Final = AMOUNTS.index("lost")
_CLIMBS: Final = {"climbing": (1.0, -1.0), "climbing_up": (1.0, 0.0), "climbing_down": (0.0, -1.0)}
"""Effects of climbing, and what a metre gained and a metre lost add to each, over m g."""


class Rests(NamedTuple):
    """What was summed of the rests of a vehicle model.

    Parameters
    ----------
    sums : (temperatures, amounts and `BESIDE`) float
    still : (temperatures, 4) float
        Measured energy [kWh] and time [h] of all, and of those in which the car stood.
    number : float
    """

    sums: Floats
    still: Floats
    number: float

    def beside(self) -> Floats:
        """Return `BESIDE` at each temperature, (temperatures, len(BESIDE))."""
        return self.sums[:, -len(BESIDE) :]

    def power(self) -> tuple[Floats, Floats]:
        """Return the power of a car that stands [kW], and what a rest takes besides [kWh], at each temperature."""
        energy, hours, stood, stood_hours = self.still.T
        standing = _ratio(stood, stood_hours, PRIOR_HOURS, (stood.sum() + 1.0) / (stood_hours.sum() + 1.0))
        more = float((energy - standing * hours).sum()) / max(self.number, 1.0)
        return standing, np.full(len(TEMPERATURES), max(more, 0.0))

    def pause(self) -> float:
        """Return the time of a rest, on average; half an hour where none is known. [h]"""
        return float((self.still[:, 1].sum() + PRIOR_HOURS) / (self.number + 1.0))


def tabulated(rides: Floats, rests: Rests, edges: Floats, context: RunContext) -> Tables | None:
    """Return what is expected of a vehicle model, None where the model cannot tell.

    Parameters
    ----------
    rides : (paces * temperatures, amounts and `BESIDE`) float
        Sums.
    rests : Rests
    edges : (2, edges) float
        First and last of some ride, for what a model reads of it.
    context : RunContext
    """
    grid, amounts = rides[:, -len(BESIDE) :].reshape(*_SHAPE, -1), rides[:, : -len(BESIDE)]
    ridden, rested = grid.sum(axis=0), rests.beside()
    both = ridden + rested
    factor, power = _regressed(both)
    known = amounts[:, _DISTANCE] > LEAST_DISTANCE
    typical = amounts[known] * (1000.0 * TYPICAL_KM / amounts[known, _DISTANCE])[:, np.newaxis]
    predicted = np.full(CELLS, np.nan)
    predicted[known] = _predicted(typical, edges, context) / TYPICAL_KM
    if not np.isfinite(predicted).any():
        return None
    by_pace = amounts.reshape(*_SHAPE, -1).sum(axis=1)
    standing, approach = rests.power()
    up, down = _per_metre(typical.mean(axis=0), edges, context)
    riding, waiting = _level(ridden, factor, power), _level(rested, factor, power)
    km = np.maximum(amounts[:, _DISTANCE].reshape(_SHAPE).sum(axis=0) / 1000.0, 1e-9)
    return Tables(
        per_km=_corrected(predicted.reshape(_SHAPE), amounts, grid, factor, power),
        climbed_per_km=_over(by_pace[:, _GAINED], by_pace[:, _DISTANCE] / 1000.0),
        descended_per_km=_over(by_pace[:, _LOST], by_pace[:, _DISTANCE] / 1000.0),
        up=up,
        down=down,
        start=0.0,
        standing=standing,
        approach=approach,
        factor=factor * riding,
        power=power * riding,
        resting_factor=factor * waiting,
        resting_power=power * waiting,
        all_per_km=_ratio(both[:, MEASURED], km, USUAL_KM, both[:, MEASURED].sum() / km.sum()),
        all_power=_ratio(
            both[:, MEASURED], both[:, HOURS], 1.0, both[:, MEASURED].sum() / max(both[:, HOURS].sum(), 1e-9)
        ),
        pause=rests.pause(),
    )


def fitted(tables: Tables, equations: Floats) -> Tables:
    """Return tables whose terms fit what rides took, drawn to what they were.

    An average over the rides about a knot is blurred by how far from it they were; a fit is not.

    Parameters
    ----------
    tables : Tables
    equations : (TERMS, TERMS + 1) float
        Normal equations of energy on the kilometres in each cell, climbs and beginnings: matrix and right-hand side,
        each ride over the variance of its energy.
    """
    prior = np.concatenate([tables.per_km.ravel(), [tables.up, tables.down, tables.start]])
    precision = np.concatenate([PRIOR_CELL * np.maximum(tables.per_km.ravel(), LEAST), PRIOR_EXTRAS]) ** -2.0
    found = np.linalg.solve(equations[:, :-1] + np.diag(precision), equations[:, -1] + precision * prior)
    up, down, start = found[CELLS:].tolist()
    per_km = np.maximum(found[:CELLS], LEAST).reshape(_SHAPE)
    return tables._replace(per_km=per_km, up=up, down=down, start=start)


def _corrected(per_km: Floats, amounts: Floats, grid: Floats, factor: Floats, power: Floats) -> Floats:
    """Return the energy of a kilometre at each pace and temperature, by the model and by what was measured. [kWh/km]"""
    hours = _over(amounts[:, _DURATION] / 3600.0, amounts[:, _DISTANCE] / 1000.0).reshape(_SHAPE)
    expected = np.maximum(grid[..., PREDICTED] * factor + grid[..., HOURS] * power, 0.0)
    own = (grid[..., MEASURED] + PRIOR_KWH) / (expected + PRIOR_KWH)
    return _filled((per_km * factor + hours * power) * own)


def _over(above: Floats, below: Floats) -> Floats:
    """Return a quotient, 0 where there is nothing below."""
    return np.divide(above, below, out=np.zeros(len(above)), where=below > 0.0)


def _regressed(sums: Floats) -> tuple[Floats, Floats]:
    """Return by what predicted energy is to be multiplied, and what power added, at each temperature.

    Least squares, drawn to the fit over all temperatures, and that to the model as it is.
    """
    whole = _solved(sums.sum(axis=0), np.array([1.0, 0.0]))
    both = np.array([_solved(row, whole) for row in sums])
    return both[:, 0], both[:, 1]


def _level(sums: Floats, factor: Floats, power: Floats) -> Floats:
    """Return measured over corrected energy at each temperature, drawn to that over all."""
    expected = np.maximum(sums[:, PREDICTED] * factor + sums[:, HOURS] * power, 0.0)
    whole = float((sums[:, MEASURED].sum() + PRIOR_KWH) / (expected.sum() + PRIOR_KWH))
    return np.clip(_ratio(sums[:, MEASURED], expected, PRIOR_KWH, whole), *CORRECTIONS)


def _solved(row: Floats, prior: Floats) -> Floats:
    """Return factor and power of the sums of a temperature, drawn to a prior."""
    pp, ph, hh, pm, hm = row[3:]
    precision = np.diag(1.0 / np.array(PRIOR) ** 2)
    matrix = np.array([[pp, ph], [ph, hh]]) + precision
    return np.asarray(np.linalg.solve(matrix, np.array([pm, hm]) + precision @ prior))


def _ratio(above: Floats, below: Floats, weight: float, middle: float) -> Floats:
    """Return ratios that are drawn to the middle where little is below."""
    return np.asarray((above + weight * middle) / (below + weight))


def _predicted(amounts: Floats, edges: Floats, context: RunContext) -> Floats:
    """Return the energy of rides of these amounts, (n,), that begin and end as a known one did. [kWh]"""
    n = len(amounts)
    zero: Ints = np.zeros(n, np.int64)
    first, last = np.repeat(edges[:1], n, axis=0), np.repeat(edges[1:], n, axis=0)
    totals = Totals(zero, zero, zero, zero, amounts, first, last, np.zeros((n, 1)))
    unnamed = replace(context, lanes=Lanes([""]))
    return context.model.predict(model_columns(totals, unnamed, context.model.needs))


def _per_metre(typical: Floats, edges: Floats, context: RunContext) -> tuple[float, float]:
    """Return what a metre gained adds to the energy of a ride, and what a metre lost does. [kWh/m]"""
    kind = int(edges[1, EDGES.index("kind")])
    weight = GRAVITY * float(context.cars.parameters_of(np.array([kind])).mass_kg[0])
    rows = np.repeat(typical[np.newaxis], 3, axis=0)
    rows[1, _GAINED] += HILL
    rows[2, _LOST] += HILL
    for name, (up, down) in _CLIMBS.items():
        if name in context.effects:
            place = len(AMOUNTS) + list(context.effects).index(name)
            rows[1, place] += up * weight * HILL
            rows[2, place] += down * weight * HILL
    level, gained, lost = _predicted(rows, edges, context)
    return float(gained - level) / HILL, float(lost - level) / HILL


def _filled(grid: Floats) -> Floats:
    """Return a grid whose unknown cells are as the nearest known one, first along pace, then along temperature."""
    out = grid.copy()
    for axis in (0, 1):
        rows = out if axis == 0 else out.T
        for row in rows:
            there = np.flatnonzero(np.isfinite(row))
            if len(there):
                places = np.arange(len(row))
                row[:] = row[there[np.abs(places[:, np.newaxis] - there).argmin(axis=1)]]
    return out
