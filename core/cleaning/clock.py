"""Time repair: estimate the logger's true sampling times from uneven stamps, causally.

A logger takes a sample every period, but stamps it later. Stamps are uneven, repeated, late or out of order, and the
clock is set now and then. The model of the true time of a sample is

    t(n) = phase + period * k(n),    k(n) whole.

Two things are estimated. The first is the number of whole periods from one sample to the next: from the counter `seq`
where there is one that does not contradict the stamp, otherwise from the stamp. The second is phase and period, by a
growing-memory g-h filter. This filter equals least squares as long as its gains fall; a lower limit of the gains lets
it follow a drifting clock, and outliers are clipped. A stamp equal to that of the sample before it is ignored.

Remaining error, for a period of 3 s and Gaussian errors of the stamps with standard deviation s:

- With a counter and s up to 1 s, the error is 0.19 s rms and at most 0.9 s. The duration of a drive is right to 0.6 s.
  A clock that is set costs no time: two samples continue on the old clock, then the new clock is used.
- A stamp that leaps ahead of a counter that continues is that of a clock that was set, or of a logger that slept. The
  car decides: if it demonstrably drove on, the clock was set; if it stands or is elsewhere, the logger paused. Where
  neither is known, more than ten minutes are a pause. The next sample must confirm it, so that it costs one sample.
- Without a counter, the same holds for s up to 0.5 s. For s of 1 s the error is 0.5 s rms. One sample in 40 is then
  off by a period until later samples correct it (its `dt` is zero or double), and a duration is right to 3 s. If
  samples are also lost, the error is 1.2 s rms.
- Without a counter, a clock set forward cannot be distinguished from a gap and is treated as one.
- A sample more than 200 periods ahead, with a counter that agrees or without one, is not used until the next stamp
  agrees with it. A single wild sample therefore costs as much as one lost sample, whatever it claims. A gap of that
  length costs its first sample, or two if the first stamp is later than the second. Samples of which each comes more
  than 200 periods after any other are never used. After a power cycle, which a low counter shows, a gap of up to 400
  days costs no sample. In 400 streams with one sample that claimed a power cycle and was years ahead, or whose counter
  was too low, at most 3 samples had a wrong time.
- Samples from the past are marked late and have no other effect. If a stream remains in the past, its clock was set
  back, or the sample before was wild: it is believed after 20 samples in order with a counter, after 10 without one,
  and after 5 of a logger that samples every 12 s or more, and after a minute from 6 s on.
- Samples of an outage may come from a cache, after newer ones. With a counter, they are late however many there are:
  they fill the newest hole of 20 samples or more in the counter, and belong to the last 1,200 samples before its end.
  A clock set back into such a hole is believed 20 samples after it leaves the hole, at most an hour later. More samples
  than that, and ten or more without a counter, cannot be distinguished from a clock set back. Samples that were
  delivered before do not come here (`socast.core.wire.duplicate_filter`).
- The mean delay of the stamps is not observable and remains, and so does the error of the first stamp.

A period other than the nominal one is followed from the first samples where there is a counter, to within 0.4 periods
and soon better. Without a counter it is found after ten samples. Neither loses any time. A car may also announce its
period, in its vehicle message, and that its logger has none: such a logger sends a sample when a value has changed. Its
stamps are then used as they are, as long as they increase. Such a logger is also found without an announcement, if its
samples have a counter that many intervals between stamps contradict.

References
----------
Brookner, Tracking and Kalman Filtering Made Easy, Wiley 1998, section 1.2.10, DOI 10.1002/0471224197: the gains of
the growing-memory filter, g = 2(2n+1)/((n+1)(n+2)), h = 6/((n+1)(n+2)).
"""

from math import isnan, nan
from typing import Any, Final

from socast.core.cleaning import late_samples, shared_stamps
from socast.core.cleaning.late_samples import AGREE_BACK, AGREE_LATE, LEAP, is_stray, remember_hole
from socast.core.cleaning.quality import Quality
from socast.core.columns import SECONDS_PER_DAY
from socast.core.compiled_cache import njit

FIELDS: Final = (
    "samples",  # number of accepted samples; zero for a new lane
    "time",  # repaired time of the last accepted sample [s]
    "nominal",  # period that the car announced, or else that of the settings; 0 for a logger without one [s]
    "has_period",  # 0 for a logger that sends a sample when a value has changed, else 1
    "irregular",  # running share of the intervals between stamps that are twice what the counter says, or more [1]
    "period",  # estimated time between samples [s]
    "stamp",  # stamp of the last accepted sample [s]
    "seq",  # counter of the last accepted sample
    "memory",  # number of samples in the growing memory of the filter
    "spread",  # running median of the absolute error of stamps [s]
    "interval",  # running median of the intervals between stamps [s]
    "intervals",  # number of intervals in it
    "latest",  # the latest of them [s]
    "misfit",  # error of the last misfitting stamp [s]
    "misfits",  # number of successive misfitting stamps that agree
    *late_samples.FIELDS,
    *shared_stamps.FIELDS,
)

