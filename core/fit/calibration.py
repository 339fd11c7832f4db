"""Calibration of prediction intervals, on rides that a model had not learned from.

Each ride's error is of a model fitted without it: by cross-validation, or, for least squares, by the leverage of the
ride, which is the same at the cost of one fit.
The errors over their scale give the quantiles.

For vehicle models never seen there is a scale of its own, from errors of fits without the vehicle model.

References
----------
Barber, Candes, Ramdas, Tibshirani 2021, Annals of Statistics 49:486, DOI 10.1214/20-AOS1965: CV+ and jackknife+; here
their errors are laid about the prediction of the one model that is fitted to all rides.
Cook, Weisberg, Residuals and Influence in Regression, Chapman and Hall 1982, eq. (2.2.2): leverage.
"""

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
import pandas as pd
from scipy.optimize import nnls

from core.batch import Floats, Ints
from core.fit.fitting import build_design
from core.fit.regression import CUTOFF
from core.fit.ride_blocks import ENERGY, get_names, get_numbers, select_trainable
from core.models import ANY, VEHICLE_MODEL, LinearModel, stamp
from core.models.features import Columns, list_raw_columns
from core.models.interval import PredictionInterval, compute_scale_terms

QUANTILE_LEVELS: Final = (
    0.005,
    0.01,
    0.025,
    0.05,
    0.1,
    0.15,
    0.25,
    0.375,
    0.5,
    0.625,
    0.75,
    0.85,
    0.9,
    0.95,
    0.975,
    0.99,
    0.995,
)
_CLASSES: Final = (0.0, 5.0, 10.0, 15.0, 20.0)
"""Where classes of rides begin. [km]"""
LEAST_CALIBRATION_RIDES: Final = 100
"""Rides for a class, or a vehicle model, of its own."""
_LEAST_SCALE: Final = 0.01
"""Smallest scale of an error. [kWh]"""
_UNSEEN_LEVEL: Final = 0.9
"""Level at which the scale of vehicle models never seen is set."""
NEEDS: Final = (*list_raw_columns("size_kwh"), *list_raw_columns("heating_need_k"), "distance_km")
"""Columns of the ride table that the scale of an error needs."""
_UNSEEN_FACTOR: Final = 2.0
"""Scale of those over the largest of the others, where there is but one to learn from. Estimated."""


class HeldOutErrors(NamedTuple):
    """Rides of one vehicle model, and the errors of fits that did not see them.

    Parameters
    ----------
    error : (n,) float
        Measured less predicted. [kWh]
    terms : (n, 3) float
        Of the scale, see `core.models.interval.compute_scale_terms`.
    distance : (n,) float
        [km]
    """

    error: Floats
    terms: Floats
    distance: Floats


def collect_errors(error: Floats, columns: Columns) -> HeldOutErrors:
    """Return errors with what their scale depends on; rides of which something is unknown are left out."""
    terms, distance = compute_scale_terms(columns), columns["distance_km"]
    known = np.isfinite(error) & np.isfinite(terms).all(axis=1) & np.isfinite(distance)
    return HeldOutErrors(error[known], terms[known], distance[known])


def calibrate_interval(
    seen: Mapping[str, HeldOutErrors], unseen: Mapping[str, HeldOutErrors]
) -> PredictionInterval | None:
    """Return the interval that errors call for, None where there are too few to tell.

    Parameters
    ----------
    seen : mapping of str to Held
        By vehicle model: errors of fits to other rides, of this vehicle model too.
    unseen : mapping of str to Held
        By vehicle model: errors of fits to other vehicle models.
    """
    every = _joined(seen)
    if len(every.error) < LEAST_CALIBRATION_RIDES:
        return None
    general = _scale(every)
    scales = {key: _scale(own) if len(own.error) >= LEAST_CALIBRATION_RIDES else general for key, own in seen.items()}
    over = np.concatenate([own.error / (own.terms @ scales[key]) for key, own in seen.items()])
    starts = _classes(every.distance)
    kind = np.searchsorted(starts, every.distance, side="right") - 1
    rows = [_quantiles(over[kind == i]) for i in range(len(starts))]
    found = PredictionInterval(
        scales={key: _three(scale) for key, scale in scales.items()} | {ANY: _three(general * _UNSEEN_FACTOR)},
        distances_km=tuple(starts),
        levels=QUANTILE_LEVELS,
        quantiles=tuple(tuple(row.tolist()) for row in rows),
        rides=len(over),
    )
    return found if len(unseen) < 2 else _for_unseen(found, _joined(unseen))


def _three(scale: Floats) -> tuple[float, float, float]:
    constant, by_size, by_cold = scale.tolist()
    return constant, by_size, by_cold


def _joined(parts: Mapping[str, HeldOutErrors]) -> HeldOutErrors:
    """Return all rides together."""
    return HeldOutErrors(*(np.concatenate(columns) for columns in zip(*parts.values(), strict=True)))


def _scale(rides: HeldOutErrors) -> Floats:
    """Return the factors of the scale: least squares of absolute errors, none below 0, each over about its size."""
    weight = 1.0 / (_LEAST_SCALE + rides.terms[:, 1])
    found, _ = nnls(rides.terms * weight[:, np.newaxis], np.abs(rides.error) * weight)
    return np.maximum(found, np.array([_LEAST_SCALE, 0.0, 0.0]))


