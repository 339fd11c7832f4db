"""The one sequential kernel: what depends on the row before it in the same lane, and nothing else.

Causal and online: a row's output rests on that row and on the lane's state, so any chunking of the input gives
bitwise the same output. The parts of the kernel are `core.cleaning.clock`, `core.cleaning.motion` and `core.cleaning.segmentation`, each with the state
that it keeps; this file strings them together.
"""

from hashlib import sha256
from math import isnan, nan
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from core import batch, columns
from core.batch import Batch, Floats, Ints, grown
from core.cleaning import clock, motion, quality, segmentation
from core.cleaning.quality import Quality
from core.columns import TELEMETRY
from core.settings import Settings

_OWN_FIELDS: Final = (
    *(f"last_{name}" for name in ("latitude", "longitude", "speed", "current", "soc")),  # to know a duplicate by
    "power",  # [W]
    "has_power",
    "soc",  # last believed
    "has_soc",
    "soc_age",  # since it was last reported [s]
    "soc_step",  # smallest change seen: the quantum
    "battery_temperature",
    "occupants",
)
_UNKNOWN_AT_FIRST: Final = {
    **segmentation.UNKNOWN_AT_FIRST,
    **dict.fromkeys(("seq", "latitude", "longitude", "pending_latitude", "pending_longitude"), nan),
    **dict.fromkeys(("heading", "heading_latitude", "heading_longitude", "odometer", "speed", "ring"), nan),
    **dict.fromkeys(("elevation", "level", "power", "soc", "soc_step"), nan),
    **dict.fromkeys(("battery_temperature", "occupants"), nan),
}


def _dtype() -> np.dtype[np.void]:
    """Lay the state of a lane out in one stretch of memory, so that a sample touches few cache lines."""
    parts = (*clock.FIELDS, *motion.FIELDS, *segmentation.FIELDS, *_OWN_FIELDS)
    return np.dtype([(part, "f8") if isinstance(part, str) else (part[0], "f8", (part[1],)) for part in parts])


STATE: Final = _dtype()
"""State of a lane: everything that the kernel remembers of a car."""


def new_state(lanes: int) -> NDArray[np.void]:
    """Return the state of `lanes` cars never heard of, (lanes,) of `STATE`."""
    state = np.zeros(lanes, STATE)
    for name, value in _UNKNOWN_AT_FIRST.items():
        state[name] = value
    return state


class Clean(NamedTuple):
    """Cleaned telemetry: equally long columns, one row a sample, rows not used standing for no time and no distance.

    Parameters
    ----------
    lane : (n,) int64
    ride : (n,) int64. Ordinal of the ride in its lane, -1 outside rides.
    window : (n,) int64. Ordinal of the window in its lane.
    quality : (n,) int64. `core.cleaning.quality.Quality` bits.
    due : (n,) bool. A forecast is due at this sample.
    time : (n,) float64. Repaired Unix time. [s]
    dt, travel : (n,) float64. Time that the row stands for, and time that its distance took. [s]
    distance, climb : (n,) float64. [m]
    speed, acceleration : (n,) float64. Smoothed, over the step. [m/s], [m/s^2]
    latitude, longitude, heading, turn_rate : (n,) float64. Of the last believed fix. [rad], [rad/s]
    elevation : (n,) float64. Smoothed. [m]
    power : (n,) float64. Drawn from the battery at the sample, by V I, NaN where not measured. [W]
    energy, metered : (n,) float64. Drawn from the battery in the step, by V I, and the time it is known for. [J], [s]
    energy_variance : (n,) float64. Of that energy, as the power between two samples is not known. [J^2]
    elapsed, parked, since_charge : (n,) float64. [s]
    lost : (n,) float64. Where a ride begins or ends: time before the row of which no sample tells. [s]
    stop, stopped : (n,) float64. 1 where a stop begins, 1 where the car stands.
    soc, soc_step, odometer, battery_temperature, occupants, code : (n,) float64. As last believed.
    ambient, hvac, current : (n,) float64. As reported, NaN where not.
    """

    lane: Ints
    ride: Ints
    window: Ints
    quality: Ints
    due: NDArray[np.bool_]
    time: Floats
    dt: Floats
    travel: Floats
    distance: Floats
    climb: Floats
    speed: Floats
    acceleration: Floats
    latitude: Floats
    longitude: Floats
    heading: Floats
    turn_rate: Floats
    elevation: Floats
    power: Floats
    energy: Floats
    metered: Floats
    energy_variance: Floats
    elapsed: Floats
    parked: Floats
    since_charge: Floats
    lost: Floats
    stop: Floats
    stopped: Floats
    soc: Floats
    soc_step: Floats
    odometer: Floats
    battery_temperature: Floats
    ambient: Floats
    occupants: Floats
    hvac: Floats
    current: Floats
    code: Floats