DUPLICATE: Final = int(Quality.DUPLICATE)
LATE: Final = int(Quality.LATE)
REPAIRED_TIME: Final = int(Quality.REPAIRED_TIME)
CLOCK_STEP: Final = int(Quality.CLOCK_STEP)
GAP: Final = int(Quality.GAP)
SEQUENCE: Final = int(Quality.SEQUENCE)
PAUSED: Final = int(Quality.PAUSE)

AGREE: Final = 3
"""Number of agreeing stamps after which a clock whose counter continues counts as set."""
FIRST_MEMORY: Final = 2.0
"""Memory of the filter at its first sample. [samples]"""
SETTLED_MEMORY: Final = 10.0
"""Memory from which the filter has settled. [samples]"""
LONGEST_MEMORY: Final = 80.0
"""Longest memory of the filter, so that it follows a drifting clock. [samples]"""
OTHER: Final = 1.25
"""Ratio of two periods from which they differ. [1]"""
LOCK: Final = 10
"""Number of intervals in the median from which another period is accepted."""
TOLERANCE: Final = 0.5
"""Change of a stamp beyond which it counts as repaired. [s]"""
LEAST_SPREAD: Final = 0.02
"""Least spread of stamps. [periods]"""
SIGMA: Final = 1.4826
"""Ratio of the standard deviation of a Gaussian to the median of its absolute value."""
BELIEVED: Final = 100.0
"""Longest leap of the counter that is accepted without a stamp. [samples]"""
PAUSE: Final = 400.0 * SECONDS_PER_DAY
"""Longest gap before the first sample after a power cycle, whose counter is low. [s]"""
IRREGULAR_MEMORY: Final = 50.0
"""Number of intervals in the running share of those that are twice what the counter says."""
MOST_IRREGULAR: Final = 0.15
"""Largest such share of a logger with a period. [1]"""
LONGEST_SILENCE: Final = 60.0
"""Time for which a logger without a period may send nothing because nothing has changed. [s]"""
SHORTEST_PAUSE: Final = 60.0
"""Time that a stamp leaps ahead of the counter from which a car that stands counts as having paused. [s]"""
LONGEST_CLOCK_STEP: Final = 600.0
"""Leap of a stamp ahead of the counter from which it is a pause, unless the car demonstrably drove on. [s]

A clock that is set by more has been wrong by more. A logger that slept is more frequent, and a pause only ends a ride,
while a pause that is taken for a clock that was set joins two rides and dates the second one wrongly."""
ROLLOVER: Final = 1024.0 * 7.0 * SECONDS_PER_DAY
"""Time after which the week number of GPS begins anew: 1024 weeks. [s] (IS-GPS-200, section 20.3.3.3.1.1)"""
FIRST_LOGGER: Final = 1_262_304_000.0
"""Unix time of 2010-01-01: a logger of an electric car with an earlier clock has a wrong clock. [s]"""
UNUSED: Final = -1.0
"""The `dt` of a rejected sample."""


@njit(cache=False, inline="never")
def start_clock(state: Any, stamp: float, seq: float, period: float) -> tuple[float, int]:
    """Start the clock of a lane at its first stamp; return the time that passed and quality bits."""
    if isnan(stamp):
        return UNUSED, REPAIRED_TIME
    state.samples = 1.0
    state.time = state.stamp = stamp
    state.seq = seq
    set_period(state, period)
    return 0.0, 0


@njit(cache=False)
def set_period(state: Any, nominal: float) -> None:
    """Begin to estimate the period from the nominal one, 0 for a logger without a period."""
    state.nominal = nominal
    state.has_period = 1.0 if nominal > 0.0 else 0.0
    state.period = state.interval = nominal if nominal > 0.0 else LONGEST_SILENCE
    state.intervals = state.latest = state.misfits = state.irregular = 0.0
    state.spread = 3.0 * LEAST_SPREAD * state.period
    state.memory = FIRST_MEMORY


@njit(cache=False)
def has_rolled_over(stamp: float) -> bool:
    """Return whether a stamp is too early for a logger, and 1024 weeks later it is not."""
    return FIRST_LOGGER - ROLLOVER <= stamp < FIRST_LOGGER


