"""Find where the samples of a fleet show that one of its cars is silent, without cleaning the samples.

The kernel ends the ride of a silent car by the fleet clock (`socast.core.cleaning.fleet_clock`), for which it needs the
samples of all cars in their order. The fleet clock depends only on the repaired times of the samples, which take a
small part of the work. If the times are repaired first, each car can be cleaned without the others: its silences stand
between its samples as events. A silence of a car that is not on a ride has no effect.
"""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from socast.core import columns
from socast.core.batch import Batch, Floats, Ints, grown
from socast.core.cleaning import (
    clock,
    fleet_clock,
    kernel,
    late_samples,
    quality,
    repetition,
    segmentation,
    shared_stamps,
)
from socast.core.cleaning.fleet_clock import RIDE_END, new_fleet_clock
from socast.core.columns import TELEMETRY
from socast.core.compiled_cache import njit, watch_sources
from socast.core.settings import Settings

INPUTS: Final = ("stamp", "seq", "latitude", "longitude", "speed", "current", "soc")
"""Columns of a batch on which repaired times depend."""
_RANGES: Final = np.array([(column.low, column.high) for name in INPUTS for column in TELEMETRY if column.name == name])
_SAMPLE: Final = np.dtype([(f"raw_{name}", "f8") for name in INPUTS])
_CAR: Final = np.dtype(
    [
        *((name, "f8") if isinstance(name, str) else (name[0], "f8", (name[1],)) for name in clock.FIELDS),
        *((name, "f8") for name in repetition.FIELDS),
        *((name, "f8") for name in ("heard", "riding", "idle", "code")),
    ]
)
"""The part of `STATE` of the kernel on which the fleet clock depends; `riding` is 1 until a car is silent."""


class FleetSilences:
    """Find the silences of cars.

    Examples
    --------
    >>> from socast.core.batch import Lanes
    >>> from socast.core.wire.decoder import Decoder
    >>> from socast.core.wire.messages import Message
    >>> sample = '{"vehicle_id": "%s", "time_s": %d, "speed_kmh": 36}'
    >>> cars = ["a"] + ["b"] * 300
    >>> texts = [(car, sample % (car, 3 * i)) for i, car in enumerate(cars)]
    >>> lanes = Lanes()
    >>> messages = [Message(f"fleet/{car}/telemetry", text.encode(), 0) for car, text in texts]
    >>> batch, _ = Decoder(lanes).decode(messages)
    >>> unknown = np.full(batch.size, np.nan)
    >>> FleetSilences(Settings()).find(select_inputs(batch), batch.lane, 2, unknown).tolist()
    [(203, 0, 202)]
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = np.array([settings], np.dtype([(name, "f8") for name in Settings._fields]))
        self._clock = new_fleet_clock()
        self._cars: NDArray[np.void] = _new_cars(0)

    def find(self, samples: Floats, lane: Ints, lanes: int, period: Floats) -> NDArray[np.void]:
        """Return the silences that samples show.

        Returns
        -------
        (m,) RIDE_END
            Their `place` is the number of the sample that shows it, and `row` the one after it.
        """
        self._cars = grown(self._cars, lanes, _new_cars(1)[0])
        silences = np.empty(len(lane) + lanes, RIDE_END)
        row = np.zeros(1, _SAMPLE)
        cells = row.view(np.float64)
        count = find_silences(
            samples, lane, period, _RANGES, self._cars, self._settings, row, cells, self._clock, silences
        )
        return silences[:count]


def select_inputs(batch: Batch) -> Floats:
    """Return the columns of a batch on which repaired times depend, (len(INPUTS), n)."""
    return np.stack([getattr(batch, name) for name in INPUTS])


def _new_cars(lanes: int) -> NDArray[np.void]:
    """Return the state of cars that have sent nothing, as in the kernel."""
    cars, state = np.zeros(lanes, _CAR), kernel.new_lane_state(lanes)
    for name in _CAR.names or ():
        cars[name] = state[name]
    return cars


@njit(cache=True)
def find_silences(
    samples: Any,
    lane: Any,
    periods: Any,
    ranges: Any,
    cars: Any,
    all_settings: Any,
    rows: Any,
    cells: Any,
    clocks: Any,
    silences: Any,
) -> int:
    """Repair the time of every sample and advance the fleet clock by it; return the number of silences."""
    settings, row, fleet, count = all_settings[0], rows[0], clocks[0], 0
    for i in range(len(lane)):
        for j in range(samples.shape[0]):
            value = samples[j, i]
            cells[j] = np.nan if value < ranges[j, 0] or value > ranges[j, 1] else value
        car = cars[lane[i]]
        if clock.has_rolled_over(row.raw_stamp):
            row.raw_stamp += clock.ROLLOVER
        drove = repetition.drove_on(car, row, car.period)
        same = repetition.repeats_content(car, row)
        period = settings.period if np.isnan(periods[i]) else periods[i]
        dt, _ = clock.advance_clock(car, row.raw_stamp, row.raw_seq, same, period, drove)
        if dt == clock.UNUSED:
            continue
        repetition.keep_accepted(car, row)
        fleet.cars += 1.0 if car.samples == 1.0 else 0.0
        may_be_silent = fleet_clock.advance_fleet_clock(fleet, car.time, dt, settings.gap_time)
        car.heard, car.riding = fleet.progress, 1.0
        if may_be_silent:
            count = fleet_clock.end_silent_rides(fleet, cars, i + 1, i, settings.gap_time, silences, count)
    return count


watch_sources(
    find_silences, clock, columns, fleet_clock, late_samples, quality, repetition, segmentation, shared_stamps
)