_ROW: Final = np.dtype([*((f"raw_{name}", "f8") for name in Batch._fields), *((name, "f8") for name in Clean._fields)])
_BROUGHT: Final = len(Batch._fields)
_TO_INT: Final = Clean._fields.index("time")  # the columns before it are not floats
_LOW: Final = np.array([-np.inf, -np.inf, *(column.low for column in TELEMETRY)])
_HIGH: Final = np.array([np.inf, np.inf, *(column.high for column in TELEMETRY)])

OUT_OF_RANGE: Final = int(Quality.OUT_OF_RANGE)
SOC_MISSING: Final = int(Quality.SOC_MISSING)
POWER_MISSING: Final = int(Quality.POWER_MISSING)
STALE: Final = 60.0  # a state of charge this old says nothing of a ride that begins [s]
LONGEST_TRAPEZOID: Final = 10.5  # power is interpolated over holes of up to so many periods


class Cleaner:
    """The kernel and the state of every lane.

    Parameters
    ----------
    settings : Settings

    Examples
    --------
    >>> from core.batch import Lanes
    >>> from core.wire.messages import Message
    >>> from core.wire.decoder import Decoder
    >>> lanes = Lanes()
    >>> sample = b'{"vehicle_id": "a", "time_s": %d, "speed_kmh": 36}'
    >>> messages = [Message("fleet/a/telemetry", sample % t, 0) for t in (0, 3, 6, 9)]
    >>> batch, _ = Decoder(lanes).decode(messages)
    >>> Cleaner(Settings()).clean(batch, len(lanes)).distance.tolist()
    [0.0, 30.0, 30.0, 30.0]
    """

    def __init__(self, settings: Settings) -> None:
        self.settings = np.array([settings], np.dtype([(name, "f8") for name in Settings._fields]))
        self.state = new_state(0)

    def clean(self, batch: Batch, lanes: int) -> Clean:
        """Clean a batch and move the state on; `lanes` is how many there are so far."""
        if len(self.state) < lanes:
            self.state = grown(self.state, lanes, new_state(1)[0])
        out = np.empty((len(Clean._fields), batch.size))
        row = np.zeros(1, _ROW)
        kernel(np.stack(batch), self.state, self.settings, row, row.view(np.float64), out)
        lane, ride, window, quality = out[: _TO_INT - 1].astype(np.int64)
        return Clean(lane, ride, window, quality, out[_TO_INT - 1] != 0.0, *out[_TO_INT:])

    def heard(self, lane: int) -> bool:
        """Return whether a sample of a lane has been accepted."""
        return lane < len(self.state) and bool(self.state["samples"][lane] > 0.0)

    def lanes_heard(self) -> Ints:
        """Return the lanes of which a sample has been accepted."""
        return np.flatnonzero(self.state["samples"] > 0.0)

    def ride_codes(self) -> Floats:
        """Return the code of the ride in progress in each lane, `NO_RIDE` where there is none."""
        return np.asarray(self.state["code"])

    def dump(self) -> bytes:
        """Return the state of every lane as bytes."""
        return self.state.tobytes()

    def load(self, state: bytes) -> None:
        """Replace the state by one that `dump` returned."""
        self.state = np.frombuffer(state, STATE).copy()


@njit(cache=True)
def kernel(columns: Any, state: Any, settings: Any, rows: Any, cells: Any, out: Any) -> None:
    """Clean every row, in order.

    Parameters
    ----------
    columns : (_BROUGHT, n) float64. The batch.
    state : (lanes,) STATE. Changed in place.
    settings : (1,) record.
    rows, cells : (1,) _ROW and the same memory as floats. The row that is being worked on.
    out : (len(Clean._fields), n) float64.
    """
    x = settings[0]
    r = rows[0]
    for i in range(columns.shape[1]):
        strange = False
        for j in range(_BROUGHT):
            value = columns[j, i]
            if value < _LOW[j] or value > _HIGH[j]:
                strange = True
                value = nan
            cells[j] = value
        cells[_BROUGHT:] = 0.0
        r.quality = OUT_OF_RANGE if strange else 0.0
        clean_row(state[int(r.raw_lane)], r, x)
        for j in range(out.shape[0]):
            out[j, i] = cells[_BROUGHT + j]


@njit(cache=False)
def clean_row(s: Any, r: Any, x: Any) -> None:
    """Clean one row."""
    dt, bits = clock.advance(s, r.raw_stamp, r.raw_seq, same_content(s, r), x.period)
    r.quality += bits
    r.lane = r.raw_lane
    if dt == clock.UNUSED:
        r.speed = s.smooth
    else:
        use(s, r, dt, x)
    r.ride = s.rides - 1.0 if s.riding == 1.0 else -1.0
    r.window = s.windows
    r.time, r.elapsed, r.parked, r.since_charge = s.time, s.elapsed, s.parked, s.since_charge
    r.latitude, r.longitude, r.heading, r.elevation = s.latitude, s.longitude, s.heading, s.elevation
    r.soc = s.soc if s.soc_age <= max(STALE, s.elapsed) else nan  # what was said before the ride says nothing of it
    r.soc_step, r.odometer, r.stopped = s.soc_step, s.odometer, s.standing
    r.battery_temperature, r.occupants, r.code = s.battery_temperature, s.occupants, s.code
    r.ambient, r.hvac, r.current, r.power = r.raw_ambient, r.raw_hvac, r.raw_current, s.power


