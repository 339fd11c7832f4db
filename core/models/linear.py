"""Linear consumption models: sums of products of ride-table columns, and the contents of a model file.

Every model of the paper is linear in columns. Models differ in which columns they use, which products of them, and
which coefficients are fitted. A model therefore is a tuple of terms, each a product of columns, and one fit for each
vehicle model: one coefficient per term, and the values that replace unknown ones. A vehicle parameter enters as one
more column of the product. Everything fitted beyond the paper (accessory curve, factors of single cars, boosted trees,
prediction intervals) is optional.
"""

from collections.abc import Iterator, Mapping
from functools import cached_property
from typing import Any, Final, cast

import msgspec
import numpy as np
import pandas as pd
from msgspec import UNSET, UnsetType

from socast.core.batch import Floats, Table
from socast.core.errors import ModelError
from socast.core.models.features import EFFECT_PREFIX, Columns, list_raw_columns
from socast.core.models.interval import ANY, PredictionInterval
from socast.core.models.limit import LIMIT_NEEDS, EnergyLimit
from socast.core.models.trees import Trees
from socast.core.vehicles import AccessoryCurve

FORMAT: Final = 2
"""Version of the model-file format that this version of the product reads and writes."""
VEHICLE_MODEL: Final = "vehicle_model"
VEHICLE: Final = "vehicle_id"
CORRECTION: Final = "learned correction"
"""Name of the part of a prediction that the boosted trees of a model add."""


class Term(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Describe one summand of a model: a product of columns, to be multiplied by a coefficient.

    Parameters
    ----------
    name : str
        Name of the term, unique within its model.
    columns : tuple of str
        Columns of the ride table, or derived ones (`socast.core.models.features`). A column may occur twice; an empty
        tuple is a constant.
    unit : str
        Unit of the coefficient, as pint spells it.
    """

    name: str
    columns: tuple[str, ...]
    unit: str


class Fit(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Hold the results of fitting a model to the rides of one vehicle model, or of all.

    Parameters
    ----------
    coefficients : tuple of float
        One coefficient per term.
    covariance : tuple of tuple of float, optional
        Covariance of the coefficients, given the accessory curve and the fills.
    clusters : int, optional
        Number of groups of rides within which the covariance lets errors depend on each other; None where it treats
        errors as independent.
    fills : dict of str to float
        Column to the value that replaces its unknown (NaN) values. A column without an entry stays NaN.
    curve : AccessoryCurve, optional
        Accessory power of the column `accessories_kwh`.
    rides : int
        Number of rides fitted to.
    residual_sd_kwh : float, optional
        Standard deviation of the in-sample residuals. [kWh]
    held : tuple of str
        Terms that whole rides do not identify, whose coefficients a prior fixes near those of physics.
    dropped : tuple of str, optional
        Terms whose column was constant, or nothing but rounding, in all rides; their coefficients are 0. Absent where
        there are none.
    limit : EnergyLimit, optional
        Largest energy that the fit predicts. Absent where there is none, as in models of earlier releases.
    noise_kwh : float, optional
        Variance of a ride's error divided by its size (`socast.core.models.features.compute_size`), where rides
        were weighted by their size. [kWh]
    limited : tuple of str
        Terms, and numbers of the accessory curve, that stopped at an end of their plausible ranges. The data alone
        would put them beyond.
    converged : bool
        Whether an iterative fit ended at the most probable coefficients; False marks a fit that is not to be trusted.
    """

    coefficients: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...] | None = None
    clusters: int | None = None
    fills: dict[str, float] = {}
    curve: AccessoryCurve | None = None
    rides: int = 0
    residual_sd_kwh: float | None = None
    held: tuple[str, ...] = ()
    dropped: tuple[str, ...] | UnsetType = UNSET
    limit: EnergyLimit | UnsetType = UNSET
    noise_kwh: float | None = None
    limited: tuple[str, ...] = ()
    converged: bool = True


