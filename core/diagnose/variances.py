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

from core.batch import Floats
from core.diagnose.mixed_model import Criterion, MixedModel

QUANTILE_95: Final = 3.8415
"""95 % quantile of the chi-squared distribution with one degree of freedom. [1]"""
ROOT_STEPS: Final = 12
"""Largest number of steps that search one end of an interval."""
CLOSE: Final = 0.03
"""Difference of the criterion from its target at which the end of an interval is found. [1]"""
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


def estimate_variances(model: MixedModel, free: NDArray[np.bool_], start: Floats | None = None) -> Variances:
    """Return the most probable variances.

    Parameters
    ----------
    model : MixedModel
        Model.
    free : (levels, s) bool
        Which variances to estimate; the others stay as in `start`, or zero.
    start : (levels, s) float, optional
        Relative variances from which the search starts.
    """
    begin = np.zeros(free.shape) if start is None else start.copy()
    if not free.any():
        return Variances(begin, model.evaluate(begin))
    unit = model.scales[free]
    first = begin[free] if start is not None else unit
    size = np.maximum(first, unit)

    def loss(x: Floats) -> tuple[float, Floats]:
        begin[free] = x * size
        at = model.evaluate(begin)
        return at.value, at.gradient[free] * size

    options = {"maxiter": MOST_STEPS, "ftol": 1e-11, "gtol": 1e-3}
    found = minimize(loss, first / size, jac=True, method="L-BFGS-B", bounds=[(0.0, None)] * len(size), options=options)
    begin[free] = found.x * size
    return Variances(begin, model.evaluate(begin))


def find_interval(
    model: MixedModel, best: Variances, free: NDArray[np.bool_], at: tuple[int, int], rise: float = QUANTILE_95
) -> tuple[float, float]:
    """Return the interval of a standard deviation from the profile of the restricted likelihood.

    The other variances are estimated anew at each value.

    Parameters
    ----------
    model : MixedModel
        Model.
    best : Variances
        Most probable variances.
    free : (levels, s) bool
        Variances that were estimated.
    at : (int, int)
        Level and column of the standard deviation.
    rise : float
        Rise of the criterion at the ends of the interval: by default, of 95 %.

    Returns
    -------
    low, high : float
        Ends; the lower one is zero where the data allow it.
    """
    others = free.copy()
    others[at] = False
    state = {"at": best.relative}

    def profile(value: float) -> tuple[float, float]:
        start = state["at"].copy()
        start[at] = value
        found = estimate_variances(model, others, start)
        state["at"] = found.relative
        return found.criterion.value - best.criterion.value - rise, found.criterion.scale

    peak, unit = float(best.relative[at]), float(model.scales[at])
    low = 0.0
    if peak > 0.0:
        beyond, _ = profile(0.0)
        if beyond > 0.0:
            value, scale = _find_root(profile, peak, 0.0, beyond, rise)
            low = float(np.sqrt(value * scale))
    state["at"] = best.relative
    far = max(1.5 * peak, unit)
    for _ in range(ROOT_STEPS):
        beyond, _ = profile(far)
        if beyond > 0.0:
            break
        far *= 2.0
    value, scale = _find_root(profile, peak, far, beyond, rise)
    return low, float(np.sqrt(value * scale))


def _find_root(
    profile: Callable[[float], tuple[float, float]], peak: float, end: float, beyond: float, rise: float
) -> tuple[float, float]:
    """Return the variance between the peak and `end` where the profile crosses zero, and φ there.

    Near the peak the profile is quadratic, so that its root is nearly linear in the standard deviation.
    """
    inside, outside = (np.sqrt(peak), 0.0), (np.sqrt(end), np.sqrt(beyond + rise))
    target, scale, value = np.sqrt(rise), 0.0, end
    for _ in range(ROOT_STEPS):
        share = (target - inside[1]) / (outside[1] - inside[1])
        at = inside[0] + float(np.clip(share, 0.05, 0.95)) * (outside[0] - inside[0])
        value = float(at) ** 2
        rest, scale = profile(value)
        if abs(rest) < CLOSE:
            break
        here = (at, np.sqrt(max(rest + rise, 0.0)))
        inside, outside = (inside, here) if rest > 0.0 else (here, outside)
    return value, scale
