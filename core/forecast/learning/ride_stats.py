"""Learn from rides and idle periods as they end: sums by vehicle model, and the tables made of them daily.

The sums of a ride are added to the two paces and two temperatures around its own, with bilinear weights. Beside the
amounts stand the sums for a regression of measured on predicted energy and, once there are tables, for a regression of
measured energy on the terms of the tables. `socast.core.forecast.learning.leg_energy_fit` turns these sums into the
tables of leg energy.
"""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Floats
from socast.core.columns import ZERO_CELSIUS
from socast.core.forecast.learning.first_tables import FIRST_RELATIVE_SD
from socast.core.forecast.learning.leg_energy import (
    LEAST_KM,
    PACES,
    TEMPERATURES,
    LegEnergyTables,
    compute_knot_weights,
)
from socast.core.forecast.learning.leg_energy_fit import (
    CELLS,
    ENERGY_SUMS,
    FIT_TERMS,
    IDLE_SUMS,
    READING_ENERGY_SD,
    TERMS,
    IdleSums,
    LegEquations,
    RideEdges,
    RideSums,
    as_matrix,
    build_leg_energy_tables,
    fit_leg_energy,
)
from socast.core.forecast.soc_filter import ENERGY_SD
from socast.core.totals.accumulator import EDGES, Totals
from socast.core.totals.context import RunContext
from socast.core.totals.day_sums import DaySums

LEAST_RIDES: Final = 12
"""Rides of a vehicle model below which it has no tables of its own."""
RIDES_OF_A_DAY: Final = 15.0
"""Number of rides that share the weather, the traffic and the car, so that they count as one observation."""
_ENERGIES: Final = ENERGY_SUMS.itemsize // 8
_TIME: Final = EDGES.index("time")
_NUMBERED: Final = [EDGES.index("code"), EDGES.index("kind")]
"""Edges that are numbers of this process."""
STANDING_DISTANCE: Final = 60.0
"""A car that moved less in an idle period stood, as positions wander. [m]"""


