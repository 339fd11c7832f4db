"""Calibrate prediction intervals on rides that were not part of the training.

Each error is that of a model fitted without the ride. Cross-validation yields such errors for any model. For least
squares the leverage of the ride yields the same error at the cost of one fit. The quantiles are those of the errors
divided by their scale.

Vehicle models that are not in the training data have a separate scale. It comes from the errors of fits without the
vehicle model.

References
----------
Barber, Candes, Ramdas, Tibshirani 2021, Annals of Statistics 49:486, DOI 10.1214/20-AOS1965: CV+ and jackknife+. This
module centres their errors on the prediction of the one model that is fitted to all rides.
Cook, Weisberg, Residuals and Influence in Regression, Chapman and Hall 1982, eq. (2.2.2): leverage.
"""

from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import msgspec
import numpy as np
import pandas as pd
from scipy.optimize import nnls
from scipy.special import gammaln, stdtrit

from socast.core.batch import Floats, Ints
from socast.core.fit.block_sums import build_design
from socast.core.fit.regression import CUTOFF
from socast.core.fit.ride_blocks import ENERGY, get_names, get_numbers, group_by_name, select_trainable
from socast.core.models import ANY, VEHICLE_MODEL, LinearModel, stamp
from socast.core.models.features import Columns, list_raw_columns
from socast.core.models.interval import PredictionInterval, compute_scale_terms
from socast.core.stats.conformal import compute_conformal_quantiles

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
"""Distances at which the classes of rides begin. [km]"""
LEAST_CALIBRATION_RIDES: Final = 100
"""Fewest rides for a separate class of distance, or for a separate scale of a vehicle model."""
_LEAST_SCALE: Final = 0.01
"""Smallest scale of an error. [kWh]"""
_UNSEEN_LEVEL: Final = 0.9
"""Coverage at which the calibration sets the scale of unseen vehicle models. [1]"""
NEEDS: Final = (*list_raw_columns("size_kwh"), *list_raw_columns("heating_need_k"), "distance_km")
"""Columns of the ride table that the scale of an error needs."""
PRIOR_SCALE: Final = (0.03, 0.15, 0.004)
"""Expected scale of the errors of a model of physics that was fitted to few rides, see `PredictionInterval`.

Estimate: such models err by 11 % (simulated) to 28 % of the size of a ride after one to three rides, and by 6 % to 20 %
after thirty. The extremes are the simulated Kia Soul of the tutorial and a Leaf and an i3 in winter.
"""
PRIOR_RIDES: Final = 6.0
"""Number of rides that the expected scale is worth."""
_PRIOR_FREEDOM: Final = 4.0
"""Degrees of freedom of the expected scale: cars differ from it by a factor of about 1.5."""
_MOST_OVER: Final = 6.0
"""Error over the expected scale at which it is clipped, so that one odd ride does not widen all intervals. [1]"""
_UNSEEN_FACTOR: Final = 2.0
"""Scale of unseen vehicle models over the common scale, where only one vehicle model has rides. Estimated. [1]"""


class HeldOutErrors(NamedTuple):
    """Hold the errors of rides of one vehicle model under fits without these rides.

    Parameters
    ----------
    error : (n,) float
        Measured minus predicted energy. [kWh]
    terms : (n, 3) float
        Terms of the scale, see `socast.core.models.interval.compute_scale_terms`.
    distance : (n,) float
        Length of the ride. [km]
    """

    error: Floats
    terms: Floats
    distance: Floats


def _collect_errors(error: Floats, columns: Columns) -> HeldOutErrors:
    """Return errors together with the columns on which their scale depends.

    Units: error [kWh].
    """
    terms, distance = compute_scale_terms(columns), columns["distance_km"]
    known = np.isfinite(error) & np.isfinite(terms).all(axis=1) & np.isfinite(distance)
    return HeldOutErrors(error[known], terms[known], distance[known])


