"""Use a reported state of charge in the SOC filter: steps between quanta, jumps, frozen values, published SOC.

A reported state of charge is an interval, not a value with noise. It is a measurement only when it steps: the charge
has just crossed the boundary between two reported values. Between steps, the absence of a step moves the published
value and reduces no variance.

A reported value may be wrong. A value a little off is accepted after it has stayed. A jumped value is accepted after it
has stayed for `JUMP_CONFIRMATION`. Until then the prediction continues, and for the rest of the shift the charge has
the variance of a choice between both values. If the reading jumps back, the charge does at once. Without a reading the
prediction continues alone. A value that stays constant although the charge must have changed is frozen; it is accepted
at its next step, and that step reduces no variance. The time of the last fault of more than `LEAST_FAULT` is kept,
because the charge that follows is no outcome of a forecast made before it.

References
----------
On quantised measurements as intervals: Curry, Estimation and Control with Quantized Measurements, MIT Press 1970. The
moments of a truncated normal: Johnson, Kotz and Balakrishnan, Continuous Univariate Distributions 1, Wiley 1994,
section 13.10.1.
"""

from math import erfc, exp, isnan, nan, pi, sqrt
from typing import Any, Final

from socast.core.compiled_cache import njit
from socast.core.forecast.kalman_update import update_mean, update_state

READING_SD: Final = 0.001
"""Standard deviation of a car's internal estimate of its charge at a step. [1]"""
REJECTION_SDS: Final = 4.0
"""A reading farther from the estimate than this is not accepted at once. [standard deviations]"""
REJECTION_MARGIN: Final = 0.01
"""A reading is never rejected within one quantum and this margin of the estimate. [1]"""
LEAST_FAULT: Final = 0.03
"""Least difference of a reading from the charge that makes it no outcome. Displays of old cars correct themselves by
less, one way and the other: that is their noise. [1]"""
STEP_CONFIRMATION: Final = 180.0
"""Time for which a reading that is off by less than `LEAST_JUMP` must stay off before it is accepted. [s]"""
STEP_SD: Final = 0.01
"""Standard deviation that such a step adds to the charge. [1]"""
LEAST_JUMP: Final = 0.05
"""Smallest change that is a jump: displays of old batteries fall by steps of up to 3 %, one after the other. [1]"""
JUMP_CONFIRMATION: Final = 900.0
"""Time for which a reading that jumped must stay before it is accepted. [s]"""
JUMP_SD: Final = 0.5**0.5
"""Standard deviation that a jump of the reading gives to the charge, over the jump: either value may be right. [1]"""


@njit(cache=False)
def update_with_reading(state: Any, event: Any) -> None:
    """Update the state by the reported state of charge of an event."""
    quantum = state.quantum
    if isnan(event.soc):
        if abs(state.fall) > max(quantum, LEAST_FAULT):
            state.faulty = event.time
        return
    if isnan(state.soc):
        state.soc = state.reported = event.soc
        state.p_ss = quantum * quantum / 12.0 + READING_SD**2
        state.p_sa = state.p_sc = state.fall = 0.0
        return
    sd = sqrt(state.p_ss + quantum * quantum / 12.0)
    limit = max(REJECTION_SDS * sd, quantum + REJECTION_MARGIN)
    if event.soc == state.reported:
        state.suspect = nan
        state.fall = 0.0
        if state.frozen == 0.0 and abs(state.soc - event.soc) > limit:
            state.frozen = 1.0
        if state.frozen == 1.0 and abs(state.soc - event.soc) > LEAST_FAULT:
            state.faulty = event.time
        return
    off = event.soc - state.soc
    stays = abs(off - state.suspect) <= quantum + REJECTION_MARGIN  # false without a suspect
    if abs(off) > limit or stays:
        confirm_jump(state, event, limit, quantum)
        return
    update_with_step(state, event.soc, quantum)


@njit(cache=False)
def discard_soc(state: Any) -> None:
    """Discard the estimate of the charge, so that the next reading initialises it."""
    state.soc = state.reported = state.suspect = nan
    state.frozen = state.jump = 0.0


