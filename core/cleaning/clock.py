"""Time repair: from uneven stamps to the logger's true clock, causally.

A logger takes a sample every period, but stamps it when it gets round to it: uneven, repeated, late, out of order, and
now and then its clock is set. The true time of a sample is

    t(n) = phase + period * k(n),    k(n) whole,

so two things are estimated: by how many whole periods `k` the sample is ahead of the one before it (from the counter
`seq` where there is one and it does not contradict the stamp, else from the stamp), and phase and period (by a
growing-memory g-h filter, which is least squares as long as its gains fall, floored so that it follows a drifting
clock, with outliers clipped). A stamp that stands still says nothing.

What error remains, for Gaussian stamps that are off by s (one standard deviation) and a period of 3 s:

- with a counter 0.19 s rms, 0.9 s at most for s of 1 s, and a drive's duration is right to 0.6 s. A clock that is set
  costs no time: two samples coast on the old clock, then the new one is believed. A silence that the counter does not
  count is taken for that. Samples sent again, however many, are late and nothing else;
- without one the same for s up to 0.5 s. For 1 s it is 0.5 s rms, one sample in 40 is a period off until its
  successors put it right (its `dt` is zero or double then), and a duration is right to 3 s; where samples are lost as
  well, 1.2 s rms. A clock set forward cannot be told from a gap, and is taken for one. A stamp that is more than 200
  periods ahead is not believed, and its sample not used, until the next stamp agrees: a single wild one costs what a
  lost sample does, and a gap as long costs its first sample, or two where that one's stamp is after its successor's;
  none is used that comes more than 200 periods after and before any other. A clock set back is believed after ten
  samples in order; until then they are late. Fewer late samples than that are late and nothing else;
- the mean delay of the stamps cannot be seen and stays, and the first stamp's own error stays in the time before it.

A period that is not the nominal one is followed from the first samples where there is a counter, to 0.4 periods and
soon better, and is found after ten samples where there is none; no time is lost by either.

References
----------
Brookner, Tracking and Kalman Filtering Made Easy, Wiley 1998, section 1.2.10, DOI 10.1002/0471224197: the gains of
the growing-memory filter, g = 2(2n+1)/((n+1)(n+2)), h = 6/((n+1)(n+2)).
"""

from math import isnan, nan
from typing import Any, Final

from numba import njit

from core.cleaning.quality import Quality

FIELDS: Final = (
    "samples",  # accepted so far; zero means that the lane is new
    "time",  # repaired time of the last accepted sample [s]
    "period",  # estimated time between samples [s]
    "stamp",  # of the last accepted sample [s]
    "seq",
    "memory",  # samples in the growing memory of the filter
    "spread",  # running median of how far stamps are off [s]
    "interval",  # running median of the stamps' intervals [s]
    "intervals",  # how many it rests on
    "misfit",  # by how much the last misfitting stamp was off [s]
    "misfits",  # misfitting stamps in a row that agree
    "late_stamp",  # of the last rejected sample [s]
    "late_run",  # rejected samples in a row that are in order among themselves
    "leap_stamp",  # of the last sample that leapt far ahead [s]
)

DUPLICATE: Final = int(Quality.DUPLICATE)
LATE: Final = int(Quality.LATE)
REPAIRED_TIME: Final = int(Quality.REPAIRED_TIME)
CLOCK_STEP: Final = int(Quality.CLOCK_STEP)
GAP: Final = int(Quality.GAP)
SEQUENCE: Final = int(Quality.SEQUENCE)

AGREE: Final = 3  # stamps that must agree before a clock that counts on is believed to have been set
AGREE_BACK: Final = 10  # the same for stamps from the past, where nothing counts: they may be late ones
MEMORY: Final = (2.0, 10.0, 80.0)  # of the filter: at first, once it has settled, at most [samples]
LOCK: Final = 10  # intervals that the median must rest on before another period is believed
TOLERANCE: Final = 0.5  # a stamp moved by more than this counts as repaired [s]
LEAST_SPREAD: Final = 0.02  # [periods]
SIGMA: Final = 1.4826  # standard deviation over median of the absolute, for a Gaussian
BELIEVED: Final = 100.0  # a leap of the counter that is believed without a stamp [samples]
LEAP: Final = 200.0  # a longer gap, where nothing counts, must be confirmed by a second stamp [periods]
UNUSED: Final = -1.0  # the `dt` of a sample that is not used


