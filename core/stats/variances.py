"""Estimate the variances of random effects by restricted likelihood, with intervals.

Parameters are variances and not standard deviations: at a standard deviation of zero, the gradient is zero whatever the
data say. Zero is a boundary that the search can reach. The other variances are estimated anew at each value of an
interval, because an interval that holds them fixed is too narrow.

References
----------
Patterson, Thompson, Biometrika 58 (1971) 545, DOI 10.1093/biomet/58.3.545: restricted likelihood. Venzon, Moolgavkar,
Applied Statistics 37 (1988) 87, DOI 10.2307/2347496: intervals from profiles of the likelihood.
"""

from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from socast.core.batch import Floats
from socast.core.stats.mixed_model import Criterion, MixedModel
from socast.core.stats.scores import NORMAL_95

ROOT_STEPS: Final = 12
"""Largest number of steps that search one end of an interval."""
CLOSE: Final = 0.1
"""Difference of the criterion from its target at which the end of an interval is found. [1]"""
FIRST_STEP: Final = 0.07
"""First step of that search, over the standard deviation or, if that is larger, its standard error at zero. [1]"""
FLAT: Final = 0.1
"""Derivative of the criterion by variances over their standard errors with which the search ends. [1]"""
MOST_SCALES: Final = 4
"""Largest number of times that scales are renewed: a standard error at zero is far smaller than at a large size."""
MOST_STEPS: Final = 200
"""Largest number of steps of the search for the most probable variances."""


class Variances(NamedTuple):
    """Hold the most probable variances.

    Parameters
    ----------
    relative : (levels, s) float
        Relative variances δ; zero where a level has no such effect.
    criterion : Criterion
        Restricted likelihood there.
    """

    relative: Floats
    criterion: Criterion

    @property
    def deviations(self) -> Floats:
        """Standard deviations of the random effects, (levels, s)."""
        return np.asarray(np.sqrt(self.relative * self.criterion.scale))


def estimate_variances(
    model: MixedModel, free: NDArray[np.bool_], start: Floats | None = None, most: Floats | None = None
) -> Variances:
    """Return the most probable variances."""
    begin = np.zeros(free.shape) if start is None else start.copy()
    if not free.any():
        return Variances(begin, model.evaluate(begin))
    if start is None:
        begin[free] = model.find_errors(begin)[free]
    high = np.full(free.shape, np.inf) if most is None else most
    begin = np.where(free, np.minimum(begin, high), begin)
    found = model.evaluate(begin)
    for _ in range(MOST_SCALES):
        size = model.find_errors(begin)[free]
        _search(model, begin, free, size, high[free])
        found = model.evaluate(begin)
        if _is_flat(found.gradient * model.find_errors(begin), begin, free, high):
            break
    return Variances(begin, found)


def _search(model: MixedModel, at: Floats, free: NDArray[np.bool_], size: Floats, high: Floats) -> None:
    """Move variances to where the criterion is least, as seen by variances over `size`."""

    def loss(x: Floats) -> tuple[float, Floats]:
        at[free] = x * size
        found = model.evaluate(at)
        return found.value, found.gradient[free] * size

    bounds = [(0.0, None if np.isinf(each) else each) for each in high / size]
    options = {"maxiter": MOST_STEPS, "ftol": 1e-11, "gtol": FLAT}
    found = minimize(loss, at[free] / size, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    at[free] = np.minimum(found.x * size, high)


def _is_flat(slope: Floats, at: Floats, free: NDArray[np.bool_], high: Floats) -> bool:
    """Return whether the criterion can fall no further along any variance, but for `FLAT`."""
    rising, falling = free & (at > 0.0) & (slope > 2.0 * FLAT), free & (at < high) & (slope < -2.0 * FLAT)
    return not (rising.any() or falling.any())


def find_interval(
    model: MixedModel,
    best: Variances,
    free: NDArray[np.bool_],
    at: tuple[int, int],
    most: Floats | None = None,
    rise: float = NORMAL_95**2,
) -> tuple[float, float]:
    """Return the interval of a standard deviation from the profile of the restricted likelihood.

    The other variances are estimated anew at each value.

    Parameters
    ----------
    rise : float
        Rise of the criterion at the ends of the interval: by default, of 95 %.
    """
    others = free.copy()
    others[at] = False
    state = {"at": best.relative}

    def profile(value: float) -> tuple[float, float]:
        start = state["at"].copy()
        start[at] = value
        found = estimate_variances(model, others, start, most)
        state["at"] = found.relative
        return found.criterion.value - best.criterion.value, found.criterion.scale

    peak = float(np.sqrt(best.relative[at]))
    step = FIRST_STEP * max(peak, float(np.sqrt(model.find_errors(np.zeros(free.shape))[at])))
    low, high = _find_end(profile, peak, -step, rise), _find_end(profile, peak, step, rise)
    return low, high


def _find_end(profile: Callable[[float], tuple[float, float]], peak: float, step: float, rise: float) -> float:
    """Return the standard deviation at which the profile has risen, zero if it has not risen there.

    The profile is about quadratic in the standard deviation, so that its root is about linear.
    """
    target, inside, outside = np.sqrt(rise), (peak, 0.0), None
    at = max(peak + step, 0.0)
    end = 0.0
    for _ in range(ROOT_STEPS):
        risen, scale = profile(at**2)
        end = at * float(np.sqrt(scale))
        if abs(risen - rise) < CLOSE or (at == 0.0 and risen < rise):
            break
        here = (at, float(np.sqrt(max(risen, 0.0))))
        if risen < rise:
            inside = here
        else:
            outside = here
        if outside is None:
            far = target / max(here[1], 0.25 * target) if here[1] > 0.0 else 3.0
            at = max(peak + min(max(far, 1.2), 3.0) * (at - peak), 0.0)
        else:
            share = (target - inside[1]) / (outside[1] - inside[1])
            at = inside[0] + min(max(share, 0.05), 0.95) * (outside[0] - inside[0])
    return end
