"""Time repair: from uneven stamps to the logger's true clock, causally.

A logger takes a sample every period, but stamps it when it gets round to it: uneven, repeated, late, out of order, and
now and then its clock is set. The true time of a sample is

    t(n) = phase + period * k(n),    k(n) whole,

so two things are estimated: by how many whole periods `k` the sample is ahead of the one before it (from the counter
`seq` where there is one, else from the stamp), and phase and period (by a growing-memory g-h filter, which is least
squares as long as its gains fall, floored so that it follows a drifting clock).

What error remains: with a spread of the stamps of s about the true time, that of the repaired time is about
s * sqrt(g / 2) in the steady state, 0.2 s for 1 s; the mean delay of the stamps cannot be seen and stays. Without a
counter a sample whose stamp is off by more than half a period is put one period off, and its successor makes up
for it (its `dt` is then zero), so that durations stay right; a clock set forward cannot be told from a gap, and is
taken for one; samples sent while the clock runs backwards are rejected as late until three in a row agree. A clock set
while the counter counts on costs no time at all: three samples coast on the old clock, then the new one is believed.

References
----------
Brookner, Tracking and Kalman Filtering Made Easy, Wiley 1998, section 1.2.10, DOI 10.1002/0471224197: the gains of
the growing-memory filter, g = 2(2n+1)/((n+1)(n+2)), h = 6/((n+1)(n+2)).
"""

from math import isnan
from typing import Any, Final

from numba import njit

from core.quality import Quality

FIELDS: Final = (
    "samples",  # accepted so far; zero means that the lane is new
    "time",  # repaired time of the last accepted sample [s]
    "period",  # estimated time between samples [s]
    "stamp",  # of the last accepted sample [s]
    "seq",
    "memory",  # samples in the growing memory of the filter
    "interval",  # running median of the stamps' intervals [s]
    "intervals",  # how many it rests on
    "misfit",  # by how much the last misfitting stamp was off [s]
    "misfits",  # misfitting stamps in a row that agree
    "late_stamp",  # of the last rejected sample [s]
    "late_run",  # rejected samples in a row that are in order among themselves
)

DUPLICATE: Final = int(Quality.DUPLICATE)
LATE: Final = int(Quality.LATE)
REPAIRED_TIME: Final = int(Quality.REPAIRED_TIME)
CLOCK_STEP: Final = int(Quality.CLOCK_STEP)
GAP: Final = int(Quality.GAP)
SEQUENCE: Final = int(Quality.SEQUENCE)

AGREE: Final = 3  # stamps that must agree before a clock is believed to have been set
MEMORY: Final = (10.0, 40.0)  # samples' worth of trust in the nominal period; longest memory
TOLERANCE: Final = 0.5  # a stamp moved by more than this counts as repaired [s]
REORDER: Final = 100.0  # a counter that is behind by more than this has restarted
UNUSED: Final = -1.0  # the `dt` of a sample that is not used


@njit(inline="never")
def begin(s: Any, stamp: float, seq: float, period: float) -> None:
    """Start a lane's clock at its first stamp."""
    s.samples = 1.0
    s.time = s.stamp = stamp
    s.seq = seq
    s.period = s.interval = period
    s.memory = MEMORY[0]


@njit
def observe_interval(s: Any, stamp: float, count: float) -> None:
    """Follow the median interval of the stamps, and lock on to a period that is not the nominal one."""
    interval = (stamp - s.stamp) / count
    if interval <= 0.0:
        return
    s.intervals += 1.0
    step = max(0.02, 1.0 / s.intervals) * s.interval
    s.interval += min(step, max(-step, interval - s.interval))
    if s.intervals >= 20.0 and abs(s.interval - s.period) > 0.25 * s.period:
        s.period = s.interval
        s.memory = MEMORY[0]


@njit
def follow(s: Any, stamp: float, count: float) -> tuple[float, int]:
    """Move the clock on by `count` periods, corrected by the stamp; return the time that passed and quality bits."""
    predicted = s.time + count * s.period
    error = stamp - predicted
    bits = GAP if count >= 2.0 else 0
    if isnan(stamp):
        moved = predicted
        bits |= REPAIRED_TIME
    elif abs(error) <= s.period:
        n = s.memory
        s.memory = min(n + 1.0, MEMORY[1])
        moved = max(s.time, predicted + 2.0 * (2.0 * n + 1.0) / ((n + 1.0) * (n + 2.0)) * error)
        if count >= 1.0:
            drift = 6.0 / ((n + 1.0) * (n + 2.0)) * error / count
            s.period += min(0.02 * s.period, max(-0.02 * s.period, drift))
        s.misfits = 0.0
    else:
        s.misfits = s.misfits + 1.0 if abs(error - s.misfit) <= s.period else 1.0
        s.misfit = error
        moved = predicted
        if s.misfits >= AGREE:
            s.misfits = 0.0
            s.memory = MEMORY[0]
            dt = moved - s.time
            s.time = stamp
            return dt, bits | CLOCK_STEP
    dt = moved - s.time
    s.time = moved
    if abs(stamp - moved) > TOLERANCE:
        bits |= REPAIRED_TIME
    return dt, bits


