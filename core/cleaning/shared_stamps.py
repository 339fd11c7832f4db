"""Loggers whose samples share stamps: floored to 10 s or to whole minutes, or sent in bursts with one time of sending.

Such a stamp says when a group of samples was taken, or sent, and not when each was. Within a group the clock advances
by the period, in the order or by the counter of the samples. The period is the time of whole groups over the number of
their samples. Between groups the clock follows the stamps slowly, because a stamp is right to a period at best.

The period is unknown until the second group ends. If it then differs from the one that was assumed, the time by which
the steps so far were wrong is returned with the sample (`mistimed`), so that its ride can be made unfit for training.
"""

from typing import Any, Final

from socast.core.cleaning.quality import Quality
from socast.core.compiled_cache import njit

FIELDS: Final = (
    "shared",  # number of periods counted since the stamp last changed
    "shares",  # running share of the samples that have the stamp of the one before [1]
    "shared_time",  # time that the last groups took, the oldest with the least weight [s]
    "shared_count",  # number of periods in them, weighted alike; 0 before the first whole group
    "part_group",  # number of periods in the group before the first whole one
    "unphased",  # 1 from a pause to the end of the first group after it
    "mistimed",  # time by which earlier steps turn out too long or too short with this sample [s]
)

CLOCK_STEP: Final = int(Quality.CLOCK_STEP)
GAP: Final = int(Quality.GAP)
STAMP_SHARED: Final = int(Quality.STAMP_SHARED)

MOST_SHARED: Final = 0.4
"""Share of samples with the stamp of the one before from which a logger is one whose samples share stamps. [1]"""
SHARED_MEMORY: Final = 30.0
"""Number of samples in this running share."""
LEAST_SHARED: Final = 3.0
"""Number of further samples with one stamp from which a logger is such a one at once."""
LONGEST_GROUP: Final = 150.0
"""Longest time between two stamps of such a logger; more is a gap. [s]"""
GROUP_MEMORY: Final = 0.9
"""Weight of a group of samples relative to the next one, when the period is learned. [1]"""
ALIKE: Final = 1.5
"""Ratio of periods within which two groups agree. [1]"""
FOLLOWED: Final = 0.1
"""Share of a small deviation from the stamps that each group corrects. [1]"""
STANDING: Final = 1.0
"""Reported speed below which the duration of a step does not change its distance. [m/s]"""


@njit(cache=False)
def is_shared(state: Any) -> bool:
    """Return whether the samples of a logger share stamps."""
    return bool(state.shares > MOST_SHARED or state.shared >= LEAST_SHARED)


@njit(cache=False)
def note_shared(state: Any) -> int:
    """Note that a sample has the stamp of the one before; return the quality bit."""
    state.shares += (1.0 - state.shares) / SHARED_MEMORY
    return STAMP_SHARED if is_shared(state) else 0


@njit(cache=False)
def note_new_stamp(state: Any) -> None:
    """Note that a sample has a stamp of its own."""
    state.shares -= state.shares / SHARED_MEMORY


@njit(cache=False)
def ends_group(state: Any, interval: float, counted: float) -> bool:
    """Return whether a sample with a new stamp follows a group that shared the last one."""
    return 0.0 < interval <= LONGEST_GROUP and counted >= 0.0 and is_shared(state)


@njit(cache=False)
def learn_period(state: Any, interval: float, total: float) -> None:
    """Update the period by a group: its time over its number of samples.

    The first group may lack its beginning. A group from which repetitions were dropped seems to have a longer period,
    so that the shortest one is believed.
    """
    if state.part_group == 0.0:
        state.part_group = total
        return
    used, found = state.period, interval / total
    if state.shared_count == 0.0 or found < used / ALIKE:
        state.mistimed = abs(used - found) * (total + state.part_group)
        state.shared_time = state.shared_count = 0.0
    elif found > used * ALIKE:
        return
    state.shared_time = GROUP_MEMORY * state.shared_time + interval
    state.shared_count = GROUP_MEMORY * state.shared_count + total
    state.period = state.interval = state.shared_time / state.shared_count


@njit(cache=False)
def end_group(state: Any, stamp: float, count: float, has_counter: bool) -> tuple[float, int]:
    """Advance the clock to the first sample with the next stamp; return the time that passed and quality bits.

    Without a counter, the clock follows a deviation of more than a period at once: samples of the group are missing.
    """
    note_new_stamp(state)
    if state.unphased == 1.0 and state.shared_count > 0.0:  # the group lacks its beginning, and its stamp is too early
        state.unphased = state.shared = 0.0
        state.time = stamp
        return count * state.period, STAMP_SHARED
    learn_period(state, stamp - state.stamp, state.shared + count)
    state.shared = 0.0
    step = count * state.period
    error = stamp - state.time - step
    if state.shared_count == 0.0 or state.mistimed > FOLLOWED * state.period:
        state.time = stamp
        return step, STAMP_SHARED | (CLOCK_STEP if abs(error) > state.period else 0)
    if has_counter and abs(error) > stamp - state.stamp + state.period:
        state.time, state.mistimed = stamp, abs(error)
        return step, STAMP_SHARED | CLOCK_STEP
    is_small = has_counter or abs(error) <= ALIKE * state.period
    step = max(0.0, step + (FOLLOWED if is_small else 1.0) * error)
    state.time += step
    if is_small:
        return step, STAMP_SHARED
    state.mistimed = 0.0 if state.fix_speed < STANDING else abs(error)
    return step, STAMP_SHARED | (GAP if error > 0.0 else 0)
