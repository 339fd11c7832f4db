"""Faults of loggers: each changes the samples of a car as real loggers are known to.

A fault of one kind of value needs a witness of another kind, or nothing could show it. `settle` gives the car one: an
odometer or fixes beside a wrong speed, a counter beside a clock that is set forward, a charge beside a wrong current.
"""

from collections.abc import Callable, Iterator
from typing import Final, NamedTuple

import numpy as np

from core.batch import Floats, Ints
from tools.bench.league.loggers import Car, Log, blank

VALUES, SAMPLES, CLOCK, ORDER = range(4)
"""Stages in which faults act: on values, on which samples there are, on stamps, on the order of arrival."""
CAUSES: Final = {
    "clock": ("gap", "clock", "time", "stamp", "counter", "sequence", "pause", "too_long", "too_short", "missing"),
    "speed": ("speed", "distance", "odometer"),
    "position": ("position", "fix", "distance", "speed", "slope"),
    "odometer": ("odometer", "distance"),
    "current": ("current", "power", "energy", "meter", "contradictory"),
    "charge": ("soc", "charg", "energy", "capacity", "contradictory", "too_long"),
}
"""Words of the reasons that name each family of faults."""


class Fault(NamedTuple):
    """Describe a fault.

    Parameters
    ----------
    name, family : str
        Its name, and the key in `CAUSES` of the reasons for which a ride may be unfit.
    stage : int
        When it acts.
    spoils : tuple of str
        What it makes useless as a witness.
    apply : callable
        Function that changes the samples of a car.
    prepare : callable
        Function that makes the car one that can have the fault.
    stays : tuple of str
        Stays that it needs.
    """

    name: str
    family: str
    stage: int
    spoils: tuple[str, ...]
    apply: Callable[[Log, np.random.Generator], None]
    prepare: Callable[[Car, np.random.Generator], None]
    stays: tuple[str, ...]


FAULTS: Final[dict[str, Fault]] = {}
"""Every fault by its name."""
Apply = Callable[[Log, np.random.Generator], None]


def _keep(car: Car, rng: np.random.Generator) -> None:
    """Leave a car as it is."""


def fault(
    family: str,
    stage: int = VALUES,
    *spoils: str,
    prepare: Callable[[Car, np.random.Generator], None] = _keep,
    stays: tuple[str, ...] = (),
) -> Callable[[Apply], Apply]:
    """Declare a fault by a function that has its name."""

    def declare(apply: Apply) -> Apply:
        name = apply.__name__.removesuffix("_")
        FAULTS[name] = Fault(name, family, stage, spoils, apply, prepare, stays)
        return apply

    return declare


def settle(car: Car, faults: list[Fault], rng: np.random.Generator) -> None:
    """Prepare a car for its faults, and give it the witnesses by which they can be noticed."""
    for each in faults:
        each.prepare(car, rng)
    spoiled = {part for each in faults for part in each.spoils}
    motion = [part for part in ("odometer", "position") if part not in spoiled]
    if "speed" in spoiled or "speed" not in car.sends:
        if not motion:
            motion = ["odometer"]
            car.sends.add("odometer")
        if not any(part in car.sends for part in motion):
            car.sends.add(str(rng.choice(motion)))
    if "power" in spoiled:
        car.sends.update(("power", "soc"))
    if any(each.family == "position" and "absent" not in each.name for each in faults):
        car.sends.add("position")


def find_drives(log: Log) -> Iterator[Ints]:
    """Yield the rows of each drive."""
    for number in range(len(log.car.track.drives)):
        rows = np.flatnonzero(log.drive == number)
        if len(rows) > 3:
            yield rows