class ModelSums:
    """Hold sums over the rides and idle periods of a vehicle model.

    Parameters
    ----------
    width : int
        Number of amounts that are summed of a ride.

    Attributes
    ----------
    sums : DaySums
        Sums by pace and temperature, and those of the normal equations.
    first_edge, last_edge : (edges,) float
        First and last sample of the newest ride.
    """

    def __init__(self, width: int) -> None:
        knots = len(TEMPERATURES)
        self.sums = DaySums(
            ride_amounts=(CELLS, width),
            ride_energy=(CELLS, _ENERGIES),
            idle_energy=(knots, _ENERGIES),
            standing=(knots, IDLE_SUMS.itemsize // 8),
            matrix=(TERMS, TERMS),
            right=(TERMS,),
            counts=(2,),  # of rides, and of idle periods with a measured energy
        )
        self.first_edge, self.last_edge = np.zeros(len(EDGES)), np.zeros(len(EDGES))

    @property
    def rides(self) -> int:
        """Return the number of rides."""
        return int(self.sums.get("counts")[0])

    @property
    def idle_periods(self) -> int:
        """Return the number of idle periods with a measured energy."""
        return int(self.sums.get("counts")[1])

    @property
    def equations(self) -> LegEquations:
        """Return the normal equations of the terms of rides."""
        return LegEquations(self.sums.get("matrix"), self.sums.get("right"))

    @property
    def ride_sums(self) -> RideSums:
        """Return the sums over rides."""
        return RideSums(self.sums.get("ride_amounts"), self.sums.get("ride_energy").view(ENERGY_SUMS)[:, 0])

    @property
    def idle_sums(self) -> IdleSums:
        """Return the sums over idle periods."""
        energy, standing = self.sums.get("idle_energy").view(ENERGY_SUMS), self.sums.get("standing").view(IDLE_SUMS)
        return IdleSums(energy[:, 0], standing[:, 0], float(self.idle_periods))

    def add_weighted(self, name: str, weights: Floats, row: Floats) -> None:
        """Add a row to each row of sums of which the weight is not 0, multiplied by its weight."""
        which = np.flatnonzero(weights)
        self.sums.add(name, weights[which, np.newaxis] * row, (which,))

    def note_ride(self, first: Floats, last: Floats) -> None:
        """Keep the first and last sample of a ride."""
        self.first_edge[:], self.last_edge[:] = first, last

    def build_tables(self, context: RunContext) -> LegEnergyTables | None:
        """Return the tables of leg energy by the model of `context`, None where there are too few plausible rides."""
        if self.rides < LEAST_RIDES:
            return None
        edges = RideEdges(self.first_edge, self.last_edge)
        tables = build_leg_energy_tables(self.ride_sums, self.idle_sums, edges, context)
        if tables is None or not tables.is_plausible():
            return None
        fitted = fit_leg_energy(tables, self.equations)
        shared = FIRST_RELATIVE_SD / np.sqrt(1.0 + self.rides / RIDES_OF_A_DAY)
        return fitted._replace(relative_sd=np.hypot(fitted.relative_sd, shared))

    def dump(self) -> Any:
        """Return the sums as plain values."""
        return self.sums.dump(), self.first_edge.tobytes(), self.last_edge.tobytes()

    def load(self, state: Any) -> None:
        """Replace the sums by those that `dump` returned, of rides of as many amounts."""
        sums, first, last = state
        self.sums.load(sums)
        self.first_edge[:], self.last_edge[:] = np.frombuffer(first), np.frombuffer(last)


class RideStatistics:
    """Sum rides and idle periods by vehicle model, and keep the tables of the last daily update.

    Parameters
    ----------
    width : int
        Number of amounts that are summed of a ride.
    """

    def __init__(self, width: int) -> None:
        self._width = width
        self._sums: dict[str, ModelSums] = {}
        self.tables: dict[str, LegEnergyTables] = {}

    def add_rides(self, models: Sequence[str], rides: Totals, predicted: Floats, measured: Floats) -> None:
        """Add rides that have ended. Rides that waited more than they drove do not count for any pace.

        Units: predicted [kWh], measured [kWh].
        """
        minutes, km = rides.amount("duration") / 60.0, rides.amount("distance") / 1000.0
        pace = np.divide(minutes, km, out=np.full(len(km), np.inf), where=km > LEAST_KM)
        paces, driving = compute_knot_weights(pace, PACES), pace <= PACES[-1]
        ambient, amounts = _compute_temperature_weights(rides), np.nan_to_num(rides.amounts)
        energy = _compute_energy_sums(rides, predicted, measured)
        for i, model in enumerate(models):
            sums = self._get_sums(model)
            if driving[i]:
                weights = np.outer(paces[i], ambient[i]).ravel()
                sums.add_weighted("ride_amounts", weights, amounts[i])
                sums.add_weighted("ride_energy", weights, as_matrix(energy)[i])
            if model in self.tables and np.isfinite(measured[i]):
                self._add_to_equations(model, rides.rows(np.array([i])), ambient[i], measured[i])
            sums.note_ride(rides.first[i], rides.last[i])
            sums.sums.add("counts", 1.0, (0,))

    def _add_to_equations(self, model: str, ride: Totals, ambient: Floats, measured: float) -> None:
        """Add a ride to the normal equations of its terms, with the variance that the present tables predict."""
        metres, seconds, gained, lost = (
            float(ride.amount(name)[0]) for name in ("distance", "duration", "gained", "lost")
        )
        tables, sums = self.tables[model], self._sums[model].sums
        terms = tables.compute_terms(metres / 1000.0, seconds, gained, lost)
        waited = float(terms.waiting * (tables.standing_power @ ambient))
        row = np.zeros(1, FIT_TERMS)
        row["km"][0, terms.knot], row["km"][0, terms.knot + 1] = terms.near_km * ambient, terms.far_km * ambient
        row["climb"], row["descent"], row["start"] = terms.climb, terms.descent, terms.start
        expected = float((row["km"][0] * tables.leg_energy_per_km).sum()) + waited
        weight = 1.0 / (ENERGY_SD**2 * max(expected, 0.0) + READING_ENERGY_SD**2)
        values = as_matrix(row)[0]
        which = np.flatnonzero(values)
        sums.add("matrix", weight * np.outer(values[which], values[which]), np.ix_(which, which))
        sums.add("right", weight * (values[which] * (measured - waited)), (which,))

    def add_idle_periods(self, models: Sequence[str], idle: Totals, predicted: Floats, measured: Floats) -> None:
        """Add idle periods that have ended."""
        ambient, energy = _compute_temperature_weights(idle), _compute_energy_sums(idle, predicted, measured)
        stood = idle.amount("distance") < STANDING_DISTANCE
        standing = np.zeros(len(stood), IDLE_SUMS)
        standing["energy"], standing["hours"] = measured, idle.amount("duration") / 3600.0
        standing["standing_energy"], standing["standing_hours"] = stood * measured, stood * standing["hours"]
        for i, model in enumerate(models):
            sums = self._get_sums(model)
            sums.add_weighted("idle_energy", ambient[i], as_matrix(energy)[i])
            if np.isfinite(measured[i]):
                sums.add_weighted("standing", ambient[i], as_matrix(standing)[i])
                sums.sums.add("counts", 1.0, (1,))

    def _get_sums(self, model: str) -> ModelSums:
        """Return the sums of a vehicle model."""
        if model not in self._sums:
            self._sums[model] = ModelSums(self._width)
        return self._sums[model]

    def update_tables(self, context: RunContext) -> None:
        """Compute the tables of every vehicle model from its sums, for forecasts by the model of `context`."""
        ready = {name: sums for name, sums in self._sums.items() if sums.rides >= LEAST_RIDES}
        built = ((name, sums.build_tables(context)) for name, sums in ready.items())
        # tables that an earlier model learned hold until there are enough rides of the present one
        earlier = {name: tables for name, tables in self.tables.items() if name not in ready}
        self.tables = earlier | {name: tables for name, tables in built if tables is not None}

    def dump(self) -> Any:
        """Return the state as plain values, ordered by name; the order of appearance depends on the batches."""
        tables = {
            name: {field: np.asarray(value).tolist() for field, value in known._asdict().items()}
            for name, known in sorted(self.tables.items())
        }
        return {name: each.dump() for name, each in sorted(self._sums.items())}, tables

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned."""
        sums, tables = state
        self._sums = {name: ModelSums(self._width) for name in sums}
        for name, of_model in self._sums.items():
            of_model.load(sums[name])
        self.tables = {name: _load_tables(fields) for name, fields in tables.items()}


def _load_tables(fields: dict[str, Any]) -> LegEnergyTables:
    """Return tables from plain values."""
    values: dict[str, Any] = {
        name: value if isinstance(value, float) else np.array(value) for name, value in fields.items()
    }
    return LegEnergyTables(**values)


def _compute_temperature_weights(totals: Totals) -> Floats:
    """Return the weight of each of `TEMPERATURES` at the mean outside temperature, (n, temperatures)."""
    return compute_knot_weights(totals.amount("ambient") / totals.amount("duration") - ZERO_CELSIUS, TEMPERATURES)


def _compute_energy_sums(totals: Totals, predicted: Floats, measured: Floats) -> NDArray[np.void]:
    """Return the contribution of each ride or idle period to the energy sums, (n,) ENERGY_SUMS."""
    hours = totals.amount("duration") / 3600.0
    weight = 1.0 / (ENERGY_SD**2 * np.maximum(predicted, 0.0) + READING_ENERGY_SD**2)
    columns = {
        "predicted": predicted,
        "measured": measured,
        "hours": hours,
        "pp": weight * (predicted * predicted),
        "ph": weight * (predicted * hours),
        "hh": weight * (hours * hours),
        "pm": weight * (predicted * measured),
        "hm": weight * (hours * measured),
    }
    known = np.isfinite(predicted) & np.isfinite(measured)
    out = np.zeros(len(known), ENERGY_SUMS)
    for name, values in columns.items():
        out[name] = np.where(known, values, 0.0)
    return out