@njit
def restart(s: Any, stamp: float, seq: float) -> tuple[float, int]:
    """Take the first sample after a power cycle: a new phase, known from its stamp alone."""
    dt = stamp - s.time
    s.samples += 1.0
    s.time = s.stamp = stamp
    s.seq = seq
    s.memory = MEMORY[0]
    s.misfits = 0.0
    return dt, SEQUENCE | (GAP if dt >= 1.5 * s.period else 0)


@njit
def reject(s: Any, stamp: float, seq: float, bit: int) -> tuple[float, int]:
    """Reject a sample from the past, unless it is the third in a row of a clock that has been set back."""
    in_order = 0.0 < stamp - s.late_stamp <= 2.0 * s.period
    s.late_run = s.late_run + 1.0 if in_order else 1.0
    s.late_stamp = stamp
    if s.late_run < AGREE:
        return UNUSED, bit
    s.late_run = 0.0
    s.misfits = 0.0
    s.memory = MEMORY[0]
    s.time = s.stamp = stamp
    s.seq = seq
    return s.period, CLOCK_STEP


@njit
def periods_by_seq(s: Any, stamp: float, seq: float) -> tuple[float, int]:
    """Return the whole periods since the last sample by the counter, -1 for a sample from the past."""
    counted = seq - s.seq
    elapsed = (stamp - s.time) / s.period
    if counted > 0.0:
        if counted >= 2.0 and elapsed < 0.5 * counted:
            return max(0.0, round(elapsed)), SEQUENCE
        return counted, 0
    if stamp <= s.stamp and counted > -REORDER:
        return -1.0, LATE
    return max(1.0, round(elapsed)), SEQUENCE


@njit
def periods_by_stamp(s: Any, stamp: float) -> tuple[float, int]:
    """Return the whole periods since the last sample by the stamp, -1 for a sample from the past."""
    if stamp == s.stamp:
        return 1.0, REPAIRED_TIME
    if stamp < s.stamp:
        return -1.0, LATE
    return max(0.0, round((stamp - s.time) / s.period)), 0


@njit
def advance(s: Any, stamp: float, seq: float, same: bool, period: float) -> tuple[float, int]:
    """Take a sample's place in time.

    Parameters
    ----------
    s : record. The lane's state, changed in place.
    stamp, seq : float. As the sample has them; NaN where unknown.
    same : bool. The sample's content equals that of the one before it.
    period : float. Nominal. [s]

    Returns
    -------
    dt : float
        Time since the sample before it; `UNUSED` if it is not to be used. [s]
    bits : int
        Quality bits.
    """
    if s.samples == 0.0:
        if isnan(stamp):
            return UNUSED, REPAIRED_TIME
        begin(s, stamp, seq, period)
        return 0.0, 0
    counter = not isnan(seq) and not isnan(s.seq)
    repeated = seq == s.seq if counter else stamp == s.stamp
    if repeated and (same or (counter and stamp <= s.stamp)):
        return UNUSED, DUPLICATE
    if isnan(stamp):
        count, bits = (seq - s.seq if counter and 1.0 <= seq - s.seq <= REORDER else 1.0), 0
    elif counter and not repeated:
        count, bits = periods_by_seq(s, stamp, seq)
    else:
        count, bits = periods_by_stamp(s, stamp)
        bits |= SEQUENCE if counter else 0
    if count < 0.0:
        return reject(s, stamp, seq, bits)
    s.late_run = 0.0
    if counter and seq < s.seq and stamp > s.time:
        return restart(s, stamp, seq)
    if not isnan(stamp) and count >= 1.0:
        observe_interval(s, stamp, count)
    dt, more = follow(s, stamp, count)
    s.samples += 1.0
    if not isnan(stamp):
        s.stamp = stamp
    s.seq = seq
    return dt, bits | more