class Training(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Describe the rides that a model was fitted to.

    Parameters
    ----------
    rides : int
        Number of rides.
    first_date, last_date : str
        Dates of the first and the last ride, ISO 8601, UTC.
    vehicle_models : dict of str to int
        Number of rides of each vehicle model.
    fingerprint : str
        SHA-256 of the training columns, as read.
    filled : dict of str to int
        Number of rides in which a column was unknown and was filled.
    left_out : dict of str to int
        Number of rides excluded from training, by reason.
    """

    rides: int
    first_date: str
    last_date: str
    vehicle_models: dict[str, int]
    fingerprint: str
    filled: dict[str, int] = {}
    left_out: dict[str, int] = {}


class LinearModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, dict=True):
    """Predict energy by a sum of terms. The fields are those of a model file.

    Parameters
    ----------
    format : int
        Version of the file format.
    name, version : str
        Name and version of the model; every forecast carries both.
    recipe : str
        Recipe that made the model.
    terms : tuple of Term
        Terms in the order of their summation.
    fits : dict of str to Fit
        Fits by vehicle model; `*` applies to every other one.
    cars : dict of str to float
        Factor on the prediction by vehicle; 1 for every other one. [1]
    correction : dict of str to Trees, optional
        Boosted trees by vehicle model, added to the sum; `*` applies to every other one.
    interval : PredictionInterval, optional
        Calibrated prediction interval.
    training : Training, optional
        Rides that the model was fitted to.
    history : tuple of dict
        Changes made to the model, oldest first, each a plain JSON object.
    """

    format: int = FORMAT
    name: str
    version: str
    recipe: str
    terms: tuple[Term, ...]
    fits: dict[str, Fit]
    cars: dict[str, float] = {}
    correction: dict[str, Trees] | None = None
    interval: PredictionInterval | None = None
    training: Training | None = None
    history: tuple[dict[str, Any], ...] = ()

    @cached_property
    def needs(self) -> tuple[str, ...]:
        """Columns of the ride table that it reads, each once, in the order of the terms."""
        read = [column for term in self.terms for column in term.columns]
        for trees in (self.correction or {}).values():
            read += trees.needs
        raw = [name for column in read for name in list_raw_columns(column)]
        if self.is_limited:
            raw += LIMIT_NEEDS
        if self._groups:
            raw.append(VEHICLE_MODEL)
        if self.cars:
            raw.append(VEHICLE)
        return tuple(dict.fromkeys(raw))

    @cached_property
    def effects(self) -> tuple[str, ...]:
        """Names of the effects whose energy it reads."""
        return tuple(c.removeprefix(EFFECT_PREFIX) for c in self.needs if c.startswith(EFFECT_PREFIX))

    @cached_property
    def is_limited(self) -> bool:
        """Whether a fit limits its predictions."""
        return any(fit.limit for fit in self.fits.values())

    @cached_property
    def _groups(self) -> tuple[str, ...]:
        """Vehicle models that have a fit or a correction of their own."""
        return tuple(dict.fromkeys(key for key in (*self.fits, *(self.correction or {})) if key != ANY))

    def predict(self, rides: pd.DataFrame) -> "pd.Series[float]":
        """Return the energy of rides, with the index of the table.

        Parameters
        ----------
        rides : (n, columns) DataFrame
            Ride table with at least the columns `needs`.

        Returns
        -------
        (n,) Series
            Energy, see `predict_energy`. [kWh]

        Raises
        ------
        ModelError
            Where a needed column is absent.
        """
        return pd.Series(self.predict_energy(rides), index=rides.index, name="energy_predicted_kwh")

    def predict_energy(self, columns: Table) -> Floats:
        """Return the energy of rides, or of any part of a ride for which the same columns are known.

        Parameters
        ----------
        columns : mapping of str to (n,) array
            At least `needs`, named as in the ride table: `effect_<name>` [kWh per unit of its coefficient],
            `rolling_resistance` [1], `drag_area_m2` [m^2] and so on. A `DataFrame` will do.

        Returns
        -------
        (n,) float
            Energy of each row, the same to the bit however rows are cut into blocks. NaN where a needed column is NaN
            and has no fill, and for a vehicle model without a fit where there is no fit `*`. Never beyond
            `compute_limits`. [kWh]

        Raises
        ------
        ModelError
            Where a needed column is absent.
        """
        if missing := [name for name in self.needs if name not in columns]:
            raise ModelError(
                f"model {self.name}: column {missing[0]!r} is missing in the data: make the tables with this model's "
                "effects"
            )
        if self._groups:
            total = np.full(_length(columns, self.needs), np.nan)
            for key, rows, count in self._rows(columns):
                total[rows] = self._predict(key, Columns(columns, rows=rows), count)
        else:  # in one step, which takes less time for each call of the live path
            total = self._predict(ANY, Columns(columns), _length(columns, self.needs))
        energy = self._scale_by_car(total, columns)
        if not self.is_limited:
            return energy
        most = self.compute_limits(columns)
        return np.clip(energy, -most, most)

    def compute_limits(self, columns: Table) -> Floats:
        """Return the largest energy that the model predicts for rides, taken from the battery or returned to it.

        Parameters
        ----------
        columns : mapping of str to (n,) array
            As for `predict`.

        Returns
        -------
        (n,) float
            Infinite where there is no limit; a prediction that equals it was outside. [kWh]
        """
        most = np.full(_length(columns, self.needs), np.inf)
        for key, rows, _ in self._rows(columns):
            fit = self._fit(key)
            if fit is not None and fit.limit:
                seen = Columns(columns, rows=rows)
                most[rows] = fit.limit.compute_energy(*(seen[name] for name in LIMIT_NEEDS))
        return most

    def count_limited(self, columns: Table, energy: Floats) -> int:
        """Return the number of predicted energies that stopped at their limit."""
        return int(np.sum(np.abs(energy) >= self.compute_limits(columns))) if self.is_limited else 0

    def predict_parts(self, columns: Table) -> dict[str, Floats]:
        """Return the energy of each term, and of the correction by trees where the model has one.

        Parameters
        ----------
        columns : mapping of str to (n,) array
            As for `predict`.

        Returns
        -------
        dict of str to (n,) float
            Energy by name of the term; the parts sum to the prediction, also where this stopped at its limit. NaN for
            a car without a fit. [kWh]
        """
        names = [term.name for term in self.terms] + ([CORRECTION] if self.correction else [])
        parts = {name: np.full(_length(columns, self.needs), np.nan) for name in names}
        for key, rows, count in self._rows(columns):
            fit = self._fit(key)
            if fit is None:
                continue
            seen = Columns(columns, fit.fills, fit.curve, rows)
            for term, energy in self._term_energies(fit, seen, count):
                parts[term.name][rows] = energy
            if self.correction:
                trees = self._trees(key)
                parts[CORRECTION][rows] = trees.predict(Columns(columns, None, fit.curve, rows)) if trees else 0.0
        parts = {name: self._scale_by_car(energy, columns) for name, energy in parts.items()}
        total, most = np.abs(sum(parts.values())), self.compute_limits(columns)
        share = np.divide(most, total, out=np.ones(len(total)), where=total > most)
        return {name: energy * share for name, energy in parts.items()}

    def predict_interval(self, columns: Table, level: float = 0.9) -> tuple[Floats, Floats]:
        """Return bounds between which the energy of a ride lies with a given probability.

        Parameters
        ----------
        columns : mapping of str to (n,) array
            As for `predict`, and the columns that `interval` needs.
        level : float
            Probability that the energy lies between the bounds. [1]

        Returns
        -------
        lower, upper : (n,) float
            Bounds. [kWh]

        Raises
        ------
        ModelError
            Where the model has no interval, or a needed column is absent.
        """
        if self.interval is None:
            raise ModelError(f"model {self.name} has no prediction interval: fit one that is calibrated")
        if missing := [name for name in self.interval.needs if name not in columns]:
            raise ModelError(f"model {self.name}: its interval needs column {missing[0]!r}: make the tables again")
        return self.interval.bounds(self.predict_energy(columns), cast("Mapping[str, Any]", columns), level)

    def _rows(self, columns: Table) -> Iterator[tuple[str, Any, int]]:
        """Yield each vehicle model with something of its own, its rows and their number, then `*` and the others."""
        if not self._groups:
            yield ANY, slice(None), _length(columns, self.needs)
            return
        name = np.asarray(columns[VEHICLE_MODEL], dtype=object)
        left = np.ones(len(name), np.bool_)
        for key in self._groups:
            here = name == key
            left &= ~here
            if here.any():
                yield key, np.flatnonzero(here), int(here.sum())
        if left.any():
            yield ANY, np.flatnonzero(left), int(left.sum())

    def _fit(self, key: str) -> Fit | None:
        """Return the fit that applies to a vehicle model."""
        return self.fits.get(key) or self.fits.get(ANY)

    def _trees(self, key: str) -> Trees | None:
        """Return the trees that correct the prediction for a vehicle model."""
        return None if not self.correction else self.correction.get(key) or self.correction.get(ANY)

    def _term_energies(self, fit: Fit, columns: Columns, rows: int) -> Iterator[tuple[Term, Floats]]:
        """Yield each term with its energy in each row. [kWh]"""
        for term, coefficient in zip(self.terms, fit.coefficients, strict=True):
            product = np.full(rows, coefficient)
            for name in term.columns:
                product *= columns[name]
            yield term, product

    def _predict(self, key: str, columns: Columns, rows: int) -> Floats:
        """Return the energy of rides of one vehicle model. [kWh]"""
        fit = self._fit(key)
        if fit is None:
            return np.full(rows, np.nan)
        seen = Columns(columns.table, fit.fills, fit.curve, columns.rows)
        total = np.zeros(rows)
        for _, energy in self._term_energies(fit, seen, rows):
            total += energy
        trees = self._trees(key)
        if trees:
            total += trees.predict(Columns(columns.table, None, fit.curve, columns.rows))
        return total

    def _scale_by_car(self, total: Floats, columns: Table) -> Floats:
        """Return energies multiplied by the factors of their cars."""
        if self.cars:
            total *= np.array([self.cars.get(vehicle, 1.0) for vehicle in np.asarray(columns[VEHICLE], dtype=object)])
        return total


def _length(columns: Table, needs: tuple[str, ...]) -> int:
    """Return the number of rows."""
    names = needs[:1] or tuple(columns)[:1]
    return len(columns[names[0]]) if names else 0
