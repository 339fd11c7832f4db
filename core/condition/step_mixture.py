"""Weigh a smoothed level without a shock with those that have one, on each of some dates, in one pass.

A shock a of the level since date τ adds a h to the values, with h 0 before τ and 1 from then on. The smoother is linear
in the values: with a known, the smoothed level x without a shock becomes x + a g, where g is h less the smoothed level
of the values h, and its variance V stays. A mixture of shocks of weights w, estimates a and variances v therefore has

    mean x + Σ w a g,    variance V + Σ w (a² + v) g² - (Σ w a g)²,

and only g takes a pass over the dates, with the gains of `socast.core.condition.level_smoother`.
"""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Floats, Ints
from socast.core.compiled_cache import njit


class ShockMixture(NamedTuple):
    """Hold what shocks add to the mean and variance of a level on t dates, (t,). [1]"""

    level: Floats
    variance: Floats


NO_SHOCK: Final = ShockMixture(np.zeros(1), np.zeros(1))
"""What nothing adds."""


def mix_shocks(
    known: NDArray[np.bool_],
    noise: Floats,
    gaps: Floats,
    shocks: Floats,
    variances: tuple[float, float, float],
    places: Ints,
    weights: Floats,
    sizes: Floats,
    size_variances: Floats,
) -> ShockMixture:
    """Return what a mixture of shocks, and of none, adds to the smoothed level of a car.

    Parameters
    ----------
    known : (t,) bool
        Whether there is a value. `noise`, `gaps`, `shocks` and `variances` are those of `smooth_level`.
    places : (k,) int
        Dates on which the shocks begin, ascending.
    weights, sizes, size_variances : (k,) float
        Probability of each shock, its estimate and the variance of that. [1]
    """
    response = np.empty((len(noise), len(places)))
    _respond(known, noise, gaps, shocks, *variances, places, response)
    level = response @ (weights * sizes)
    return ShockMixture(level, response**2 @ (weights * (sizes**2 + size_variances)) - level**2)


@njit(cache=True)
def _respond(
    known: Any,
    noise: Any,
    gaps: Any,
    shocks: Any,
    first: float,
    wander: float,
    rate_variance: float,
    places: Any,
    response: Any,
) -> None:
    """Write g of each date and shock: what a shock of 1 adds."""
    days, number = response.shape
    kept = np.empty((5, days))
    level, rate, begun = np.zeros(number), np.zeros(number), 0
    p_ll, p_lr, p_rr = first, 0.0, rate_variance
    for t in range(days):
        dt = gaps[t]
        p_ll += 2.0 * dt * p_lr + dt**2 * p_rr + wander * dt + shocks[t]
        p_lr += dt * p_rr
        inverse = 1.0 / (p_ll + noise[t]) if known[t] else 0.0
        gain, gain_rate = p_ll * inverse, p_lr * inverse
        kept[0, t], kept[1, t], kept[2, t], kept[3, t], kept[4, t] = p_ll, p_lr, inverse, gain, gain_rate
        p_rr -= gain_rate * p_lr
        p_lr -= gain * p_lr
        p_ll -= gain * p_ll
        while begun < number and places[begun] <= t:
            begun += 1
        off = response[t]
        off[begun:] = 0.0
        for k in range(begun):  # a filter over the values h
            level[k] += rate[k] * dt
            off[k] = 1.0 - level[k]
            level[k] += gain * off[k]
            rate[k] += gain_rate * off[k]
    r_l, r_r = level, rate
    r_l[:] = 0.0
    r_r[:] = 0.0
    for t in range(days - 1, -1, -1):
        dt, off = gaps[t], response[t]
        p_ll, p_lr, inverse, gain, gain_rate = kept[0, t], kept[1, t], kept[2, t], kept[3, t], kept[4, t]
        for k in range(number):
            r_l[k] += inverse * off[k] - gain * r_l[k] - gain_rate * r_r[k]
            off[k] -= p_ll * r_l[k] + p_lr * r_r[k]
            r_r[k] += dt * r_l[k]