@njit(cache=False)
def is_repeat(state: Any, stamp: float, seq: float, elapsed: float, same: bool) -> bool:
    """Return whether a sample is the one before it, sent again."""
    if not same or (not isnan(seq) and not isnan(state.seq) and seq != state.seq):
        return False
    if isnan(seq) and stamp == state.stamp and shared_stamps.is_shared(state):
        return False
    return stamp == state.stamp or (seq == state.seq and not elapsed > 0.5)


@njit(cache=False)
def observe_interval(state: Any, stamp: float, count: float, slipped: bool) -> None:
    """Update the median interval of the stamps, and change the period if it differs from that.

    A clock of nearly the right period slips by a whole period now and then. The filter cannot detect that, but the
    median can. At first, two equal intervals replace a median that is far from them.
    """
    interval = (stamp - state.stamp) / count
    if interval <= 0.0:
        return
    state.intervals += 1.0
    is_same = abs(interval - state.latest) <= 0.1 * interval
    if state.intervals < LOCK and is_same and abs(interval - state.interval) > 0.5 * state.interval:
        state.interval = interval
    state.latest = interval
    step = max(0.01, 1.0 / state.intervals) * state.interval
    state.interval += min(step, max(-step, interval - state.interval))
    if state.intervals < LOCK:
        return
    excess = state.interval - state.period
    if abs(excess) > 0.25 * state.period:
        state.period = state.interval
        state.memory = FIRST_MEMORY
    elif slipped and abs(excess) > 0.04 * state.period:
        state.period += 0.5 * excess
        state.memory = SETTLED_MEMORY


@njit(cache=False)
def find_irregular(state: Any, stamp: float, count: float) -> None:
    """Treat a logger as one without a period if its stamps increase, and many intervals are longer than counted."""
    interval = stamp - state.stamp
    if interval <= 0.0:
        state.irregular = 0.0
    elif not isnan(count):
        contradicts = 2.0 * state.interval < interval / count <= LONGEST_SILENCE
        state.irregular += ((1.0 if contradicts else 0.0) - state.irregular) / IRREGULAR_MEMORY
    if state.irregular > MOST_IRREGULAR:
        state.has_period = 0.0
        state.period = LONGEST_SILENCE


@njit(cache=False)
def correct_clock(state: Any, error: float, count: float) -> float:
    """Update period and spread by the error of a stamp; return the correction of the clock. [s]"""
    n = state.memory
    settled = n >= SETTLED_MEMORY
    state.memory = min(n + 1.0, LONGEST_MEMORY)
    if settled:
        clip = max(3.0 * SIGMA * state.spread, 0.15 * state.period)
        off = abs(error)
        error = min(clip, max(-clip, error))
        state.spread = max(LEAST_SPREAD * state.period, state.spread * (1.05 if off > state.spread else 1.0 / 1.05))
    scale = 1.0 / ((n + 1.0) * (n + 2.0))
    if count >= 1.0:
        drift = 6.0 * scale * error / count
        slow = settled or isnan(state.seq)
        state.period += min(
            (0.02 if slow else 10.0) * state.period, max((-0.02 if slow else -0.5) * state.period, drift)
        )
    return 2.0 * (2.0 * n + 1.0) * scale * error


@njit(cache=False)
def has_other_period(state: Any, stamp: float, count: float, error: float) -> bool:
    """Return whether the period is still unknown, and explains the error of a stamp by the interval before it."""
    interval = stamp - state.stamp
    is_new = state.memory < SETTLED_MEMORY and count >= 1.0 and abs(error) < 20.0 * state.period
    return is_new and interval > 0.0 and abs(interval - count * state.period) > 0.5 * state.period


@njit(cache=False)
def follow_stamp(state: Any, stamp: float, count: float) -> tuple[float, int]:
    """Advance the clock by `count` periods, corrected by the stamp; return the time that passed and quality bits."""
    predicted = state.time + count * state.period
    error = stamp - predicted
    bits = GAP if count >= 2.0 else 0
    if isnan(stamp):
        moved = predicted
        bits |= REPAIRED_TIME
    elif abs(error) <= state.period or has_other_period(state, stamp, count, error):
        moved = max(state.time, predicted + correct_clock(state, error, count))
        state.misfits = 0.0
    else:
        agrees = abs(error - state.misfit) <= 0.2 * state.period + 3.0 * SIGMA * state.spread
        state.misfits = state.misfits + 1.0 if agrees else 1.0
        state.misfit = error
        moved = predicted
        if state.misfits >= AGREE:
            state.misfits = 0.0
            state.memory = SETTLED_MEMORY
            dt = moved - state.time
            state.time = stamp
            return dt, bits | CLOCK_STEP
    dt = moved - state.time
    state.time = moved
    if abs(stamp - moved) > TOLERANCE:
        bits |= REPAIRED_TIME
    return dt, bits