def _classes(distance: Floats) -> list[float]:
    """Return where classes begin, so that each has rides enough; the last ones are joined where they have not."""
    starts = list(_CLASSES)
    while len(starts) > 1:
        count = np.bincount(np.searchsorted(starts, distance, side="right") - 1, minlength=len(starts))
        few = [i for i in range(len(starts)) if count[i] < LEAST_CALIBRATION_RIDES]
        if not few:
            break
        del starts[max(few[-1], 1)]
    return starts


def _quantiles(over: Floats) -> Floats:
    """Return quantiles of errors over their scale, so far out that one more ride is within with the probability."""
    ordered, n, levels = np.sort(over), len(over), np.array(QUANTILE_LEVELS)
    above = np.ceil((n + 1) * levels) - 1.0
    below = np.floor((n + 1) * levels) - 1.0
    rank = np.where(levels > 0.5, above, np.where(levels < 0.5, below, (n - 1) / 2.0))
    return ordered[np.clip(rank, 0, n - 1).astype(np.int64)]


def _for_unseen(interval: PredictionInterval, unseen: HeldOutErrors) -> PredictionInterval:
    """Return the interval with a scale that holds for vehicle models never seen, but never less than for others."""
    scale = _scale(unseen)
    kind = np.searchsorted(interval.distances_km, unseen.distance, side="right") - 1
    table = np.array(interval.quantiles)[kind]
    low, high = (
        np.array([np.interp(at, interval.levels, row) for row in table])
        for at in (0.5 - _UNSEEN_LEVEL / 2, 0.5 + _UNSEEN_LEVEL / 2)
    )
    over = unseen.error / (unseen.terms @ scale)
    factors = np.where(over > 0.0, over / np.maximum(high, 1e-9), over / np.minimum(low, -1e-9))
    factor = float(np.quantile(factors, _UNSEEN_LEVEL))
    usual = [own for key, own in interval.scales.items() if key != ANY]
    widest = np.maximum(scale * factor, np.mean(usual, axis=0))
    return msgspec.structs.replace(interval, scales=interval.scales | {ANY: _three(widest)})


def add_interval(model: LinearModel, rides: pd.DataFrame, *, fitted: bool = True) -> LinearModel:
    """Return a model of least squares with an interval, calibrated by the leverage of each ride.

    Parameters
    ----------
    model : LinearModel
        Each fit by ordinary least squares on the rides of its vehicle model; accessory curve and fills as given.
    rides : DataFrame
        What it was fitted to.
    fitted : bool
        Whether coefficients were fitted at all.

    Returns
    -------
    LinearModel
        As it was, where the rides lack a column that the scale of errors needs, or are too few.
    """
    if any(column not in rides for column in (*NEEDS, ENERGY)):
        return model
    good, _ = select_trainable(rides, [*model.needs, ENERGY])
    kinds = np.array(get_names(good, VEHICLE_MODEL), dtype=object)
    own, every = np.full(len(good), np.nan), np.full(len(good), np.nan)
    for key in sorted(set(kinds)):
        rows = np.flatnonzero(kinds == key)
        own[rows] = _left(model, key if key in model.fits else ANY, good, rows, rows, fitted=fitted)
        every[rows] = _left(model, ANY, good, np.arange(len(good)), rows, fitted=fitted)
    unseen = _by_model(good, every) if ANY in model.fits else {}
    return stamp(msgspec.structs.replace(model, interval=calibrate_interval(_by_model(good, own), unseen)))


def _left(model: LinearModel, key: str, rides: pd.DataFrame, rows: Ints, out: Ints, *, fitted: bool) -> Floats:
    """Return the errors of rides, had a fit to `rows` been made without them: one by one, or all if it has others."""
    fit = model.fits[key]
    table = build_design(model.terms, Columns(rides, fit.fills, fit.curve, rows), len(rows))
    left = get_numbers(rides, ENERGY)[rows] - table @ np.array(fit.coefficients)
    inside = np.searchsorted(rows, out)
    if not fitted:
        return left[inside]
    scale = np.sqrt(np.maximum((table**2).sum(axis=0), 1e-300))
    values, vectors = np.linalg.eigh(table.T @ table / np.outer(scale, scale))
    kept = values > CUTOFF * values[-1]
    basis = table / scale @ (vectors[:, kept] / np.sqrt(values[kept]))
    if len(out) == len(rows):
        leverage = np.minimum(np.einsum("ij,ij->i", basis, basis), 0.99)
        return left / (1.0 - leverage)
    return _without_group(basis, left, inside)


def _without_group(basis: Floats, left: Floats, out: Ints) -> Floats:
    """Return the errors of a group of rides, had the fit been made without all of them: (I - H_gg)^-1 e_g."""
    own = basis[out]
    p = basis.shape[1]
    without = np.eye(p) - own.T @ own
    return np.asarray(left[out] + own @ np.linalg.lstsq(without, own.T @ left[out], rcond=1e-8)[0])


def assign_folds(rows: int, folds: int) -> Ints:
    """Return which part each ride is in, drawn at random, the same at every call."""
    return np.random.default_rng(0).permutation(rows) % folds


def _by_model(rides: pd.DataFrame, error: Floats) -> dict[str, HeldOutErrors]:
    """Return errors by vehicle model."""
    kinds = np.array(get_names(rides, VEHICLE_MODEL), dtype=object)
    found: dict[str, Any] = {}
    for key in sorted(set(kinds)):
        rows = np.flatnonzero(kinds == key)
        found[key or ANY] = collect_errors(error[rows], Columns(rides, rows=rows))
    return found