@njit(cache=False)
def use(s: Any, r: Any, dt: float, x: Any) -> None:
    """Take a row that stands for `dt` seconds."""
    motion.move(s, r, dt, x)
    meter(s, r, dt, x)
    changed = charge_state(s, r, dt)
    if not isnan(r.raw_battery_temperature):
        s.battery_temperature = r.raw_battery_temperature
    if not isnan(r.raw_occupants):
        s.occupants = r.raw_occupants
    r.stop = 1.0 if stands(s) else 0.0
    r.dt = dt
    rode = s.riding == 1.0
    begins = segmentation.segment(s, r.raw_ride, dt, s.standing == 0.0, r.raw_charging == 1.0, x)
    if begins:  # the step led up to the ride and is not part of it
        r.dt = r.travel = r.distance = r.climb = r.energy = r.energy_variance = r.metered = r.stop = 0.0
        if int(r.quality) & motion.BRIDGED:
            r.quality -= motion.BRIDGED
        if s.soc_age > STALE:
            s.soc = nan
    if begins or (rode and s.riding == 0.0):
        r.lost = lost_time(s, int(r.quality), dt, x)
    segmentation.window(s, dt, begins, s.has_power == 1.0 or changed, x)
    r.due = 1.0 if segmentation.forecast_due(s, s.soc, dt, begins, x) else 0.0


@njit(cache=False)
def lost_time(s: Any, bits: int, dt: float, x: Any) -> float:
    """Return how much of a step is missing samples, and not a logger that was switched off. [s]"""
    missing = bits & clock.GAP and not bits & clock.SEQUENCE and dt <= x.gap_time
    return dt - s.period if missing else 0.0


@njit(cache=False)
def same_content(s: Any, r: Any) -> bool:
    """Say whether a row says the same as the row before it in its lane, and remember it."""
    same = s.samples > 0.0
    same &= r.raw_latitude == s.last_latitude or (isnan(r.raw_latitude) and isnan(s.last_latitude))
    same &= r.raw_longitude == s.last_longitude or (isnan(r.raw_longitude) and isnan(s.last_longitude))
    same &= r.raw_speed == s.last_speed or (isnan(r.raw_speed) and isnan(s.last_speed))
    same &= r.raw_current == s.last_current or (isnan(r.raw_current) and isnan(s.last_current))
    same &= r.raw_soc == s.last_soc or (isnan(r.raw_soc) and isnan(s.last_soc))
    s.last_latitude, s.last_longitude, s.last_speed = r.raw_latitude, r.raw_longitude, r.raw_speed
    s.last_current, s.last_soc = r.raw_current, r.raw_soc
    return same


@njit(cache=False)
def meter(s: Any, r: Any, dt: float, x: Any) -> None:
    """Measure the energy drawn in the step, by the trapezoid of V I, and how uncertain the power between makes it.

    Where the power changes by dP between samples, its integral has the variance (dP dt)^2 / 12 if it wanders
    like a Brownian bridge, and (dP dt)^2 / 2 if it is noise. An eighth holds for driving: chosen on simulated rides, it
    covers those of other seeds.
    """
    power = r.raw_voltage * r.raw_current
    if isnan(power):
        r.quality += POWER_MISSING if s.has_power == 1.0 else 0
    else:
        s.has_power = 1.0
        if dt <= LONGEST_TRAPEZOID * x.period:
            before = power if isnan(s.power) else s.power
            r.energy = 0.5 * (power + before) * dt
            r.energy_variance = ((power - before) * dt) ** 2 / 8.0
            r.metered = dt
    s.power = power


@njit(cache=False)
def charge_state(s: Any, r: Any, dt: float) -> bool:
    """Take the reported state of charge; return whether it changed."""
    s.soc_age += dt
    if isnan(r.raw_soc):
        r.quality += SOC_MISSING if s.has_soc == 1.0 else 0
        return False
    s.has_soc = 1.0
    s.soc_age = 0.0
    change = abs(r.raw_soc - s.soc)
    s.soc = r.raw_soc
    changed = change > 1e-6
    if changed and not change >= s.soc_step:
        s.soc_step = change
    return changed


@njit(cache=False)
def stands(s: Any) -> bool:
    """Say whether a stop begins with this sample, with hysteresis."""
    if s.smooth > motion.MOVING:
        s.standing = 0.0
    elif s.smooth < motion.CRAWL and s.standing == 0.0:
        s.standing = 1.0
        return True
    return False


def _sources() -> str:
    """Return a digest of every file that the kernel is made of."""
    files = [__file__, *(str(module.__file__) for module in (batch, clock, columns, motion, quality, segmentation))]
    return sha256(b"".join(Path(file).read_bytes() for file in files)).hexdigest()


# numba renews a kernel kept on disk when the file it stands in changes, not when its parts do
kernel._cache._cache_file._source_stamp = _sources()  # type: ignore[attr-defined] # noqa: SLF001
