"""Smooth the level of a car, and tell for each date what the measurements say of a shock of the level, in one pass.

The model is that of `socast.core.condition.level_model`. A Kalman filter runs over the dates, and the disturbance
smoother back over its innovations v of variance F. With the gain K and the transition T, before the date's measurement

    r ← H'v/F + (I - KH)' r,    N ← H'H/F + (I - KH)' N (I - KH),

which give the smoothed state a + P r with the covariance P - P N P. The first entries of r and N are h'K⁻¹(y - mean)
and h'K⁻¹h of the dense Gaussian model, with h 0 before the date and 1 from then on: all that the evidence of a step
takes, in time that grows with the number of dates instead of its third power.

References
----------
De Jong, Penzer, Journal of the American Statistical Association 93 (1998) 796, DOI 10.1080/01621459.1998.10473734, on
shocks. Durbin, Koopman, Time Series Analysis by State Space Methods, 2nd ed., Oxford 2012, section 4.5, on r and N.
"""

from math import isnan
from typing import Any, Final, NamedTuple

import numpy as np

from socast.core.batch import Floats
from socast.core.compiled_cache import njit

_KEPT: Final = 7
"""Number of rows that the filter keeps of each date."""


class SmoothedLevel(NamedTuple):
    """Hold the smoothed level of a car on t dates.

    Parameters
    ----------
    level, variance, rate, rate_variance : (t,) float
        Smoothed state and its variances. [1], [1], [1/d], [1/d^2]
    score, information : (t,) float
        Evidence of a shock of the level that begins on a date: its estimate is score over information. [1]
    """

    level: Floats
    variance: Floats
    rate: Floats
    rate_variance: Floats
    score: Floats
    information: Floats


def smooth_level(
    value: Floats,
    noise: Floats,
    gaps: Floats,
    shocks: Floats,
    *,
    start: float,
    variances: tuple[float, float, float],
) -> SmoothedLevel:
    """Return the smoothed level of a car.

    Parameters
    ----------
    value, noise, gaps, shocks : (t,) float
        Values, NaN where there is none, and variances of their noise [1]; days since the date before; and variances of
        what is added to the level on each date besides its wandering [1].
    start : float
        Mean of the first level before any data. [1]
    variances : (3,) tuple of float
        Variance of the first level, that of its wandering in a day, and that of the rate. [1], [1/d], [1/d^2]
    """
    out = np.empty((len(SmoothedLevel._fields), len(value)))
    _smooth(value, noise, gaps, shocks, start, *variances, np.empty((_KEPT, len(value))), out)
    return SmoothedLevel(*out)


@njit(cache=True)
def _smooth(
    value: Any,
    noise: Any,
    gaps: Any,
    shocks: Any,
    start: float,
    first: float,
    wander: float,
    rate_variance: float,
    kept: Any,
    out: Any,
) -> None:
    """Filter forth, keeping the predicted states, and smooth back."""
    level, rate = start, 0.0
    p_ll, p_lr, p_rr = first, 0.0, rate_variance
    for t in range(len(value)):
        dt = gaps[t]
        level += rate * dt
        p_ll += 2.0 * dt * p_lr + dt**2 * p_rr + wander * dt + shocks[t]
        p_lr += dt * p_rr
        variance = p_ll + noise[t]
        off = value[t] - level
        kept[0, t], kept[1, t], kept[2, t], kept[3, t], kept[4, t] = level, rate, p_ll, p_lr, p_rr
        kept[5, t], kept[6, t] = off, variance
        if isnan(off):
            continue
        gain, gain_rate = p_ll / variance, p_lr / variance
        level += gain * off
        rate += gain_rate * off
        p_rr -= gain_rate * p_lr
        p_lr -= gain * p_lr
        p_ll -= gain * p_ll
    r_l, r_r, n_ll, n_lr, n_rr = 0.0, 0.0, 0.0, 0.0, 0.0
    for t in range(len(value) - 1, -1, -1):
        level, rate, p_ll, p_lr, p_rr = kept[0, t], kept[1, t], kept[2, t], kept[3, t], kept[4, t]
        off, variance = kept[5, t], kept[6, t]
        if not isnan(off):
            left, gain_rate = 1.0 - p_ll / variance, p_lr / variance  # I - KH is ((left, 0), (-gain_rate, 1))
            r_l = off / variance + left * r_l - gain_rate * r_r
            n_ll = 1.0 / variance + left**2 * n_ll - 2.0 * left * gain_rate * n_lr + gain_rate**2 * n_rr
            n_lr = left * n_lr - gain_rate * n_rr
        out[0, t] = level + p_ll * r_l + p_lr * r_r
        out[1, t] = p_ll - (p_ll**2 * n_ll + 2.0 * p_ll * p_lr * n_lr + p_lr**2 * n_rr)
        out[2, t] = rate + p_lr * r_l + p_rr * r_r
        out[3, t] = p_rr - (p_lr**2 * n_ll + 2.0 * p_lr * p_rr * n_lr + p_rr**2 * n_rr)
        out[4, t], out[5, t] = r_l, n_ll
        dt = gaps[t]
        r_r += dt * r_l
        n_rr += 2.0 * dt * n_lr + dt**2 * n_ll
        n_lr += dt * n_ll
