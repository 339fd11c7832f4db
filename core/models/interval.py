"""Prediction intervals as a model file holds them: a scale of the error, and quantiles of errors divided by that scale.

The scale tells on which rides a model errs more: longer ones, colder ones, those of a vehicle model whose energy is
measured coarsely. The quantiles, for classes of rides by distance, are of errors on rides that the model was not fitted
to, so they hold for any distribution of errors. `socast.core.fit.calibration` calibrates them.

References
----------
Lei, G'Sell, Rinaldo, Tibshirani, Wasserman 2018, J. Am. Stat. Assoc. 113:1094, DOI 10.1080/01621459.2017.1307116,
section 5.2: conformal intervals with locally varying width.
"""

from collections.abc import Mapping
from math import isfinite
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Floats
from socast.core.errors import ModelError
from socast.core.models.features import Columns, list_raw_columns

ANY: Final = "*"
"""Key of every vehicle model without a fit, a correction or a scale of its own, and so of unseen vehicle models."""


class PredictionInterval(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Bound the energy of a ride about its prediction.

    Parameters
    ----------
    scales : dict of str to (float, float, float)
        Factors of the scale by vehicle model, `*` for every other one: of a constant (measurement) [kWh], of the size
        of the ride [1], and of its size times the heating need (cold) [1/K].
    distances_km : tuple of float
        Lower limit of each class of rides, ascending from 0. [km]
    levels : tuple of float
        Probabilities, ascending. [1]
    quantiles : tuple of tuple of float
        Quantiles of measured minus predicted energy divided by the scale, by class of rides and level. [1]
    rides : int
        Number of rides calibrated on.
    cars : tuple of str
        Cars whose rides the model was fitted to; empty where the model treats all cars alike.
    unseen_car : float
        Factor on the scale for every other car, at least 1. [1]

    Raises
    ------
    ValueError
        Where the numbers are not quantiles.
    """

    scales: dict[str, tuple[float, float, float]]
    distances_km: tuple[float, ...]
    levels: tuple[float, ...]
    quantiles: tuple[tuple[float, ...], ...]
    rides: int = 0
    cars: tuple[str, ...] = ()
    unseen_car: float = 1.0

    def __post_init__(self) -> None:
        """Refuse numbers that are not quantiles."""
        if ANY not in self.scales:
            raise ValueError(f"interval without a scale for {ANY!r}: calibrate the model again")
        if len(self.quantiles) != len(self.distances_km) or self.distances_km[:1] != (0.0,):
            raise ValueError(f"interval with quantiles for {len(self.quantiles)} classes of rides: calibrate again")
        if any(len(row) != len(self.levels) for row in self.quantiles):
            raise ValueError(f"interval without {len(self.levels)} quantiles for each class: calibrate again")
        ascending = (self.distances_km, self.levels, *self.quantiles)
        if any(list(row) != sorted(row) for row in ascending):
            raise ValueError("interval with quantiles that do not ascend: calibrate the model again")
        numbers = [
            *self.levels,
            *(x for row in self.quantiles for x in row),
            *(x for s in self.scales.values() for x in s),
            self.unseen_car,
        ]
        if not all(map(isfinite, numbers)):
            raise ValueError("interval with numbers that are not finite: calibrate the model again")

    @property
    def needs(self) -> tuple[str, ...]:
        """Columns of the ride table that it reads."""
        names = [*list_raw_columns("size_kwh"), *list_raw_columns("heating_need_k"), "distance_km"]
        names += ["vehicle_model"] if set(self.scales) != {ANY} else []
        names += ["vehicle_id"] if self.cars else []
        return tuple(dict.fromkeys(names))

    def bounds(self, prediction: Floats, columns: Mapping[str, Any], level: float) -> tuple[Floats, Floats]:
        """Return central bounds of the energy of rides for a given probability.

        Parameters
        ----------
        prediction : (n,) float
            Predicted energy. [kWh]
        columns : mapping of str to (n,) array
            At least `needs`.
        level : float
            Probability that the energy lies between the bounds, up to twice the distance of the outermost of `levels`
            from 1/2. [1]

        Returns
        -------
        lower, upper : (n,) float
            Bounds, NaN where the prediction is NaN. [kWh]

        Raises
        ------
        ModelError
            Where the level is beyond the calibrated ones.
        """
        most = 1.0 - 2.0 * max(self.levels[0], 1.0 - self.levels[-1])
        if not 0.0 < level <= most + 1e-9:
            raise ModelError(f"an interval of level {level:g} was not calibrated: give a level above 0, up to {most:g}")
        seen = columns if isinstance(columns, Columns) else Columns(columns)
        scale = self.scale(seen)
        low, high = self.get_quantiles(seen["distance_km"], level)
        return prediction + low * scale, prediction + high * scale

    def get_quantiles(self, distance_km: Floats, level: float) -> tuple[Floats, Floats]:
        """Return the ends of the central interval of errors over their scale, by the length of each ride. [1]"""
        kind = np.searchsorted(self.distances_km, distance_km, side="right") - 1
        kind = np.clip(kind, 0, len(self.distances_km) - 1)
        low, high = (
            np.array([np.interp(at, self.levels, row) for row in self.quantiles])[kind]
            for at in (0.5 - level / 2.0, 0.5 + level / 2.0)
        )
        return low, high

    def scale(self, columns: Columns) -> Floats:
        """Return the scale of the error of each ride, (n,). [kWh]"""
        terms = compute_scale_terms(columns)
        general = np.array(self.scales[ANY])
        stretch: Floats | float = 1.0
        if self.cars and self.unseen_car != 1.0:
            known = set(self.cars)
            stretch = np.array([1.0 if car in known else self.unseen_car for car in _names(columns, "vehicle_id")])
        if set(self.scales) == {ANY}:
            return np.asarray(stretch * (terms @ general))
        models = _names(columns, "vehicle_model")
        factors = {model: np.array(self.scales.get(model, general)) for model in set(models.tolist())}
        rows = np.array([factors[model] for model in models]).reshape(-1, len(general))
        return np.asarray(stretch * np.einsum("ij,ij->i", terms, rows))


def _names(columns: Columns, name: str) -> NDArray[np.object_]:
    """Return a column of names of the rows."""
    values = np.asarray(columns.table[name], dtype=object)
    return np.asarray(values if columns.rows is None else values[columns.rows], dtype=object)


def compute_scale_terms(columns: Columns) -> Floats:
    """Return the terms of the scale, (n, 3): a constant [1], size [kWh], and size times heating need [kWh K]."""
    size = columns["size_kwh"]
    return np.column_stack([np.ones(len(size)), size, size * columns["heating_need_k"]])
