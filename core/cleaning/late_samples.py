"""Samples that come late, and samples that leap ahead: which of them wait for others that agree with them."""

from typing import Any, Final

from socast.core.cleaning.shared_stamps import MOST_SHARED
from socast.core.compiled_cache import njit

FIELDS: Final = (
    "late_stamp",  # stamp of the last rejected sample [s]
    "late_seq",  # counter of the last rejected sample
    "late_run",  # number of successive rejected samples that are in order among themselves
    "leap_stamp",  # stamp of the last sample that leapt far ahead [s]
    "hole_start",  # counter of the last sample before the newest long hole in the counter
    "hole_end",  # counter of the first sample after it
    "strays",  # points of samples that another clock stamped, among the newest `STRAY_MEMORY` or so
    "stray_run",  # number of successive ones before this sample
)

AGREE_BACK: Final = 10
"""Number of stamps from the past, without a counter, after which the clock counts as set back."""
AGREE_LATE: Final = 20
"""The same for samples whose counter is from the past too: a minute of the nominal period."""
AGREE_SLOW: Final = 5.0
"""The same for a slow logger without a counter, which loses minutes until then."""
AGREE_TIME: Final = 60.0
"""Time of `AGREE_BACK` samples from which a logger is slow. [s]"""
HISTORY: Final = 1200.0
"""Number of samples before the end of a hole in the counter that may be sent late: an hour of the nominal period."""
FAR: Final = 600.0
"""Distance from the clock of a sample that another clock has stamped. [s]"""
STRAY_MEMORY: Final = 1000.0
"""Number of samples in which such samples count; each is a point, and the end of several in a row `RUN_POINTS`."""
RUN_POINTS: Final = 20.0
"""Points for a clock that is set, or returns."""
MOST_STRAYS: Final = 100.0
"""Points from which the clock alternates: a tenth of the samples is stray, or the clock was set three times."""
LEAP: Final = 200.0
"""Longest gap that is accepted without confirmation by a second stamp. [periods]"""


@njit(cache=False)
def find_agreement(state: Any, counted: float) -> float:
    """Return the number of samples from the past after which the clock counts as set back."""
    if counted != 0.0:
        return AGREE_LATE
    is_slow = state.has_period == 1.0 and AGREE_BACK * state.period > AGREE_TIME
    return max(AGREE_SLOW, AGREE_TIME / state.period) if is_slow else AGREE_BACK


@njit(cache=False)
def extends_late_run(state: Any, stamp: float, seq: float, counted: float) -> bool:
    """Return whether a sample from the past follows the rejected sample before it."""
    since = stamp - state.late_stamp
    if counted == 0.0:
        return 0.0 < since <= 2.0 * state.period
    ahead = seq - state.late_seq
    return 1.0 <= ahead <= AGREE_BACK and abs(since - ahead * state.period) <= 2.0 * state.period


@njit(cache=False)
def count_strays(state: Any, stamp: float, seq: float, rejected: bool) -> None:
    """Count a sample that is far from the clock, unless it fills a hole."""
    state.strays -= state.strays / STRAY_MEMORY
    if abs(stamp - state.time) > FAR and not (rejected and fills_hole(state, seq, seq - state.seq)):
        state.strays += 1.0
        state.stray_run += 1.0
    else:
        if state.stray_run >= 2.0:
            state.strays += RUN_POINTS
        state.stray_run = 0.0


@njit(cache=False)
def is_stray(state: Any, stamp: float, count: float, limit: float) -> bool:
    """Return whether a sample is from the past, or leaps further ahead of all samples before it than the limit."""
    if count <= limit:
        return count < 0.0
    since = stamp - state.leap_stamp
    follows = 0.0 < since <= LEAP * state.period or (since == 0.0 and state.shares > MOST_SHARED)
    state.leap_stamp = stamp
    return not follows


@njit(cache=False)
def remember_hole(state: Any, seq: float, counted: float) -> None:
    """Remember which samples may still come late, if a minute of them or more is missing before this one."""
    if counted > AGREE_LATE:
        state.hole_start = state.seq
        state.hole_end = seq
    elif counted < 0.0:
        state.hole_start = state.hole_end = 0.0


@njit(cache=False)
def fills_hole(state: Any, seq: float, counted: float) -> bool:
    """Return whether a sample from the past belongs to the newest long hole in the counter."""
    return counted < 0.0 and state.hole_start < seq < state.hole_end <= seq + HISTORY