@njit(cache=False, inline="never")
def begin(s: Any, stamp: float, seq: float, period: float) -> tuple[float, int]:
    """Start a lane's clock at its first stamp."""
    if isnan(stamp):
        return UNUSED, REPAIRED_TIME
    s.samples = 1.0
    s.time = s.stamp = stamp
    s.seq = seq
    s.period = s.interval = period
    s.spread = 3.0 * LEAST_SPREAD * period
    s.memory = MEMORY[0]
    return 0.0, 0


@njit(cache=False)
def repeats(s: Any, stamp: float, seq: float, elapsed: float, same: bool) -> bool:
    """Say whether a sample is the one before it, sent again."""
    if not same or (not isnan(seq) and not isnan(s.seq) and seq != s.seq):
        return False
    return stamp == s.stamp or (seq == s.seq and not elapsed > 0.5)


@njit(cache=False)
def observe_interval(s: Any, stamp: float, count: float, slipped: bool) -> None:
    """Follow the median interval of the stamps, and lock on to a period that is not the one in use.

    A clock of nearly the right period slips a period now and then, which its filter cannot see; the median can.
    """
    interval = (stamp - s.stamp) / count
    if interval <= 0.0:
        return
    s.intervals += 1.0
    step = max(0.01, 1.0 / s.intervals) * s.interval
    s.interval += min(step, max(-step, interval - s.interval))
    if s.intervals < LOCK:
        return
    excess = s.interval - s.period
    if abs(excess) > 0.25 * s.period:
        s.period = s.interval
        s.memory = MEMORY[0]
    elif slipped and abs(excess) > 0.04 * s.period:
        s.period += 0.5 * excess
        s.memory = MEMORY[1]


@njit(cache=False)
def correct(s: Any, error: float, count: float) -> float:
    """Return by how much a stamp moves the clock, having learnt period and spread from it. [s]"""
    n = s.memory
    settled = n >= MEMORY[1]
    s.memory = min(n + 1.0, MEMORY[2])
    if settled:
        clip = max(3.0 * SIGMA * s.spread, 0.15 * s.period)
        off = abs(error)
        error = min(clip, max(-clip, error))
        s.spread = max(LEAST_SPREAD * s.period, s.spread * (1.05 if off > s.spread else 1.0 / 1.05))
    scale = 1.0 / ((n + 1.0) * (n + 2.0))
    if count >= 1.0:
        drift = 6.0 * scale * error / count
        slow = settled or isnan(s.seq)
        s.period += min((0.02 if slow else 10.0) * s.period, max((-0.02 if slow else -0.5) * s.period, drift))
    return 2.0 * (2.0 * n + 1.0) * scale * error


@njit(cache=False)
def follow(s: Any, stamp: float, count: float) -> tuple[float, int]:
    """Move the clock on by `count` periods, corrected by the stamp; return the time that passed and quality bits."""
    predicted = s.time + count * s.period
    error = stamp - predicted
    bits = GAP if count >= 2.0 else 0
    if isnan(stamp):
        moved = predicted
        bits |= REPAIRED_TIME
    elif abs(error) <= s.period or (s.memory < MEMORY[1] and count >= 1.0 and abs(error) < 20.0 * s.period):
        moved = max(s.time, predicted + correct(s, error, count))
        s.misfits = 0.0
    else:
        agrees = abs(error - s.misfit) <= 0.2 * s.period + 3.0 * SIGMA * s.spread
        s.misfits = s.misfits + 1.0 if agrees else 1.0
        s.misfit = error
        moved = predicted
        if s.misfits >= AGREE:
            s.misfits = 0.0
            s.memory = MEMORY[1]
            dt = moved - s.time
            s.time = stamp
            return dt, bits | CLOCK_STEP
    dt = moved - s.time
    s.time = moved
    if abs(stamp - moved) > TOLERANCE:
        bits |= REPAIRED_TIME
    return dt, bits