@njit(cache=False)
def confirm_jump(state: Any, event: Any, limit: float, quantum: float) -> None:
    """Remember a reading that jumped, or accept it once it has stayed or is back; it updates neither `a` nor `c`."""
    off = event.soc - state.soc
    returned, is_step = state.jump != 0.0 and abs(off + state.jump) <= limit, abs(off) < LEAST_JUMP
    if isnan(state.suspect) or abs(off - state.suspect) > LEAST_JUMP:
        state.suspect_time = event.time
    elif event.time - state.suspect_time >= STEP_CONFIRMATION and abs(off) > LEAST_FAULT:
        state.faulty = event.time
    state.suspect = off
    if returned or event.time - state.suspect_time >= (STEP_CONFIRMATION if is_step else JUMP_CONFIRMATION):
        if returned:
            state.jump = 0.0
        elif not is_step:
            state.jump += off
        state.soc = event.soc
        state.p_ss += quantum * quantum / 12.0 + (STEP_SD**2 if is_step else 0.0)
        if abs(off) > LEAST_FAULT:
            state.faulty = event.time
        accept_reading(state, event.soc)


@njit(cache=False)
def update_with_step(state: Any, reported: float, quantum: float) -> None:
    """Update the state by a step of the reading.

    Since the previous reading, the charge has crossed the boundary of the reported interval. After a step of more than
    one quantum it may lie anywhere in the interval; a step beyond the used charge adds variance. After a frozen or
    rejected reading, and after a step far beyond the used charge, only the mean is updated.
    """
    change = reported - state.reported
    excess = max(abs(change) - abs(state.fall) - quantum, 0.0) if state.frozen == 0.0 else 0.0
    measured, variance = reported, quantum * quantum / 12.0 + excess * excess / 4.0 + READING_SD**2
    if abs(change) < 1.5 * quantum and state.frozen == 0.0:
        since = min(max(state.fall if change < 0.0 else -state.fall, 0.0), quantum)
        measured = reported + (0.5 * (quantum - since) if change < 0.0 else 0.5 * (since - quantum))
        variance = (0.1 * quantum) ** 2 + since**2 / 12.0 + READING_SD**2
    residual, variance = measured - state.soc, state.p_ss + variance
    if state.frozen == 0.0 and isnan(state.suspect) and excess <= abs(state.fall) + quantum:
        update_state(state, residual, state.p_ss, state.p_sa, state.p_sc, variance)
    else:
        update_mean(state, residual, state.p_ss, state.p_sa, state.p_sc, variance)
    accept_reading(state, reported)


@njit(cache=False)
def accept_reading(state: Any, reported: float) -> None:
    """Store an accepted reading as the reference of the next one."""
    state.reported = reported
    state.suspect = nan
    state.frozen = state.fall = 0.0


@njit(cache=False)
def compute_jump_variance(state: Any) -> float:
    """Return the variance of the charge by jumps of the reading, accepted or not."""
    unaccepted = 0.0 if isnan(state.suspect) else state.suspect
    return float(JUMP_SD**2 * (state.jump**2 + unaccepted**2))


@njit(cache=False)
def compute_published_soc(state: Any, quantum: float) -> float:
    """Return the mean of the charge, given that the car's own estimate lies in the reported interval. [1]

    It is that of a normal truncated to `reported` plus or minus half a quantum, less what was used since that reading.
    Without a trusted reading, or if the next one should have come, it is the mean of the state.
    """
    untrusted = state.frozen == 1.0 or not isnan(state.suspect) or isnan(state.reported) or abs(state.fall) > quantum
    if isnan(state.soc) or untrusted or state.p_ss <= 0.0:
        return state.soc
    sd = sqrt(state.p_ss + READING_SD**2)
    gain = state.p_ss / sd**2
    middle = state.reported - state.fall - state.soc
    low, high = (middle - 0.5 * quantum) / sd, (middle + 0.5 * quantum) / sd
    inside = 0.5 * (erfc(low / sqrt(2.0)) - erfc(high / sqrt(2.0)))
    if inside < 1e-6:
        return state.soc + gain * sd * (high if high < 0.0 else low)
    density = (exp(-0.5 * low * low) - exp(-0.5 * high * high)) / sqrt(2.0 * pi)
    return state.soc + gain * sd * density / inside
