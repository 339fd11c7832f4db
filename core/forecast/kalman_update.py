"""Kalman updates of the SOC filter: by a scalar measurement, and by the identity of the driver.

The state is (s, a, c) with the covariance matrix P, see `socast.core.forecast.soc_filter`. The day's consumption of a
car, `a - c`, is the sum of three parts: of the car, of its driver and of the day. A driver who is identified during a
shift has driven since its beginning, so the identity is a measurement of `a - c`. A driver who takes over from another
one is no measurement: the update subtracts the first driver's part, with that driver's likely share of what the shift
has revealed, and adds the part of the second driver.

References
----------
Kalman, Journal of Basic Engineering 82 (1960) 35, DOI 10.1115/1.3662552.
"""

from math import log
from typing import Any, Final

from socast.core.compiled_cache import njit

LARGEST_LOG_CONSUMPTION: Final = log(5.0)
"""Largest absolute value of `a`: no car uses five times the prediction, or a fifth of it, for a day. [1]"""
LARGEST_LOG_CAPACITY: Final = log(2.0)
"""Largest absolute value of `c`, seven standard deviations of its prior. [1]"""


@njit(cache=False)
def update_state(state: Any, residual: float, cov_s: float, cov_a: float, cov_c: float, variance: float) -> None:
    """Update mean and covariance by a scalar measurement: with k = cov / variance, x += k residual and P -= k cov^T."""
    update_mean(state, residual, cov_s, cov_a, cov_c, variance)
    gain_s, gain_a, gain_c = cov_s / variance, cov_a / variance, cov_c / variance
    state.p_ss -= gain_s * cov_s
    state.p_sa -= gain_s * cov_a
    state.p_sc -= gain_s * cov_c
    state.p_aa -= gain_a * cov_a
    state.p_ac -= gain_a * cov_c
    state.p_cc -= gain_c * cov_c


@njit(cache=False)
def update_mean(state: Any, residual: float, cov_s: float, cov_a: float, cov_c: float, variance: float) -> None:
    """Update the mean of the state as `update_state` does, and keep its covariance."""
    state.soc += cov_s / variance * residual
    consumption, capacity = cov_a / variance * residual, cov_c / variance * residual
    state.log_consumption = clip(state.log_consumption + consumption, LARGEST_LOG_CONSUMPTION)
    state.log_capacity = clip(state.log_capacity + capacity, LARGEST_LOG_CAPACITY)


@njit(cache=False)
def clip(value: float, limit: float) -> float:
    """Return a value clipped to plus or minus a limit."""
    return min(max(value, -limit), limit)


@njit(cache=False)
def apply_named_driver(state: Any, wandered: float) -> None:
    """Take the driver named since the last running totals into account: identified, or replacing another one."""
    if state.next_driver >= 0.0 and state.next_driver != state.driver:
        if state.driver < 0.0:
            update_with_driver(state, wandered)
        else:
            replace_driver(state, wandered)
        state.usual += state.next_driver_mean - state.driver_mean
        state.usual_variance += state.next_driver_variance - state.driver_variance
        state.driver = state.next_driver
        state.driver_mean, state.driver_variance = state.next_driver_mean, state.next_driver_variance
        state.drivers += 1.0
    state.next_driver = -1.0


@njit(cache=False)
def update_with_driver(state: Any, wandered: float) -> None:
    """Update the state by a driver whose part is known better than the prior of the shift assumed.

    The measurement of `a - c` has the precision that the driver's identity adds to the prior of the shift.
    """
    variance = state.usual_variance + state.next_driver_variance - state.driver_variance
    added = 1.0 / variance - 1.0 / state.usual_variance
    if added > 0.0:
        noise = 1.0 / added
        measured = noise * ((state.usual + state.next_driver_mean) / variance - state.usual / state.usual_variance)
        total = state.p_aa + state.p_cc - 2.0 * state.p_ac + noise + wandered
        residual = measured - state.log_consumption + state.log_capacity
        cov_s, cov_a, cov_c = state.p_sa - state.p_sc, state.p_aa - state.p_ac, state.p_ac - state.p_cc
        update_state(state, residual, cov_s, cov_a, cov_c, total)


@njit(cache=False)
def replace_driver(state: Any, wandered: float) -> None:
    """Replace the driver: the first driver's share of what the shift has revealed leaves with that driver."""
    kept = 1.0 - state.driver_variance / (state.usual_variance + wandered)
    cov_s, cov_c = state.p_sa - state.p_sc, state.p_ac - state.p_cc
    variance = state.p_aa + state.p_cc - 2.0 * state.p_ac
    state.log_consumption = (
        state.log_capacity
        + state.usual
        + kept * (state.log_consumption - state.log_capacity - state.usual)
        + state.next_driver_mean
        - state.driver_mean
    )
    state.p_sa, state.p_ac = state.p_sc + kept * cov_s, state.p_cc + kept * cov_c
    state.p_aa = (
        state.p_cc + 2.0 * kept * cov_c + kept**2 * variance + kept * state.driver_variance + state.next_driver_variance
    )
