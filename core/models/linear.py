"""Models: sums of products of ride-table columns, and the JSON file that a person can read.

Every model of the paper is linear in columns; they differ in which columns, which products of them, and which
coefficients are fitted. So a model is a tuple of terms, each a product of columns, and for each vehicle model a fit:
one coefficient a term, and what stands for unknown values. A vehicle's own parameter is one more column of the
product. What is fitted past that (accessory curve, factors of single cars, boosted trees, intervals) is optional.
"""

from collections.abc import Iterator, Mapping
from functools import cached_property
from types import MappingProxyType
from typing import Any, Final, cast

import msgspec
import numpy as np

from core.batch import Floats
from core.errors import ModelError
from core.models.features import EFFECT_PREFIX, Columns, Table, list_raw_columns
from core.models.interval import PredictionInterval
from core.models.trees import Trees
from core.vehicles import AccessoryCurve

FORMAT: Final = 2
"""Version of the model file that this version of the product reads and writes."""

ANY: Final = "*"
"""Stands for every vehicle model that has no fit of its own."""
VEHICLE_MODEL: Final = "vehicle_model"
VEHICLE: Final = "vehicle_id"


class Term(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One addend of a model: a product of columns, to be multiplied with a coefficient.

    Parameters
    ----------
    name : str
        Of the term, among those of its model.
    columns : tuple of str
        Columns of the ride table, or derived ones (`core.models.features`); one may stand twice. None at all is a constant.
    unit : str
        Of the coefficient, as pint spells it.
    """

    name: str
    columns: tuple[str, ...]
    unit: str


class Curve(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The seven numbers of `core.vehicles.AccessoryCurve`. [K], [W]"""

    heating_full: float
    heating_off: float
    cooling_on: float
    cooling_full: float
    heating: float
    standby: float
    cooling: float

    def to_curve(self) -> AccessoryCurve:
        """Return the curve itself."""
        return AccessoryCurve(**msgspec.structs.asdict(self))


class Fit(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What was fitted to the rides of one vehicle model, or of all.

    Parameters
    ----------
    coefficients : tuple of float
        One a term.
    covariance : tuple of tuple of float, optional
        Of the coefficients, given the curve and the fills.
    clusters : int, optional
        Groups of rides within which the covariance lets errors depend on each other; None where it lets none.
    fills : dict of str to float
        Column to the value that stands for an unknown (NaN) one; a column that is not here stays NaN.
    curve : Curve, optional
        Accessory power of `accessories_kwh`.
    rides : int
        Fitted to.
    residual_sd_kwh : float, optional
        Standard deviation of what the fit leaves, in sample. [kWh]
    held : tuple of str
        Terms that whole rides do not tell, whose coefficients are held near those of physics.
    noise_kwh : float, optional
        Variance of the error over the ride's size (`core.models.derived_features.compute_size`), where rides were weighed by it. [kWh]
    """

    coefficients: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...] | None = None
    clusters: int | None = None
    fills: dict[str, float] = {}
    curve: Curve | None = None
    rides: int = 0
    residual_sd_kwh: float | None = None
    held: tuple[str, ...] = ()
    noise_kwh: float | None = None


class Training(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What a model was fitted to.

    Parameters
    ----------
    rides : int
    first_date, last_date : str
        ISO, UTC.
    vehicle_models : dict of str to int
        Rides of each.
    fingerprint : str
        SHA-256 of the training columns, as read.
    filled : dict of str to int
        Rides in which a column was unknown, and filled.
    left_out : dict of str to int
        Rides that were not trained on, by reason.
    """

    rides: int
    first_date: str
    last_date: str
    vehicle_models: dict[str, int]
    fingerprint: str
    filled: dict[str, int] = {}
    left_out: dict[str, int] = {}


class LinearModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, dict=True):
    """A model that is a sum of terms; what a model file holds.

    Parameters
    ----------
    format : int
        Version of the file.
    name, version : str
        Of the model; a forecast carries both.
    recipe : str
        What it was made by.
    terms : tuple of Term
        In the order in which they are added.
    fits : dict of str to Fit
        By vehicle model; `*` stands for every other one.
    cars : dict of str to float
        Factor on the prediction, by vehicle; 1 for every other one.
    correction : dict of str to Trees, optional
        What is added to the sum, by vehicle model; `*` stands for every other one.
    interval : Interval, optional
        How far off predictions are.
    training : Training, optional
        What it was fitted to.
    history : tuple of dict
        What was done to it, oldest first: each a plain JSON object.
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
        found = [raw for column in read for raw in list_raw_columns(column)]
        if self._groups:
            found.append(VEHICLE_MODEL)
        if self.cars:
            found.append(VEHICLE)
        return tuple(dict.fromkeys(found))

    @cached_property
    def effects(self) -> tuple[str, ...]:
        """Names of the effects whose energy it reads."""
        return tuple(c.removeprefix(EFFECT_PREFIX) for c in self.needs if c.startswith(EFFECT_PREFIX))

    @cached_property
    def _groups(self) -> tuple[str, ...]:
        """Vehicle models that have something of their own."""
        return tuple(dict.fromkeys(key for key in (*self.fits, *(self.correction or {})) if key != ANY))

    def predict(self, columns: Table) -> Floats:
        """Return the energy of rides, or of any part of one for which the same columns are known, as if it were a ride.

        Parameters
        ----------
        columns : mapping of str to (n,) array
            At least `needs`, as the ride table names them: `effect_<name>` [kWh per unit of its coefficient],
            `rolling_resistance` [1], `drag_area_m2` [m^2] and so on. A `DataFrame` will do.

        Returns
        -------
        (n,) float
            Row by row: the result is the same to the bit however rows are cut into blocks. NaN where a needed column
            is and no fill stands for it, and for a vehicle model that no fit stands for. [kWh]

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
        if not self._groups:
            return self._scaled(self._predict(ANY, Columns(columns), _length(columns, self.needs)), columns)
        total = np.full(_length(columns, self.needs), np.nan)
        for key, rows in self._rows(columns):
            total[rows] = self._predict(key, Columns(columns, rows=rows), len(rows))
        return self._scaled(total, columns)

    def predict_interval(self, columns: Table, level: float = 0.9) -> tuple[Floats, Floats]:
        """Return bounds between which the energy of a ride lies with a probability.

        Parameters
        ----------
        columns : mapping of str to (n,) array
            As for `predict`, and what `interval` needs.
        level : float
            That probability.

        Returns
        -------
        lower, upper : (n,) float
            [kWh]

        Raises
        ------
        ModelError
            Where the model has no interval, or a needed column is absent.
        """
        if self.interval is None:
            raise ModelError(f"model {self.name} has no prediction interval: fit one that is calibrated")
        if missing := [name for name in self.interval.needs if name not in columns]:
            raise ModelError(f"model {self.name}: its interval needs column {missing[0]!r}: make the tables anew")
        return self.interval.bounds(self.predict(columns), cast("Mapping[str, Any]", columns), level)

    def _rows(self, columns: Table) -> Iterator[tuple[str, Any]]:
        """Give each vehicle model that has something of its own, `*` for the others, and its rows."""
        name = np.asarray(columns[VEHICLE_MODEL], dtype=object)
        left = np.ones(len(name), np.bool_)
        for key in self._groups:
            here = name == key
            left &= ~here
            if here.any():
                yield key, np.flatnonzero(here)
        if left.any():
            yield ANY, np.flatnonzero(left)

    def _predict(self, key: str, columns: Columns, rows: int) -> Floats:
        """Return the energy of rides of one vehicle model. [kWh]"""
        fit = self.fits.get(key) or self.fits.get(ANY)
        if fit is None:
            return np.full(rows, np.nan)
        curve = None if fit.curve is None else fit.curve.to_curve()
        seen = Columns(columns.table, fit.fills, curve, columns.rows)
        total = np.zeros(rows)
        for term, coefficient in zip(self.terms, fit.coefficients, strict=True):
            product = np.full(rows, coefficient)
            for name in term.columns:
                product *= seen[name]
            total += product
        trees = self.correction and (self.correction.get(key) or self.correction.get(ANY))
        if trees:
            total += trees.predict(Columns(columns.table, None, curve, columns.rows))
        return total

    def _scaled(self, total: Floats, columns: Table) -> Floats:
        """Return predictions times the factors of their cars."""
        if self.cars:
            total *= np.array([self.cars.get(vehicle, 1.0) for vehicle in np.asarray(columns[VEHICLE], dtype=object)])
        return total


def _length(columns: Table, needs: tuple[str, ...]) -> int:
    """Return the number of rows."""
    names = needs[:1] or tuple(columns)[:1]
    return len(columns[names[0]]) if names else 0


def make_physical_term(name: str, columns: tuple[str, ...]) -> Term:
    """Return a term whose coefficient is 1 where physics holds."""
    return Term(name=name, columns=columns, unit="1")


def _as_physics_has_it(terms: tuple[Term, ...]) -> dict[str, Fit]:
    """Return the fit with coefficients 1, for every vehicle model."""
    return {ANY: Fit(coefficients=(1.0,) * len(terms))}


BASIC_TERMS: Final = (
    make_physical_term("rolling", ("effect_rolling", "rolling_resistance")),
    make_physical_term("climbing", ("effect_climbing",)),
    make_physical_term("aero_drag", ("effect_aero_drag", "drag_area_m2")),
    make_physical_term("inertia", ("effect_inertia",)),
)
_EXTENDED_TERMS: Final = (*BASIC_TERMS, make_physical_term("accessories", ("effect_accessories",)))

BASIC_PHYSICAL: Final = LinearModel(
    name="basic_physical",
    version="1",
    recipe="basic_physical",
    terms=BASIC_TERMS,
    fits=_as_physics_has_it(BASIC_TERMS),
)
"""Basic physical model, eq. (1) and section 4.1 of the paper: energy at the wheels, with the catalogue's parameters."""

EXTENDED_PHYSICAL: Final = LinearModel(
    name="extended_physical",
    version="1",
    recipe="extended_physical",
    terms=_EXTENDED_TERMS,
    fits=_as_physics_has_it(_EXTENDED_TERMS),
)
"""Extended physical model, section 4.2 of the paper, with the reference accessory curve; `core.fit` fits a curve."""

BUILT_IN_MODELS: Final[Mapping[str, LinearModel]] = MappingProxyType(
    {m.name: m for m in (BASIC_PHYSICAL, EXTENDED_PHYSICAL)}
)
"""Models that need no fitting and come with the product, by name."""