@njit(cache=False)
def reject_or_reset(state: Any, stamp: float, seq: float, count: float, counted: float) -> tuple[float, int]:
    """Reject a stray sample, or set the clock back where enough samples from the past agree."""
    if count > 0.0:
        return UNUSED, REPAIRED_TIME
    in_order = late_samples.extends_late_run(state, stamp, seq, counted)
    state.late_run = 0.0 if late_samples.fills_hole(state, seq, counted) else state.late_run + 1.0 if in_order else 1.0
    state.late_stamp = stamp
    state.late_seq = seq
    if state.late_run < late_samples.find_agreement(state, counted):
        return UNUSED, LATE
    dt = state.late_run * state.period if state.has_period == 1.0 else 0.0
    state.late_run = state.misfits = state.hole_start = state.hole_end = 0.0
    state.memory = SETTLED_MEMORY
    state.time = state.stamp = stamp
    state.seq = seq
    return dt, CLOCK_STEP | GAP


@njit(cache=False)
def restart_clock(state: Any, stamp: float) -> tuple[float, int]:
    """Set a new phase from the stamp of the first sample after a power cycle or a long silence."""
    dt = stamp - state.time
    state.time = stamp
    state.memory = SETTLED_MEMORY
    state.misfits = 0.0
    return dt, GAP if dt >= 1.5 * state.period else 0


@njit(cache=False)
def count_periods_by_stamp(state: Any, elapsed: float) -> float:
    """Return the number of whole periods since the last sample by the stamp alone, -1 for a sample from the past.

    The expected number is one. The wider the spread of the stamps, the larger the deviation must be for another number.
    """
    share = SIGMA * state.spread / state.period
    slack = 0.5 + min(0.45, 4.0 * share * share)
    if elapsed > 1.0 + slack:
        return float(round(elapsed))
    if elapsed >= 1.0 - slack:
        return 1.0
    return 0.0 if elapsed >= -0.5 else -1.0


@njit(cache=False)
def is_pause(state: Any, elapsed: float, counted: float, drove: float) -> bool:
    """Return whether a logger whose counter continues has paused, and its clock was not set.

    `drove` is what speed and fixes say, see `socast.core.cleaning.repetition.drove_on`. The sample that confirms a
    pause comes after the car has driven on.
    """
    leap = (elapsed - counted) * state.period
    if counted > AGREE_BACK or leap < min(max(SHORTEST_PAUSE, AGREE_LATE * state.period), LONGEST_CLOCK_STEP):
        return False
    confirms = 0.0 < state.time + elapsed * state.period - state.leap_stamp <= AGREE * state.period
    return confirms or drove < 0.0 or (drove == 0.0 and leap > LONGEST_CLOCK_STEP)


@njit(cache=False)
def count_periods_by_seq(state: Any, elapsed: float, counted: float, drove: float) -> tuple[float, int]:
    """Return the number of whole periods since the last sample by the counter, -1 for a sample from the past.

    A counter that contradicts the stamp has leapt or restarted; the stamp then decides.
    """
    if counted > 0.0:
        if is_pause(state, elapsed, counted, drove):
            return float(round(elapsed)), PAUSED
        set_back = elapsed < -1.0 and counted <= AGREE_BACK
        if counted == 1.0 or set_back or counted - elapsed <= 0.5 * counted + 1.0:
            return counted, 0
        return max(0.0, count_periods_by_stamp(state, elapsed)), SEQUENCE
    if abs(elapsed - counted) <= 1.0 - 0.1 * counted:
        return -1.0, 0
    return max(1.0, count_periods_by_stamp(state, elapsed)), SEQUENCE


@njit(cache=False)
def take_stamp(state: Any, stamp: float, seq: float, counted: float) -> tuple[float, int]:
    """Advance the clock of a logger without a period to a stamp; return the time that passed and quality bits."""
    dt = stamp - state.time
    if isnan(dt):
        return UNUSED, REPAIRED_TIME
    count = -1.0 if dt < 0.0 else dt / state.period
    if is_stray(state, stamp, count, LEAP):
        return reject_or_reset(state, stamp, seq, count, counted)
    state.late_run = 0.0
    state.samples += 1.0
    state.time = state.stamp = stamp
    state.seq = seq
    return dt, GAP if dt > 1.5 * state.period else 0


