"""The one sequential kernel: everything that depends on an earlier row of the same lane.

The kernel is causal: the output of a row depends on that row and on the state of its lane. Any chunking of the input
therefore gives bitwise the same output. Its parts are the files in `_PARTS`, each with the fields of the state that it
keeps. This file composes them. Between two rows, a ride may end by a message of dispatch, or because the other cars
show that its car is silent.

In all of them `state` is the record of the lane (`STATE`), `row` the record of the sample, whose raw values are named
`raw_*`, and `settings` the record of the operator's settings.
"""

from math import cos, isnan, nan, sin
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from socast.core import batch, columns
from socast.core.batch import Batch, Floats, Ints, grown, take_lanes
from socast.core.cleaning import (
    clock,
    elevation,
    fix_motion,
    fleet_clock,
    late_samples,
    meters,
    motion,
    position_filter,
    power_sign,
    quality,
    repetition,
    segmentation,
    shared_stamps,
    slow_steps,
    speed_noise,
    speed_witness,
    sphere,
    standstill,
)
from socast.core.cleaning.clean_columns import Clean
from socast.core.cleaning.elevation_map import ElevationMap, Ground, MapLookup
from socast.core.cleaning.fleet_clock import FLEET_CLOCK, RIDE_END, new_fleet_clock
from socast.core.cleaning.quality import Quality
from socast.core.cleaning.segmentation import NO_RIDE_EVENTS
from socast.core.columns import TELEMETRY
from socast.core.compiled_cache import njit, watch_sources
from socast.core.settings import Settings

_PARTS: Final = (
    *(clock, motion, position_filter, fix_motion, elevation, segmentation),
    *(fleet_clock, meters, power_sign, repetition, speed_noise, speed_witness, standstill, slow_steps),
)
_OWN_FIELDS: Final = ("battery_temperature", "occupants")
_UNKNOWN_AT_FIRST: Final = {
    **segmentation.UNKNOWN_AT_FIRST,
    **dict.fromkeys(("seq", "latitude", "longitude", "pending_latitude", "pending_longitude"), nan),
    **dict.fromkeys(
        ("heading", "heading_latitude", "heading_longitude", "odometer", "speed", "acceleration", "ring"), nan
    ),
    **dict.fromkeys((*position_filter.UNKNOWN_AT_FIRST, *speed_noise.UNKNOWN_AT_FIRST), nan),
    **dict.fromkeys((*elevation.UNKNOWN_AT_FIRST, *meters.UNKNOWN_AT_FIRST, *speed_witness.UNKNOWN_AT_FIRST), nan),
    **dict.fromkeys((*standstill.UNKNOWN_AT_FIRST, *slow_steps.UNKNOWN_AT_FIRST), nan),
    **dict.fromkeys(("battery_temperature", "occupants"), nan),
}


def _dtype() -> np.dtype[np.void]:
    """Return the layout of a lane's state: one stretch of memory, so that a sample touches few cache lines."""
    parts = (*(field for part in _PARTS for field in part.FIELDS), *_OWN_FIELDS)
    return np.dtype([(part, "f8") if isinstance(part, str) else (part[0], "f8", (part[1],)) for part in parts])


STATE: Final = _dtype()
"""State of a lane: everything that the kernel keeps of a car between two samples."""


def new_lane_state(lanes: int) -> NDArray[np.void]:
    """Return the state of cars that have sent nothing, (lanes,) of `STATE`."""
    state = np.zeros(lanes, STATE)
    for name, value in _UNKNOWN_AT_FIRST.items():
        state[name] = value
    return state


_INPUTS: Final = (
    *(f"raw_{name}" for name in Batch._fields),
    *("raw_capacity", "raw_period", "raw_power_span"),
    *(f"map_{name}" for name in Ground._fields),
    *("cos_latitude", "sin_latitude"),
)
"""Columns of a sample, what its car has announced, and the ground under it: the first fields of `_ROW`.

The last two are derived from them, so that they are computed once."""
_ROW: Final = np.dtype([(name, "f8") for name in (*_INPUTS, *Clean._fields)])
"""One row of the kernel: its inputs, then the columns of its result."""
_RAW: Final = len(_INPUTS)
"""Number of inputs."""
_LIMITED: Final = len(Batch._fields) - len(TELEMETRY)
"""Number of the first input that has a valid range: those of `TELEMETRY`."""
_LOW: Final = np.array([column.low for column in TELEMETRY])
_HIGH: Final = np.array([column.high for column in TELEMETRY])
"""Valid range of each of these inputs."""

