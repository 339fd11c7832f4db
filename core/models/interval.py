"""Prediction intervals as a model file holds them: a scale of the error, and quantiles of errors over that scale.

The scale says on which rides a model errs more: longer ones, colder ones, those of a vehicle model whose energy is
measured coarsely. The quantiles, of rides by distance, are of errors on rides that the model had not learned from, so
they hold whatever the errors are distributed like. Calibrating is `core.fit.calibration`.

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

from core.batch import Floats
from core.errors import ModelError
from core.models.features import Columns, list_raw_columns

SCALE_TERMS: Final = ("constant", "size_kwh", "size_kwh * heating_need_k")
"""What the scale of an error is a sum of: measuring, length, cold."""
ANY: Final = "*"
"""Stands for every vehicle model without a scale of its own, and so for those never seen."""


class PredictionInterval(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Where the energy of a ride may lie about its prediction.

    Parameters
    ----------
    scales : dict of str to (float, float, float)
        By vehicle model, `*` for every other one: factors of `SCALE_TERMS`. [kWh], [1], [1/K]
    distances_km : tuple of float
        Where each class of rides begins, ascending from 0. [km]
    levels : tuple of float
        Probabilities, ascending. [1]
    quantiles : tuple of tuple of float
        Of measured less predicted energy over the scale, by class of rides and level. [1]
    rides : int
        Calibrated on.

    Raises
    ------
    ValueError
        Where these are no quantiles.
    """

    scales: dict[str, tuple[float, float, float]]
    distances_km: tuple[float, ...]
    levels: tuple[float, ...]
    quantiles: tuple[tuple[float, ...], ...]
    rides: int = 0

    def __post_init__(self) -> None:
        """Refuse what are no quantiles."""
        if ANY not in self.scales:
            raise ValueError(f"interval without a scale for {ANY!r}: calibrate the model anew")
        if len(self.quantiles) != len(self.distances_km) or self.distances_km[:1] != (0.0,):
            raise ValueError(f"interval with quantiles for {len(self.quantiles)} classes of rides: calibrate anew")
        if any(len(row) != len(self.levels) for row in self.quantiles):
            raise ValueError(f"interval with other than {len(self.levels)} quantiles a class: calibrate anew")
        ascending = (self.distances_km, self.levels, *self.quantiles)
        if any(list(row) != sorted(row) for row in ascending):
            raise ValueError("interval with quantiles that do not ascend: calibrate the model anew")
        numbers = [
            *self.levels,
            *(x for row in self.quantiles for x in row),
            *(x for s in self.scales.values() for x in s),
        ]
        if not all(map(isfinite, numbers)):
            raise ValueError("interval with numbers that are not finite: calibrate the model anew")

    @property
    def needs(self) -> tuple[str, ...]:
        """Columns of the ride table that it reads."""
        own = ("vehicle_model",) if set(self.scales) != {ANY} else ()
        return (
            *dict.fromkeys((*list_raw_columns("size_kwh"), *list_raw_columns("heating_need_k"), "distance_km")),
            *own,
        )

    def bounds(self, prediction: Floats, columns: Mapping[str, Any], level: float) -> tuple[Floats, Floats]:
        """Return bounds between which the energy of rides lies with a probability, as much below as above them.

        Parameters
        ----------
        prediction : (n,) float
            [kWh]
        columns : mapping of str to (n,) array
            At least `needs`.
        level : float
            That probability, up to twice the distance of the outermost of `levels` from 1/2.

        Returns
        -------
        lower, upper : (n,) float
            NaN where the prediction is. [kWh]

        Raises
        ------
        ModelError
            Where the level is not among those that were calibrated.
        """
        most = 1.0 - 2.0 * max(self.levels[0], 1.0 - self.levels[-1])
        if not 0.0 < level <= most + 1e-9:
            raise ModelError(f"an interval of level {level:g} was not calibrated: give one above 0, up to {most:g}")
        seen = columns if isinstance(columns, Columns) else Columns(columns)
        scale = self.scale(seen)
        kind = np.searchsorted(self.distances_km, seen["distance_km"], side="right") - 1
        kind = np.clip(kind, 0, len(self.distances_km) - 1)
        low, high = (
            np.array([np.interp(at, self.levels, row) for row in self.quantiles])[kind]
            for at in (0.5 - level / 2.0, 0.5 + level / 2.0)
        )
        return prediction + low * scale, prediction + high * scale

    def scale(self, columns: Columns) -> Floats:
        """Return the scale of the error of rides, (n,). [kWh]"""
        terms = compute_scale_terms(columns)
        own = np.array(self.scales[ANY])
        if set(self.scales) == {ANY}:
            return terms @ own
        table = columns.table["vehicle_model"]
        models = np.asarray(
            table if columns.rows is None else np.asarray(table, dtype=object)[columns.rows], dtype=object
        )
        factors = {model: np.array(self.scales.get(model, own)) for model in set(models.tolist())}
        return np.einsum("ij,ij->i", terms, np.array([factors[model] for model in models]).reshape(-1, len(own)))


def compute_scale_terms(columns: Columns) -> Floats:
    """Return what the scale of an error is a sum of, (n, 3). [1], [kWh], [kWh K]"""
    size = columns["size_kwh"]
    return np.column_stack([np.ones(len(size)), size, size * columns["heating_need_k"]])