def calibrate_interval(
    seen: Mapping[str, HeldOutErrors], unseen: Mapping[str, HeldOutErrors]
) -> PredictionInterval | None:
    """Return the prediction interval that covers held-out errors.

    Parameters
    ----------
    seen : mapping of str to HeldOutErrors
        Errors by vehicle model, of fits to other rides that include rides of the same vehicle model.
    """
    every = _join_rides(seen)
    if len(every.error) < LEAST_CALIBRATION_RIDES:
        return None
    general = _fit_scale(every)
    scales = {
        key: _fit_scale(own) if len(own.error) >= LEAST_CALIBRATION_RIDES else general for key, own in seen.items()
    }
    over = np.concatenate([own.error / (own.terms @ scales[key]) for key, own in seen.items()])
    starts = _find_classes(every.distance)
    kind = np.searchsorted(starts, every.distance, side="right") - 1
    rows = [compute_conformal_quantiles(over[kind == i], QUANTILE_LEVELS) for i in range(len(starts))]
    found = PredictionInterval(
        scales={key: _three(scale) for key, scale in scales.items()} | {ANY: _three(general * _UNSEEN_FACTOR)},
        distances_km=tuple(starts),
        levels=QUANTILE_LEVELS,
        quantiles=tuple(tuple(row.tolist()) for row in rows),
        rides=len(over),
    )
    if len(unseen) < 2:
        return found
    others = _join_rides(unseen)
    scale = _fit_scale(others)
    factor = float(np.quantile(_find_factors(found, others, scale), _UNSEEN_LEVEL))
    usual = np.mean([own for key, own in found.scales.items() if key != ANY], axis=0)
    widest = np.maximum(scale * factor, usual)
    return msgspec.structs.replace(found, scales=found.scales | {ANY: _three(widest)})


def expect_interval(seen: Mapping[str, HeldOutErrors]) -> PredictionInterval | None:
    """Return the prediction interval of a model of physics from few rides, with an expected scale as the prior.

    Parameters
    ----------
    seen : mapping of str to HeldOutErrors
        Errors by vehicle model, of fits without the vehicle-day of each ride.

    Returns
    -------
    PredictionInterval or None
        None without any ride.

    Notes
    -----
    The scale is `PRIOR_SCALE` times the mean of 1, counted `PRIOR_RIDES` times, and of each error over it. Errors over
    their scale have Student's distribution, whose degrees of freedom grow with the rides.
    `_UNSEEN_FACTOR` widens the interval of other vehicle models.
    """
    every = _join_rides(seen)
    rides = len(every.error)
    if not rides:
        return None
    over = np.minimum(np.abs(every.error) / (every.terms @ np.array(PRIOR_SCALE)), _MOST_OVER)
    factor = (PRIOR_RIDES + float(over.sum())) / (PRIOR_RIDES + rides)
    scale = np.array(PRIOR_SCALE) * factor
    freedom = _PRIOR_FREEDOM + rides
    mean = 2.0 * np.sqrt(freedom / np.pi) / (freedom - 1.0)  # of the absolute value of Student's variable
    mean *= np.exp(gammaln((freedom + 1.0) / 2.0) - gammaln(freedom / 2.0))
    return PredictionInterval(
        scales={key: _three(scale) for key in seen} | {ANY: _three(scale * _UNSEEN_FACTOR)},
        distances_km=(0.0,),
        levels=QUANTILE_LEVELS,
        quantiles=(tuple((stdtrit(freedom, QUANTILE_LEVELS) / mean).tolist()),),
        rides=rides,
    )


def _three(scale: Floats) -> tuple[float, float, float]:
    constant, by_size, by_cold = scale.tolist()
    return constant, by_size, by_cold


def _join_rides(parts: Mapping[str, HeldOutErrors]) -> HeldOutErrors:
    """Return all rides together."""
    return HeldOutErrors(*(np.concatenate(columns) for columns in zip(*parts.values(), strict=True)))


def _fit_scale(rides: HeldOutErrors) -> Floats:
    """Return non-negative factors of the scale, from least squares of absolute errors relative to the ride's size."""
    weight = 1.0 / (_LEAST_SCALE + rides.terms[:, 1])
    found, _ = nnls(rides.terms * weight[:, np.newaxis], np.abs(rides.error) * weight)
    return np.maximum(found, np.array([_LEAST_SCALE, 0.0, 0.0]))


def _find_classes(distance: Floats) -> list[float]:
    """Return the distances at which classes begin; classes with too few rides merge with their neighbours. [km]"""
    starts = list(_CLASSES)
    while len(starts) > 1:
        count = np.bincount(np.searchsorted(starts, distance, side="right") - 1, minlength=len(starts))
        few = [i for i in range(len(starts)) if count[i] < LEAST_CALIBRATION_RIDES]
        if not few:
            break
        del starts[max(few[-1], 1)]
    return starts