OUT_OF_RANGE: Final = int(Quality.OUT_OF_RANGE)
CLOCK_ROLLOVER: Final = int(Quality.CLOCK_ROLLOVER)
NOT_OF_RIDE: Final = motion.BRIDGED | meters.SOC_JUMP | meters.SOC_FROZEN
"""Bits that a step before a ride does not pass on to it."""


class Cleaner:
    """Clean batches of telemetry, with the state of every lane.

    Attributes
    ----------
    map_lookup : MapLookup
        Looks up fixes on the map, and counts those outside.
    has_new_map : bool
        Whether the state that was loaded comes from another map.

    Examples
    --------
    >>> from socast.core.batch import Lanes
    >>> from socast.core.wire.messages import Message
    >>> from socast.core.wire.decoder import Decoder
    >>> lanes = Lanes()
    >>> sample = b'{"vehicle_id": "a", "time_s": %d, "speed_kmh": 36}'
    >>> messages = [Message("fleet/a/telemetry", sample % t, 0) for t in (0, 3, 6, 9)]
    >>> batch, _ = Decoder(lanes).decode(messages)
    >>> Cleaner(Settings()).clean(batch, len(lanes)).distance.tolist()
    [0.0, 30.0, 30.0, 30.0]
    """

    def __init__(self, settings: Settings, elevation_map: ElevationMap | None = None) -> None:
        self.map_lookup, self.has_new_map = MapLookup(elevation_map), False
        self.settings = np.array([settings], np.dtype([(name, "f8") for name in Settings._fields]))
        self.state = new_lane_state(0)
        self.fleet_clock = new_fleet_clock()

    def clean(
        self,
        batch: Batch,
        lanes: int,
        capacity: Floats | float = nan,
        period: Floats | float = nan,
        power_span: Floats | float = 0.0,
    ) -> Clean:
        """Clean a batch without messages of dispatch, see `clean_between`."""
        of_cars = capacity, period, power_span
        return self.clean_between(batch, lanes, np.arange(batch.size), NO_RIDE_EVENTS, *of_cars)[0]

    def clean_between(
        self,
        batch: Batch,
        lanes: int,
        place: Ints,
        ride_events: NDArray[np.void],
        capacity: Floats | float,
        period: Floats | float,
        power_span: Floats | float = 0.0,
    ) -> tuple[Clean, NDArray[np.void]]:
        """Clean a batch, with the messages of dispatch between its rows, and advance the state of its lanes.

        Parameters
        ----------
        capacity : (n,) float or float
            Capacity to which the state of charge refers; where it is unknown (NaN), it is not compared with V·I. [J]
        period : (n,) float or float
            Period that the car has announced, 0 for a logger without one, NaN for that of the settings. [s]
        power_span : (n,) float or float
            What the power of a sample covers, as its place in `socast.core.columns.POWER_SPANS`.
        """
        if len(self.state) < lanes:
            self.state = grown(self.state, lanes, new_lane_state(1)[0])
        out = np.empty((len(Clean._fields), batch.size))
        row = np.zeros(1, _ROW)
        samples = np.empty((len(batch) + 3, batch.size))
        np.stack(batch, out=samples[:-3])
        samples[-3:] = [np.broadcast_to(each, batch.size) for each in (capacity, period, power_span)]
        found = self.map_lookup.find_ground(batch)
        ground = np.stack(found) if found else np.empty((0, batch.size))
        ends = np.empty(batch.size + lanes + len(ride_events), RIDE_END)
        between = self.fleet_clock, place, ride_events, ends
        n_ends = clean_rows(samples, ground, self.state, self.settings, row, row.view(np.float64), out, *between)
        columns = Clean(*out)  # of floats so far
        clean = columns._replace(
            lane=columns.lane.astype(np.int64),
            ride=columns.ride.astype(np.int64),
            window=columns.window.astype(np.int64),
            quality=columns.quality.astype(np.int64),
            due=columns.due != 0.0,
        )
        return clean, ends[:n_ends]

    def heard(self, lane: int) -> bool:
        """Return whether a sample of a lane has been accepted."""
        return lane < len(self.state) and bool(self.state["samples"][lane] > 0.0)

    def lanes_heard(self) -> Ints:
        """Return the lanes of which a sample has been accepted."""
        return np.flatnonzero(self.state["samples"] > 0.0)

    def ride_codes(self) -> Floats:
        """Return the codes of the rides that cars report, `NO_RIDE` or less where there is none."""
        return np.concatenate([self.state["code"], self.state["ended"]])

    def keep(self, lanes: Ints) -> None:
        """Keep the state of some lanes only, in their order."""
        self.state = take_lanes(self.state, lanes)

    def dump(self) -> Any:
        """Return the state of every lane and of the fleet clock as bytes, and that of the map."""
        return [self.state.tobytes(), self.fleet_clock.tobytes(), self.map_lookup.dump()]

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned; with another map, the elevation of cars starts anew."""
        lanes, fleet, of_map = state
        self.state = np.frombuffer(lanes, STATE).copy()
        self.fleet_clock = np.frombuffer(fleet, FLEET_CLOCK).copy()
        self.has_new_map = self.map_lookup.load(of_map)
        if self.has_new_map:
            for name in elevation.FIELDS:
                self.state[name] = new_lane_state(1)[name][0]


@njit(cache=True)
def clean_rows(
    samples: Any,
    ground: Any,
    states: Any,
    all_settings: Any,
    rows: Any,
    cells: Any,
    out: Any,
    fleet_clocks: Any,
    place: Any,
    ride_events: Any,
    ends: Any,
) -> int:
    """Clean every row, in order; return the number of rides that ended between two rows."""
    settings = all_settings[0]
    row = rows[0]
    fleet = fleet_clocks[0]
    cells[:] = nan
    n_ends = event = 0
    for i in range(samples.shape[1]):
        if event < ride_events.shape[0]:  # a call with arrays takes a tenth of the time of a row
            event, n_ends = take_ride_events(states, ride_events, event, i, ends, n_ends)
        out_of_range = False
        for j in range(samples.shape[0]):
            cells[j] = samples[j, i]
        for j in range(ground.shape[0]):
            cells[samples.shape[0] + j] = ground[j, i]
        for j in range(_LOW.shape[0]):
            if cells[_LIMITED + j] < _LOW[j] or cells[_LIMITED + j] > _HIGH[j]:
                out_of_range = True
                cells[_LIMITED + j] = nan
        cells[_RAW:] = 0.0
        row.quality = OUT_OF_RANGE if out_of_range else 0.0
        state = states[int(row.raw_lane)]
        dt = clean_row(state, row, settings)
        for j in range(out.shape[0]):
            out[j, i] = cells[_RAW + j]
        if dt != clock.UNUSED:
            fleet.cars += 1.0 if state.samples == 1.0 else 0.0
            may_be_silent = fleet_clock.advance_fleet_clock(fleet, state.time, dt, settings.gap_time)
            state.heard = fleet.progress
            if may_be_silent:
                n_ends = fleet_clock.end_silent_rides(fleet, states, i + 1, place[i], settings.gap_time, ends, n_ends)
    _, n_ends = take_ride_events(states, ride_events, event, samples.shape[1], ends, n_ends)
    return n_ends


@njit(cache=False)
def take_ride_events(states: Any, ride_events: Any, event: int, row: int, ends: Any, n_ends: int) -> tuple[int, int]:
    """Take the messages of dispatch before a row, from number `event` on; return how many were taken, and all ends."""
    while event < ride_events.shape[0] and ride_events[event].row <= row:
        lane = ride_events[event].lane
        if segmentation.take_ride_event(states[lane], ride_events[event]):
            ends[n_ends].row, ends[n_ends].lane, ends[n_ends].place = row, lane, ride_events[event].place
            n_ends += 1
        event += 1
    return event, n_ends


@njit(cache=False)
def clean_row(state: Any, row: Any, settings: Any) -> float:
    """Clean one row; return the time since the sample before it, `clock.UNUSED` for a rejected one. [s]"""
    row.cos_latitude, row.sin_latitude = cos(row.raw_latitude), sin(row.raw_latitude)
    repeated = repetition.repeats_fix(state, row)
    if clock.has_rolled_over(row.raw_stamp):
        row.raw_stamp += clock.ROLLOVER
        row.quality += CLOCK_ROLLOVER
    period = settings.period if isnan(row.raw_period) else row.raw_period
    drove = repetition.drove_on(state, row, state.period)
    same = repetition.repeats_content(state, row)
    dt, bits = clock.advance_clock(state, row.raw_stamp, row.raw_seq, same, period, drove)
    late_samples.count_strays(state, row.raw_stamp, row.raw_seq, dt == clock.UNUSED)
    row.quality += bits
    row.lane = row.raw_lane
    if dt == clock.UNUSED:
        row.speed, row.fix_sd = state.smooth, nan
    else:
        use_row(state, row, dt, settings)
        repetition.keep_accepted(state, row)
        state.fix_elevation = row.elevation_fix
    row.causal_climb = row.climb
    if repeated or dt == clock.UNUSED:
        row.elevation_fix = row.ground = nan
    row.ride = state.rides - 1.0 if state.riding == 1.0 else -1.0
    row.window = state.windows
    row.time, row.elapsed, row.parked, row.since_charge = state.time, state.elapsed, state.parked, state.since_charge
    row.latitude, row.longitude, row.heading, row.elevation = (
        state.latitude,
        state.longitude,
        state.heading,
        state.elevation,
    )
    row.soc = state.soc if state.soc_age <= max(meters.SOC_HELD, state.elapsed) else nan  # from before the ride
    row.soc_step, row.odometer, row.stopped = state.soc_step, state.odometer, state.standing
    row.battery_temperature, row.occupants, row.code = state.battery_temperature, state.occupants, state.code
    row.ambient, row.hvac, row.current, row.power = row.raw_ambient, row.raw_hvac, row.raw_current, state.power
    row.speed_scale = state.speed_scale
    return dt


@njit(cache=False)
def use_row(state: Any, row: Any, dt: float, settings: Any) -> None:
    """Update the lane by a row that stands for `dt` seconds, and fill in the row."""
    if fix_motion.has_only_fixes(state, row):
        fix_motion.move_by_fixes(state, row, dt, settings)
    else:
        motion.move_car(state, row, dt, settings)
        row.fix_sd = nan
    state.blind = 1.0 if state.riding == 1.0 and standstill.is_blind(state, row) else 0.0
    standstill.observe_stand(state, row, dt, settings)
    meters.integrate_power(state, row, dt, settings)
    power_sign.observe_acceleration(state, row, dt)
    changed = meters.update_soc(state, row, dt)
    if not isnan(row.raw_battery_temperature):
        state.battery_temperature = row.raw_battery_temperature
    if not isnan(row.raw_occupants):
        state.occupants = row.raw_occupants
    row.stop = 1.0 if standstill.begins_stop(state) else 0.0
    row.dt, row.mistimed = dt, dt if state.strays > late_samples.MOST_STRAYS else state.mistimed
    rode = state.riding == 1.0
    charging = row.raw_charging == 1.0 or bool(int(row.quality) & meters.CHARGING_INFERRED)
    follows = state.riding == 1.0 and state.speed_stuck == 1.0 and row.distance > 0.0
    moving = state.standing == 0.0 or state.blind == 1.0 or follows
    begins = segmentation.update_ride(state, row.raw_ride, dt, moving, charging, settings)
    if begins:  # the step ended before the ride and is not part of it
        row.dt = row.travel = row.distance = row.climb = row.energy = row.energy_variance = row.metered = row.stop = 0.0
        state.steep_held = 0.0
        row.acceleration_spread = row.mistimed = row.unseen = row.disputed = row.path = row.path_run = 0.0
        row.straight = row.straight_run = row.ticked = row.ticked_run = row.slow = row.slow_run = 0.0
        state.section_distance = state.tick_distance = nan
        row.quality = float(int(row.quality) & ~NOT_OF_RIDE)
        meters.begin_stillness(state, 0.0)
        if state.soc_age > meters.SOC_HELD:
            state.soc = nan
    elif int(row.quality) & clock.PAUSED:  # nothing tells whether the clock was set
        row.mistimed += dt
    # a car that stood before a gap had ended its ride's driving: no sample of it is missing
    if begins or (rode and state.riding == 0.0 and state.stand <= dt):
        row.lost = find_uncovered_time(state, int(row.quality), dt, settings)
    segmentation.update_window(state, dt, begins, state.has_power == 1.0 or changed, settings)
    row.due = 1.0 if segmentation.is_forecast_due(state, state.soc, dt, begins, settings) else 0.0


@njit(cache=False)
def find_uncovered_time(state: Any, bits: int, dt: float, settings: Any) -> float:
    """Return how much of a step lacks samples although the logger was switched on. [s]"""
    missing = bits & clock.GAP and not bits & (clock.SEQUENCE | clock.PAUSED) and dt <= settings.gap_time
    return dt - state.period if missing else 0.0


watch_sources(clean_rows, batch, columns, late_samples, quality, shared_stamps, sphere, *_PARTS)