@njit(cache=False)
def reject(s: Any, stamp: float, seq: float) -> tuple[float, int]:
    """Reject a sample that strays, unless so many from the past agree that the clock must have been set back."""
    if stamp > s.time:
        return UNUSED, REPAIRED_TIME
    in_order = 0.0 < stamp - s.late_stamp <= 2.0 * s.period
    s.late_run = s.late_run + 1.0 if in_order else 1.0
    s.late_stamp = stamp
    if s.late_run < AGREE_BACK:
        return UNUSED, LATE
    dt = s.late_run * s.period
    s.late_run = s.misfits = 0.0
    s.memory = MEMORY[1]
    s.time = s.stamp = stamp
    s.seq = seq
    return dt, CLOCK_STEP | GAP


@njit(cache=False)
def restart(s: Any, stamp: float) -> tuple[float, int]:
    """Take the first sample after a power cycle or a long silence: a new phase, known from its stamp alone."""
    dt = stamp - s.time
    s.time = stamp
    s.memory = MEMORY[1]
    s.misfits = 0.0
    return dt, GAP if dt >= 1.5 * s.period else 0


@njit(cache=False)
def periods_by_stamp(s: Any, elapsed: float) -> float:
    """Return the whole periods since the last sample by the stamp alone, -1 for a sample from the past.

    One period is the rule, and it takes the more to believe an exception the more the stamps are spread.
    """
    share = SIGMA * s.spread / s.period
    slack = 0.5 + min(0.45, 4.0 * share * share)
    if elapsed > 1.0 + slack:
        return float(round(elapsed))
    if elapsed >= 1.0 - slack:
        return 1.0
    return 0.0 if elapsed >= -0.5 else -1.0


@njit(cache=False)
def strays(s: Any, stamp: float, count: float) -> bool:
    """Say whether a sample is from the past, or leaps far ahead without one before it that leapt as far."""
    if count <= LEAP:
        return count < 0.0
    follows = 0.0 < stamp - s.leap_stamp <= LEAP * s.period
    s.leap_stamp = stamp
    return not follows


@njit(cache=False)
def periods_by_seq(s: Any, elapsed: float, counted: float) -> tuple[float, int]:
    """Return the whole periods since the last sample by the counter, -1 for a sample from the past.

    A counter that contradicts the stamp has leapt or restarted, and the stamp decides.
    """
    if counted > 0.0:
        set_back = elapsed < -1.0 and counted <= AGREE_BACK
        if counted == 1.0 or set_back or counted - elapsed <= 0.5 * counted + 1.0:
            return counted, 0
        return max(0.0, periods_by_stamp(s, elapsed)), SEQUENCE
    if abs(elapsed - counted) <= 1.0 - 0.1 * counted:
        return -1.0, 0
    return max(1.0, periods_by_stamp(s, elapsed)), SEQUENCE


@njit(cache=False)
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
        return begin(s, stamp, seq, period)
    counter = not isnan(seq) and not isnan(s.seq)
    counted = seq - s.seq if counter else 0.0
    elapsed = (stamp - s.time) / s.period
    if repeats(s, stamp, seq, elapsed, same):
        return UNUSED, DUPLICATE
    bits = SEQUENCE if counter and counted == 0.0 else 0
    anew = False
    if isnan(stamp) or stamp == s.stamp:  # a stamp that stands still says nothing
        stamp = nan
        count = counted if 1.0 <= counted <= BELIEVED else 1.0
    elif counted != 0.0:
        count, bits = periods_by_seq(s, elapsed, counted)
        if count < 0.0:
            return UNUSED, LATE
        anew = counted < 0.0 and elapsed > 0.0
    else:
        count = periods_by_stamp(s, elapsed)
        if strays(s, stamp, count):
            return reject(s, stamp, seq)
        anew = count > LEAP
    s.late_run = 0.0
    if not (anew or isnan(stamp)):
        counts = counted > 0.0 and bits == 0
        slipped = abs(count - 1.0) == 1.0 and not counts
        observe_interval(s, stamp, count if counts else 1.0, slipped)
    dt, more = restart(s, stamp) if anew else follow(s, stamp, count)
    s.samples += 1.0
    if not isnan(stamp):
        s.stamp = stamp
    s.seq = seq
    return dt, bits | more
