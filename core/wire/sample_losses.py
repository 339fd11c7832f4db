"""Count the samples of each car that were sent and never came: by the counter of its logger, else by its period."""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Batch, Ints, Lanes, grown, take_lanes
from socast.core.compiled_cache import njit

SAMPLE_LOSS: Final = np.dtype(
    [
        ("received", "i8"),  # samples that came
        ("lost", "i8"),  # samples that have not come
        ("seq", "f8"),  # highest counter so far, NaN before the first sample with one
        ("stamp", "f8"),  # stamp of the sample that has this counter, or of the last one [s]
        ("leap", "f8"),  # counter of the last sample that leapt far ahead
        ("period", "f8"),  # running median of the intervals of stamps without a counter, 0 before the first [s]
    ]
)
"""State of a car."""

FEWEST: Final = 100.0
"""Number of samples by which a counter may advance at once whatever the stamps say."""
SHORTEST: Final = 0.1
"""Shortest credible period of a logger; a counter that advances faster has leapt. [s]"""
LONGEST: Final = 600.0
"""Longest silence that counts as lost samples where there is no counter; a logger that is silent longer was off. [s]"""


class SampleLosses:
    """Count received and lost samples of each car.

    A sample that comes late, after others with higher counters, is no longer lost. A counter that starts again is a
    power cycle of the logger and costs nothing.
    """

    def __init__(self, lanes: Lanes) -> None:
        self._lanes = lanes
        self._state: NDArray[np.void] = np.zeros(0, SAMPLE_LOSS)

    def count(self, batch: Batch, is_periodic: NDArray[np.bool_]) -> None:
        """Count the samples of a batch.

        Parameters
        ----------
        is_periodic : (n,) bool
            False for the samples of a logger without a period, of which losses show in the counter only.
        """
        self._state = grown(self._state, len(self._lanes), _new_car())
        _count(self._state, batch.lane, batch.stamp, batch.seq, is_periodic)

    def received(self) -> NDArray[np.int64]:
        """Return the number of samples that came of each car, (n,) in the order of lanes."""
        return self._known()["received"]

    def lost(self) -> NDArray[np.int64]:
        """Return the number of samples that have not come of each car, (n,) in the order of lanes."""
        return self._known()["lost"]

    def keep(self, lanes: Ints) -> None:
        """Keep the state of some lanes only, in their order."""
        self._state = take_lanes(self._state, lanes)

    def dump(self) -> Any:
        """Return the state as bytes."""
        return self._known().tobytes()

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned."""
        self._state = np.frombuffer(state, SAMPLE_LOSS).copy()

    def _known(self) -> NDArray[np.void]:
        """Return the state of every car that is known."""
        self._state = grown(self._state, len(self._lanes), _new_car())
        return self._state[: len(self._lanes)]


def _new_car() -> Any:
    """Return the state of a car before its first sample."""
    return np.array([(0, 0, np.nan, np.nan, np.nan, 0.0)], SAMPLE_LOSS)[0]


@njit(cache=True)
def _count(state: Any, lane: Any, stamp: Any, seq: Any, is_periodic: Any) -> None:
    """Count samples in the state of their cars."""
    for i in range(len(lane)):
        car = state[lane[i]]
        car.received += 1
        if not np.isnan(seq[i]):
            _count_by_counter(car, stamp[i], seq[i])
        elif is_periodic[i] and not np.isnan(stamp[i]):
            _count_by_period(car, stamp[i])


@njit(cache=True)
def _count_by_counter(car: Any, stamp: float, seq: float) -> None:
    """Count the samples between a sample and the highest counter before it."""
    ahead = seq - car.seq
    if np.isnan(ahead):
        car.seq, car.stamp = seq, stamp
    elif ahead >= 1.0:
        missing = ahead - 1.0
        credible = missing <= FEWEST or stamp - car.stamp >= SHORTEST * missing
        if credible and missing <= 1e6:
            car.lost += int(missing)
        elif not 0.0 < seq - car.leap <= FEWEST:  # one sample may be corrupt; a second one that follows it is not
            car.leap = seq
            return
        car.seq, car.stamp, car.leap = seq, stamp, np.nan
    elif stamp > car.stamp and ahead < 0.0:  # a power cycle
        car.seq, car.stamp = seq, stamp
    elif ahead < 0.0 and car.lost > 0:
        car.lost -= 1


@njit(cache=True)
def _count_by_period(car: Any, stamp: float) -> None:
    """Count the periods between a sample and the one before it."""
    elapsed = stamp - car.stamp
    if elapsed <= 0.0:
        car.lost -= 1 if car.lost > 0 and elapsed < 0.0 else 0
        return
    car.stamp = stamp
    if np.isnan(elapsed) or elapsed > LONGEST:
        return
    if car.period == 0.0:
        car.period = elapsed
    periods = np.round(elapsed / car.period)
    if periods >= 2.0:
        car.lost += int(periods) - 1
    step = 0.02 * car.period
    car.period += min(step, max(-step, elapsed - car.period))