def widen_for_unseen_cars(
    interval: PredictionInterval | None, held: Mapping[str, HeldOutErrors], cars: Sequence[str]
) -> PredictionInterval | None:
    """Return an interval that is wider for cars that the model was not fitted to.

    Notes
    -----
    One factor holds for all vehicle models, because each has few cars.
    """
    if interval is None or sum(len(own.error) for own in held.values()) < LEAST_CALIBRATION_RIDES:
        return interval
    factors = [
        _find_factors(interval, own, np.array(interval.scales.get(key, interval.scales[ANY])))
        for key, own in held.items()
    ]
    factor = float(np.quantile(np.concatenate(factors), _UNSEEN_LEVEL))
    return msgspec.structs.replace(interval, cars=tuple(sorted(set(cars))), unseen_car=max(factor, 1.0))


def _find_factors(interval: PredictionInterval, rides: HeldOutErrors, scale: Floats) -> Floats:
    """Return the factor on a scale with which the interval of `_UNSEEN_LEVEL` would end at the error of each ride."""
    low, high = interval.get_quantiles(rides.distance, _UNSEEN_LEVEL)
    over = rides.error / (rides.terms @ scale)
    return np.where(over > 0.0, over / np.maximum(high, 1e-9), over / np.minimum(low, -1e-9))


def add_interval(model: LinearModel, rides: pd.DataFrame, *, fitted: bool = True) -> LinearModel:
    """Return a least-squares model with an interval, calibrated by the leverage of each ride.

    Parameters
    ----------
    model : LinearModel
        Model whose fits are ordinary least squares on the rides of each vehicle model. The leverage takes the accessory
        curve and the fills as given.
    fitted : bool
        Whether the coefficients were fitted; otherwise each is 1 and the residual is already the held-out error.

    Returns
    -------
    LinearModel
        Without a new interval where the rides lack a column that the scale of errors needs, or are too few.
    """
    if any(column not in rides for column in (*NEEDS, ENERGY)):
        return model
    good, _ = select_trainable(rides, [*model.needs, ENERGY])
    own, every = np.full(len(good), np.nan), np.full(len(good), np.nan)
    common = _find_residuals(model, ANY, good, np.arange(len(good)), fitted=fitted)
    for key, rows in group_by_name(get_names(good, VEHICLE_MODEL)).items():
        left, basis = _find_residuals(model, key, good, rows, fitted=fitted)
        own[rows] = left / (1.0 - np.minimum(np.einsum("ij,ij->i", basis, basis), 0.99))
        every[rows] = _leave_out_group(*common, rows)
    unseen = group_errors(good, every) if ANY in model.fits else {}
    return stamp(msgspec.structs.replace(model, interval=calibrate_interval(group_errors(good, own), unseen)))


def _find_residuals(
    model: LinearModel, key: str, rides: pd.DataFrame, rows: Ints, *, fitted: bool
) -> tuple[Floats, Floats]:
    """Return the residuals of rides under the fit of a vehicle model, and an orthonormal basis of its columns.

    The basis is empty where no coefficient was fitted: the residuals are then those of a fit without the rides.
    """
    fit = model.fits.get(key) or model.fits[ANY]
    table = build_design(model.terms, Columns(rides, fit.fills, fit.curve, rows), len(rows))
    left = get_numbers(rides, ENERGY)[rows] - table @ np.array(fit.coefficients)
    if not fitted:
        return left, np.empty((len(rows), 0))
    scale = np.sqrt(np.maximum((table**2).sum(axis=0), 1e-300))
    values, vectors = np.linalg.eigh(table.T @ table / np.outer(scale, scale))
    kept = values > CUTOFF * values[-1]
    return left, table / scale @ (vectors[:, kept] / np.sqrt(values[kept]))


def _leave_out_group(left: Floats, basis: Floats, out: Ints) -> Floats:
    """Return the errors of a group of rides under a fit without the whole group: (I - H_gg)^-1 e_g."""
    own = basis[out]
    p = basis.shape[1]
    without = np.eye(p) - own.T @ own
    return np.asarray(left[out] + own @ np.linalg.lstsq(without, own.T @ left[out], rcond=1e-8)[0])


def group_errors(rides: pd.DataFrame, error: Floats) -> dict[str, HeldOutErrors]:
    """Return errors by vehicle model."""
    return {
        key or ANY: _collect_errors(error[rows], Columns(rides, rows=rows))
        for key, rows in group_by_name(get_names(rides, VEHICLE_MODEL)).items()
    }