def pick_block(log: Log, rows: Ints, rng: np.random.Generator, least: float, most: float) -> Ints:
    """Return the rows of some seconds within a drive."""
    true = log.true[rows]
    duration = min(rng.uniform(least, most), 0.6 * (true[-1] - true[0]))
    begin = rng.uniform(true[0] + 10.0, max(true[0] + 11.0, true[-1] - duration))
    block = rows[(true >= begin) & (true <= begin + duration)]
    return block if len(block) else rows[len(rows) // 2 : len(rows) // 2 + 1]


def _count(car: Car, rng: np.random.Generator) -> None:
    """Give the samples a counter."""
    car.counts = True


def _count_fast(car: Car, rng: np.random.Generator) -> None:
    """Give the samples a counter, and a period that is short of a burst."""
    car.counts, car.period = True, float(rng.choice((1.0, 3.0, 5.0)))


def _be_fast(car: Car, rng: np.random.Generator) -> None:
    """Make the period short of the resolution of the stamps."""
    car.period = float(rng.choice((1.0, 2.0, 3.0)))
    car.counts = car.counts or rng.random() < 0.5


# --- clocks


@fault("clock", CLOCK)
def clock_jitter(log: Log, rng: np.random.Generator) -> None:
    """Stamps with an error of 0.3 to 1 s, of 0.5 s at most without a counter."""
    spread = rng.uniform(0.3, 1.0 if log.car.counts else 0.5) * min(1.0, log.car.period / 3.0)
    log.columns["time_s"] += rng.normal(0.0, spread, len(log))


@fault("clock", CLOCK, prepare=_count)
def clock_set_forward(log: Log, rng: np.random.Generator) -> None:
    """The clock is set forward by 20 s to 2 h within each drive."""
    for rows in find_drives(log):
        log.columns["time_s"][rng.choice(rows) :] += np.exp(rng.uniform(np.log(20.0), np.log(7200.0)))


@fault("clock", CLOCK)
def clock_set_back(log: Log, rng: np.random.Generator) -> None:
    """The clock is set back by 20 s to 2 h within a drive."""
    rows = list(find_drives(log))
    log.columns["time_s"][rng.choice(rows[rng.integers(len(rows))]) :] -= np.exp(rng.uniform(3.0, np.log(7200.0)))


@fault("clock", CLOCK, prepare=_count_fast)
def clock_bursts(log: Log, rng: np.random.Generator) -> None:
    """Some samples are sent together with one stamp, that of the last."""
    size = int(rng.integers(3, 20))
    last = np.minimum((np.arange(len(log)) // size + 1) * size - 1, len(log) - 1)
    awake = np.cumsum(np.diff(log.true, prepend=log.true[0]) > 300.0)
    last = np.where(awake[last] == awake, last, np.arange(len(log)))
    log.columns["time_s"] = log.columns["time_s"][last]
    log.receipt = log.receipt[last]


def _floor(log: Log, step: float) -> None:
    """Cut stamps to a multiple of some seconds."""
    log.columns["time_s"] = np.floor(log.columns["time_s"] / step) * step


@fault("clock", CLOCK)
def clock_floored_1_s(log: Log, rng: np.random.Generator) -> None:
    """Stamps in whole seconds."""
    _floor(log, 1.0)


@fault("clock", CLOCK, prepare=_be_fast)
def clock_floored_10_s(log: Log, rng: np.random.Generator) -> None:
    """Stamps in tens of seconds."""
    _floor(log, 10.0)


@fault("clock", CLOCK, prepare=_be_fast)
def clock_floored_60_s(log: Log, rng: np.random.Generator) -> None:
    """Stamps in whole minutes."""
    _floor(log, 60.0)


@fault("clock", CLOCK)
def clock_week_rollover(log: Log, rng: np.random.Generator) -> None:
    """The receiver's week number has overflowed: 1024 weeks are missing."""
    log.columns["time_s"] -= 1024 * 7 * 86400.0


@fault("clock", CLOCK)
def clock_drift(log: Log, rng: np.random.Generator) -> None:
    """The clock runs fast or slow by up to 0.3 %."""
    log.columns["time_s"] += rng.uniform(-3e-3, 3e-3) * (log.true - log.true[0])


@fault("clock", CLOCK, prepare=_count)
def clock_summer_time(log: Log, rng: np.random.Generator) -> None:
    """The clock changes by an hour within a drive, as local time does."""
    rows = list(find_drives(log))
    log.columns["time_s"][rng.choice(rows[rng.integers(len(rows))]) :] += rng.choice((-3600.0, 3600.0))


@fault("clock", CLOCK)
def counter_absent(log: Log, rng: np.random.Generator) -> None:
    """No counter."""
    log.columns["seq"][:] = np.nan


@fault("clock", CLOCK, prepare=_count)
def counter_restarts(log: Log, rng: np.random.Generator) -> None:
    """The counter restarts at 0 within each drive."""
    for rows in find_drives(log):
        at = rng.choice(rows)
        end = rows[-1] + 1
        log.columns["seq"][at:end] -= log.columns["seq"][at]


@fault("clock", CLOCK, prepare=_count, stays=("asleep", "asleep"))
def counter_kept_asleep(log: Log, rng: np.random.Generator) -> None:
    """The counter continues over hours of sleep."""
    log.columns["seq"] = np.arange(len(log), dtype=float) + float(rng.integers(0, 5000))


@fault("clock", ORDER)
def sent_twice(log: Log, rng: np.random.Generator) -> None:
    """Samples are sent twice, some seconds apart."""
    rows = np.arange(len(log))
    again = rows[rng.random(len(log)) < rng.uniform(0.05, 0.3)]
    when = log.receipt[again] + rng.uniform(0.0, 10.0, len(again))
    first = len(log)
    log.take(np.concatenate([rows, again]))
    log.receipt[first:] = when
    log.take(np.argsort(log.receipt, kind="stable"))


@fault("clock", ORDER)
def sent_late(log: Log, rng: np.random.Generator) -> None:
    """Single samples arrive after newer ones."""
    late = rng.random(len(log)) < rng.uniform(0.01, 0.08)
    log.receipt[late] += rng.uniform(0.5, 6.0, int(late.sum())) * log.car.period
    log.take(np.argsort(log.receipt, kind="stable"))


@fault("clock", ORDER, prepare=_count)
def sent_from_cache(log: Log, rng: np.random.Generator) -> None:
    """A minute to five of samples arrive after an outage, behind newer ones."""
    for rows in find_drives(log):
        block = pick_block(log, rows, rng, 60.0, 300.0)
        log.receipt[block] = log.receipt[block[-1]] + 2.5 * log.car.period + 1e-3 * np.arange(len(block))
    log.take(np.argsort(log.receipt, kind="stable"))


@fault("clock", SAMPLES)
def samples_lost(log: Log, rng: np.random.Generator) -> None:
    """Up to a fifth of the samples is lost."""
    log.take(np.flatnonzero(rng.random(len(log)) >= rng.uniform(0.02, 0.2)))


@fault("clock", SAMPLES)
def samples_lost_for_a_minute(log: Log, rng: np.random.Generator) -> None:
    """All samples of 20 to 60 s are lost in each drive."""
    lost = np.concatenate([pick_block(log, rows, rng, 20.0, 60.0) for rows in find_drives(log)])
    log.take(np.setdiff1d(np.arange(len(log)), lost))


# --- speed


def _stick(log: Log, rng: np.random.Generator, value: float | None) -> None:
    """Keep the speed of each drive at one value for 60 to 300 s."""
    for rows in find_drives(log):
        block = pick_block(log, rows, rng, 60.0, 300.0)
        speed = log.columns["speed_kmh"]
        speed[block] = speed[block[0]] if value is None else value


@fault("speed", VALUES, "speed")
def speed_stuck_at_zero(log: Log, rng: np.random.Generator) -> None:
    """The speed is 0 for 60 to 300 s of each drive."""
    _stick(log, rng, 0.0)


@fault("speed", VALUES, "speed")
def speed_stuck(log: Log, rng: np.random.Generator) -> None:
    """The speed stays at one value for 60 to 300 s of each drive."""
    _stick(log, rng, None)


@fault("speed")
def speed_spikes(log: Log, rng: np.random.Generator) -> None:
    """Three to twelve speeds of each drive are wrong by 30 to 70 km/h."""
    for rows in find_drives(log):
        at = rng.choice(rows, min(len(rows) // 8 + 1, int(rng.integers(3, 13))), replace=False)
        spike = rng.choice((-1.0, 1.0), len(at)) * rng.uniform(30.0, 70.0, len(at))
        log.columns["speed_kmh"][at] = np.clip(log.columns["speed_kmh"][at] + spike, 0.0, 128.0)


@fault("speed")
def speed_noisy(log: Log, rng: np.random.Generator) -> None:
    """The speed has a noise of 0.5 to 2 km/h."""
    speed = log.columns["speed_kmh"]
    noisy = np.abs(speed + rng.normal(0.0, rng.uniform(0.5, 2.0), len(log)))
    log.columns["speed_kmh"] = np.where(speed > 0.0, noisy, speed)


def _scale(log: Log, factor: float) -> None:
    """Multiply the speed."""
    log.columns["speed_kmh"] *= factor


@fault("speed", VALUES, "speed")
def speed_in_mph(log: Log, rng: np.random.Generator) -> None:
    """The speed is in miles per hour."""
    _scale(log, 1.0 / 1.609344)


@fault("speed", VALUES, "speed")
def speed_in_m_s(log: Log, rng: np.random.Generator) -> None:
    """The speed is in metres per second."""
    _scale(log, 1.0 / 3.6)


@fault("speed", VALUES, "speed")
def speed_scaled(log: Log, rng: np.random.Generator) -> None:
    """The speed is wrong by a factor of 0.9 to 1.1."""
    _scale(log, float(rng.choice((0.9, 0.95, 1.03, 1.06, 1.1))))


@fault("speed", VALUES, "speed")
def speed_absent(log: Log, rng: np.random.Generator) -> None:
    """No speed."""
    blank(log, ("speed_kmh",))


@fault("speed", VALUES, "speed")
def speed_missing(log: Log, rng: np.random.Generator) -> None:
    """No speed for one to four minutes of each drive."""
    for rows in find_drives(log):
        blank(log, ("speed_kmh",), pick_block(log, rows, rng, 60.0, 240.0))


@fault("speed", VALUES, "speed", "position")
def speed_tunnel(log: Log, rng: np.random.Generator) -> None:
    """In a tunnel of 30 to 200 s the fix is lost and the speed is 0; then it is 900 to 2,000 km/h once or twice."""
    for rows in find_drives(log):
        block = pick_block(log, rows, rng, 30.0, 200.0)
        blank(log, ("latitude_deg", "longitude_deg", "elevation_m"), block)
        log.columns["speed_kmh"][block] = 0.0
        log.columns["speed_kmh"][block[-1] : block[-1] + int(rng.integers(1, 3))] = rng.uniform(900.0, 2000.0)


# --- position


@fault("position", VALUES, "position", stays=("awake", "awake"))
def position_drift_parked(log: Log, rng: np.random.Generator) -> None:
    """While the car is parked, its fix wanders by tens of metres."""
    parked = log.drive < 0
    steps = rng.normal(0.0, rng.uniform(2.0, 8.0) * np.sqrt(min(log.car.period, 10.0)), (2, len(log)))
    drift = np.clip(np.cumsum(steps * parked, axis=1), -60.0, 60.0) * parked
    _move(log, drift[0], drift[1], slice(None))


def _move(log: Log, north: Floats | float, east: Floats | float, rows: object) -> None:
    """Move fixes by some metres."""
    log.columns["latitude_deg"][rows] += np.asarray(north) / 111_195.0  # type: ignore[index]
    log.columns["longitude_deg"][rows] += np.asarray(east) / 78_000.0  # type: ignore[index]


@fault("position")
def position_jumps(log: Log, rng: np.random.Generator) -> None:
    """Three to ten single fixes of each drive are 200 m to 5 km away."""
    for rows in find_drives(log):
        at = rng.choice(rows, min(len(rows) // 8 + 1, int(rng.integers(3, 11))), replace=False)
        _move(log, rng.uniform(200.0, 5000.0, len(at)), rng.uniform(-5000.0, 5000.0, len(at)), at)


@fault("position", VALUES, "position")
def position_frozen(log: Log, rng: np.random.Generator) -> None:
    """The fix is frozen for 60 to 300 s of each drive."""
    for rows in find_drives(log):
        block = pick_block(log, rows, rng, 60.0, 300.0)
        for name in ("latitude_deg", "longitude_deg", "elevation_m"):
            log.columns[name][block] = log.columns[name][block[0]]


@fault("position")
def position_far(log: Log, rng: np.random.Generator) -> None:
    """The fixes of 30 to 120 s are 50 to 4,800 km away."""
    for rows in find_drives(log):
        _move(log, rng.uniform(50e3, 4800e3) * rng.choice((-0.8, 0.8)), 0.0, pick_block(log, rows, rng, 30.0, 120.0))


@fault("position")
def position_noisy(log: Log, rng: np.random.Generator) -> None:
    """Fixes have a noise of 5 to 15 m."""
    spread = rng.uniform(5.0, 15.0)
    _move(log, rng.normal(0.0, spread, len(log)), rng.normal(0.0, spread, len(log)), slice(None))


@fault("position", VALUES, "position")
def position_absent(log: Log, rng: np.random.Generator) -> None:
    """No fixes."""
    blank(log, ("latitude_deg", "longitude_deg", "elevation_m"))


@fault("position", VALUES, "position")
def position_missing(log: Log, rng: np.random.Generator) -> None:
    """No fix for one to four minutes of each drive."""
    for rows in find_drives(log):
        blank(log, ("latitude_deg", "longitude_deg", "elevation_m"), pick_block(log, rows, rng, 60.0, 240.0))


@fault("position", VALUES, "position")
def position_zero(log: Log, rng: np.random.Generator) -> None:
    """The fix is 0/0 for one to four minutes of each drive."""
    for rows in find_drives(log):
        block = pick_block(log, rows, rng, 60.0, 240.0)
        log.columns["latitude_deg"][block] = log.columns["longitude_deg"][block] = 0.0


def _fixes_only(car: Car, rng: np.random.Generator) -> None:
    """Send neither speed nor odometer."""
    car.sends -= {"speed", "odometer"}
    car.sends.add("position")
    car.period = min(car.period, 10.0)


@fault("position", VALUES, "speed", "odometer", prepare=_fixes_only)
def fixes_only(log: Log, rng: np.random.Generator) -> None:
    """Neither speed nor odometer."""
    blank(log, ("speed_kmh", "odometer_km"))


# --- odometer


def _drive_by_odometer(car: Car, rng: np.random.Generator) -> None:
    """Send an odometer."""
    car.sends.add("odometer")


@fault("odometer", VALUES, "odometer")
def odometer_absent(log: Log, rng: np.random.Generator) -> None:
    """No odometer."""
    blank(log, ("odometer_km",))


@fault("odometer", VALUES, "odometer", prepare=_drive_by_odometer)
def odometer_in_miles(log: Log, rng: np.random.Generator) -> None:
    """The odometer is in miles."""
    log.columns["odometer_km"] /= 1.609344


def _count_kilometres(car: Car, rng: np.random.Generator) -> None:
    """Send an odometer in whole kilometres."""
    car.sends.add("odometer")
    car.odometer_step = 1.0


@fault("odometer", prepare=_count_kilometres)
def odometer_coarse(log: Log, rng: np.random.Generator) -> None:
    """The odometer is in whole kilometres."""


# --- current and charge


@fault("current", VALUES, "power")
def current_inverted(log: Log, rng: np.random.Generator) -> None:
    """The current has the wrong sign."""
    log.columns["battery_current_a"] *= -1.0


@fault("current", VALUES, "power")
def current_frozen(log: Log, rng: np.random.Generator) -> None:
    """The current is frozen for 60 to 300 s of each drive."""
    for rows in find_drives(log):
        block = pick_block(log, rows, rng, 60.0, 300.0)
        log.columns["battery_current_a"][block] = log.columns["battery_current_a"][block[0]]


@fault("current", VALUES, "power")
def current_absent(log: Log, rng: np.random.Generator) -> None:
    """No current."""
    blank(log, ("battery_current_a",))


@fault("current", VALUES, "power")
def current_missing(log: Log, rng: np.random.Generator) -> None:
    """No current for one to four minutes of each drive."""
    for rows in find_drives(log):
        blank(log, ("battery_current_a",), pick_block(log, rows, rng, 60.0, 240.0))


@fault("charge", stays=("charging", "charging"))
def charging_unflagged(log: Log, rng: np.random.Generator) -> None:
    """The car charges between drives without saying so."""
    blank(log, ("charging",))


def _measure_by_charge(car: Car, rng: np.random.Generator) -> None:
    """Send a state of charge, and no current."""
    car.sends.add("soc")
    car.sends.discard("power")


@fault("charge", VALUES, "soc", prepare=_measure_by_charge, stays=("asleep", "asleep"))
def soc_stale_after_sleep(log: Log, rng: np.random.Generator) -> None:
    """After sleep the display keeps its old value for 20 to 60 s of driving, then falls by 2 to 6 %."""
    for begin, _ in log.car.track.drives[1:]:
        until = log.true < begin + rng.uniform(20.0, 60.0)
        fall = max(0.0, min(rng.uniform(2.0, 6.0), 99.0 - float(np.nanmax(log.columns["soc_pct"]))))
        log.columns["soc_pct"][until] += np.round(fall / log.car.quantum) * log.car.quantum


@fault("charge", VALUES, "soc")
def soc_absent(log: Log, rng: np.random.Generator) -> None:
    """No state of charge."""
    blank(log, ("soc_pct",))


# --- loggers without a period


def _send_changes(car: Car, rng: np.random.Generator) -> None:
    """Sample every second, and send what has changed."""
    car.period, car.on_change, car.announces = 1.0, True, bool(rng.random() < 0.5)


@fault("clock", SAMPLES, prepare=_send_changes)
def sent_on_change(log: Log, rng: np.random.Generator) -> None:
    """A sample is sent when a value has changed, and every minute."""
    speed, current, true = (log.columns[n].tolist() for n in ("speed_kmh", "battery_current_a", "battery_voltage_v"))
    true, kept, last = log.true.tolist(), [], (-99.0, 0.0, 0.0)
    for i, (v, a, t) in enumerate(zip(speed, current, true, strict=True)):
        if abs(v - last[0]) >= 1.0 or abs(a - last[1]) >= 2.0 or t - last[2] >= 55.0:
            kept.append(i)
            last = (v if v == v else last[0], a if a == a else last[1], t)  # noqa: PLR0124
    fresh = np.diff(log.columns["seq"][kept], prepend=-1.0) < 0.0
    log.take(np.array(kept))
    runs = np.maximum.accumulate(np.where(fresh, np.arange(len(log)), 0))
    log.columns["seq"] += np.arange(len(log)) - runs - log.columns["seq"]