@njit(cache=False)
def advance_clock(state: Any, stamp: float, seq: float, same: bool, period: float, drove: float) -> tuple[float, int]:
    """Advance the clock of a lane by a sample.

    Parameters
    ----------
    stamp, seq : float
        Stamp [s] and counter of the sample; NaN where unknown.
    """
    state.mistimed = 0.0
    if state.samples == 0.0:
        return start_clock(state, stamp, seq, period)
    if state.nominal != period:
        set_period(state, period)
    counter = not isnan(seq) and not isnan(state.seq)
    counted = seq - state.seq if counter else 0.0
    elapsed = (stamp - state.time) / state.period
    is_late = -AGREE_BACK <= counted < 0.0 and shared_stamps.is_shared(state)
    if is_late or is_repeat(state, stamp, seq, elapsed, same):
        return UNUSED, LATE if is_late else DUPLICATE
    if state.has_period == 0.0:
        return take_stamp(state, stamp, seq, counted)
    bits = SEQUENCE if counter and counted == 0.0 else 0
    if isnan(stamp) or stamp == state.stamp:
        bits |= shared_stamps.note_shared(state) if stamp == state.stamp else 0
        return advance_without_stamp(state, seq, counted if 1.0 <= counted <= BELIEVED else 1.0, bits)
    if shared_stamps.ends_group(state, stamp - state.stamp, counted):
        return end_shared_group(state, stamp, seq, counted)
    shared_stamps.note_new_stamp(state)
    return advance_by_stamp(state, stamp, seq, elapsed, counted, bits, drove)


@njit(cache=False)
def advance_without_stamp(state: Any, seq: float, count: float, bits: int) -> tuple[float, int]:
    """Advance the clock by a sample whose stamp carries no information: it is missing, or that of the sample before."""
    state.late_run = 0.0
    state.irregular = max(0.0, state.irregular - 1.0 / IRREGULAR_MEMORY)  # whole seconds make intervals of 0 and of 2
    remember_hole(state, seq, count if bits == 0 else 0.0)
    dt, more = follow_stamp(state, nan, count)
    state.samples += 1.0
    state.shared += count
    state.seq = seq
    return dt, bits | more


@njit(cache=False)
def end_shared_group(state: Any, stamp: float, seq: float, counted: float) -> tuple[float, int]:
    """Advance the clock to the first sample with a new stamp, of a logger whose samples share stamps."""
    has_counter = 1.0 <= counted <= BELIEVED
    dt, bits = shared_stamps.end_group(state, stamp, counted if has_counter else 1.0, has_counter)
    state.memory, state.misfits, state.late_run = SETTLED_MEMORY, 0.0, 0.0
    state.samples += 1.0
    state.stamp, state.seq = stamp, seq
    return dt, bits


@njit(cache=False)
def advance_by_stamp(
    state: Any, stamp: float, seq: float, elapsed: float, counted: float, bits: int, drove: float
) -> tuple[float, int]:
    """Advance the clock by a sample with a stamp of its own, or reject it."""
    if counted != 0.0:
        count, bits = count_periods_by_seq(state, elapsed, counted, drove)
    else:
        count = count_periods_by_stamp(state, elapsed)
    limit = 0.0 if bits == PAUSED else LEAP
    if is_stray(state, stamp, count, PAUSE / state.period if counted < 0.0 and seq <= BELIEVED else limit):
        return reject_or_reset(state, stamp, seq, count, counted)
    anew = elapsed > 0.0 if counted < 0.0 else bits == PAUSED or (counted == 0.0 and count > LEAP)
    state.late_run = 0.0
    remember_hole(state, seq, counted if bits == 0 or counted < 0.0 else 0.0)
    if not anew:
        counts = counted > 0.0 and bits == 0
        slipped = abs(count - 1.0) == 1.0 and not counts
        before = state.period
        observe_interval(state, stamp, state.shared + (count if counts else 1.0), slipped)
        if state.period > OTHER * before and not counts:  # the count is that of the period before
            count = max(1.0, count_periods_by_stamp(state, (stamp - state.time) / state.period))
        find_irregular(state, stamp, state.shared + count if counts else nan)
    dt, more = restart_clock(state, stamp) if anew else follow_stamp(state, stamp, count)
    if dt > shared_stamps.LONGEST_GROUP:
        state.unphased = 1.0
    state.samples += 1.0
    state.stamp, state.seq, state.shared = stamp, seq, 0.0
    return dt, bits | more
