"""Every fault by its name, and those of speed, position, odometer, current and charge."""

from typing import Any, Final

import numpy as np

from socast.core.batch import Floats
from socast.tools.bench.league import clock_faults
from socast.tools.bench.league.loggers import (
    FAULTS,
    VALUES,
    Apply,
    Car,
    Log,
    blank,
    declare,
    fault,
    find_drives,
    keep,
    pick_block,
)

__all__ = ["FAULTS", "clock_faults"]


_SPEED: Final = ("speed_kmh",)
_FIX: Final = ("latitude_deg", "longitude_deg", "elevation_m")
_CURRENT: Final = ("battery_current_a",)
_OF_SPEED: Final = "speed", VALUES, "speed"
_OF_POSITION: Final = "position", VALUES, "position"
_OF_CURRENT: Final = "current", VALUES, "power"
"""Family, stage and spoilt witness of most faults of a field."""


def _hold(fields: tuple[str, ...], value: float | None = None) -> Apply:
    """Return a fault that keeps fields of each drive at one value for 60 to 300 s, by default at that of before."""

    def apply(log: Log, rng: np.random.Generator) -> None:
        for rows in find_drives(log):
            block = pick_block(log, rows, rng, 60.0, 300.0)
            for name in fields:
                log.columns[name][block] = log.columns[name][block[0]] if value is None else value

    return apply


def _multiply(field: str, factor: float) -> Apply:
    """Return a fault that multiplies a field."""

    def apply(log: Log, _: np.random.Generator) -> None:
        log.columns[field] *= factor

    return apply


def _leave_out(fields: tuple[str, ...]) -> Apply:
    """Return a fault that sends null for some fields."""
    return lambda log, _: blank(log, fields)


def _leave_out_awhile(fields: tuple[str, ...]) -> Apply:
    """Return a fault that sends null for some fields for one to four minutes of each drive."""

    def apply(log: Log, rng: np.random.Generator) -> None:
        for rows in find_drives(log):
            blank(log, fields, pick_block(log, rows, rng, 60.0, 240.0))

    return apply


declare("speed_stuck_at_zero", "Report a speed of 0 for 60 to 300 s of each drive.", _hold(_SPEED, 0.0), *_OF_SPEED)
declare("speed_stuck", "Repeat one speed for 60 to 300 s of each drive.", _hold(_SPEED), *_OF_SPEED)


@fault(*_OF_SPEED)
def speed_spikes(log: Log, rng: np.random.Generator) -> None:
    """Change 3 to 12 speeds of each drive by 30 to 70 km/h."""
    for rows in find_drives(log):
        at = rng.choice(rows, min(len(rows) // 8 + 1, int(rng.integers(3, 13))), replace=False)
        spike = rng.choice((-1.0, 1.0), len(at)) * rng.uniform(30.0, 70.0, len(at))
        log.columns["speed_kmh"][at] = np.clip(log.columns["speed_kmh"][at] + spike, 0.0, 128.0)


@fault("speed")
def speed_noisy(log: Log, rng: np.random.Generator) -> None:
    """Add a noise of 0.5 to 2 km/h to the speed."""
    speed = log.columns["speed_kmh"]
    noisy = np.abs(speed + rng.normal(0.0, rng.uniform(0.5, 2.0), len(log)))
    log.columns["speed_kmh"] = np.where(speed > 0.0, noisy, speed)


declare("speed_in_mph", "Report the speed in miles per hour.", _multiply("speed_kmh", 1.0 / 1.609344), *_OF_SPEED)
declare("speed_in_m_s", "Report the speed in metres per second.", _multiply("speed_kmh", 1.0 / 3.6), *_OF_SPEED)


@fault(*_OF_SPEED)
def speed_scaled(log: Log, rng: np.random.Generator) -> None:
    """Multiply the speed by 0.9 to 1.1."""
    log.columns["speed_kmh"] *= float(rng.choice((0.9, 0.95, 1.03, 1.06, 1.1)))


declare("speed_absent", "Send no speed.", _leave_out(_SPEED), *_OF_SPEED)
declare("speed_missing", "Send no speed for one to four minutes of each drive.", _leave_out_awhile(_SPEED), *_OF_SPEED)


@fault(*_OF_SPEED)
def speed_tunnel(log: Log, rng: np.random.Generator) -> None:
    """Lose the fix for 30 to 200 s with a speed of 0, then report 900 to 2,000 km/h once or twice."""
    for rows in find_drives(log):
        block = pick_block(log, rows, rng, 30.0, 200.0)
        blank(log, _FIX, block)
        log.columns["speed_kmh"][block] = 0.0
        log.columns["speed_kmh"][block[-1] : block[-1] + int(rng.integers(1, 3))] = rng.uniform(900.0, 2000.0)


@fault(*_OF_POSITION, stays=("awake", "awake"))
def position_drift_parked(log: Log, rng: np.random.Generator) -> None:
    """Let the fix of the parked car wander by tens of metres."""
    parked = log.drive < 0
    steps = rng.normal(0.0, rng.uniform(2.0, 8.0) * np.sqrt(min(log.car.period, 10.0)), (2, len(log)))
    drift = np.clip(np.cumsum(steps * parked, axis=1), -60.0, 60.0) * parked
    _move(log, drift[0], drift[1], slice(None))


def _move(log: Log, north: Floats | float, east: Floats | float, rows: Any) -> None:
    """Move fixes by some metres."""
    log.columns["latitude_deg"][rows] += np.asarray(north) / 111_195.0
    log.columns["longitude_deg"][rows] += np.asarray(east) / 78_000.0


@fault("position")
def position_jumps(log: Log, rng: np.random.Generator) -> None:
    """Move 3 to 10 single fixes of each drive by up to 7 km."""
    for rows in find_drives(log):
        at = rng.choice(rows, min(len(rows) // 8 + 1, int(rng.integers(3, 11))), replace=False)
        _move(log, rng.uniform(200.0, 5000.0, len(at)), rng.uniform(-5000.0, 5000.0, len(at)), at)


declare("position_frozen", "Repeat one fix for 60 to 300 s of each drive.", _hold(_FIX), *_OF_POSITION)


@fault("position")
def position_far(log: Log, rng: np.random.Generator) -> None:
    """Move the fixes of 30 to 120 s by 50 to 4,800 km."""
    for rows in find_drives(log):
        _move(log, rng.uniform(50e3, 4800e3) * rng.choice((-0.8, 0.8)), 0.0, pick_block(log, rows, rng, 30.0, 120.0))


@fault("position")
def position_noisy(log: Log, rng: np.random.Generator) -> None:
    """Add a noise of 5 to 15 m to fixes."""
    spread = rng.uniform(5.0, 15.0)
    _move(log, rng.normal(0.0, spread, len(log)), rng.normal(0.0, spread, len(log)), slice(None))


declare("position_absent", "Send no fixes.", _leave_out(_FIX), *_OF_POSITION)
declare(
    "position_missing", "Send no fix for one to four minutes of each drive.", _leave_out_awhile(_FIX), *_OF_POSITION
)


@fault(*_OF_POSITION)
def position_zero(log: Log, rng: np.random.Generator) -> None:
    """Send the fix 0/0 for one to four minutes of each drive."""
    for rows in find_drives(log):
        block = pick_block(log, rows, rng, 60.0, 240.0)
        log.columns["latitude_deg"][block] = log.columns["longitude_deg"][block] = 0.0


def _fixes_only(car: Car, _: np.random.Generator) -> None:
    """Send neither speed nor odometer."""
    car.sends -= {"speed", "odometer"}
    car.sends.add("position")
    car.period = min(car.period, 10.0)


declare(
    "fixes_only",
    "Send neither speed nor odometer.",
    _leave_out((*_SPEED, "odometer_km")),
    "position",
    VALUES,
    "speed",
    "odometer",
    prepare=_fixes_only,
)


def _drive_by_odometer(car: Car, _: np.random.Generator) -> None:
    """Send an odometer."""
    car.sends.add("odometer")


declare("odometer_absent", "Send no odometer.", _leave_out(("odometer_km",)), "odometer", VALUES, "odometer")


@fault("odometer", VALUES, "odometer", prepare=_drive_by_odometer)
def odometer_in_miles(log: Log, _: np.random.Generator) -> None:
    """Report the odometer in miles."""
    log.columns["odometer_km"] /= 1.609344


def _count_kilometres(car: Car, _: np.random.Generator) -> None:
    """Send an odometer in whole kilometres."""
    car.sends.add("odometer")
    car.odometer_step = 1.0


declare("odometer_coarse", "Report the odometer in whole kilometres.", keep, "odometer", prepare=_count_kilometres)
declare(
    "current_inverted", "Report the current with the wrong sign.", _multiply("battery_current_a", -1.0), *_OF_CURRENT
)
declare("current_frozen", "Repeat one current for 60 to 300 s of each drive.", _hold(_CURRENT), *_OF_CURRENT)
declare("current_absent", "Send no current.", _leave_out(_CURRENT), *_OF_CURRENT)
declare(
    "current_missing",
    "Send no current for one to four minutes of each drive.",
    _leave_out_awhile(_CURRENT),
    *_OF_CURRENT,
)
declare(
    "charging_unflagged",
    "Charge between drives without saying so.",
    _leave_out(("charging",)),
    "charge",
    stays=("charging", "charging"),
)


def _measure_by_charge(car: Car, _: np.random.Generator) -> None:
    """Send a state of charge, and no current."""
    car.sends.add("soc")
    car.sends.discard("power")


@fault("charge", VALUES, "soc", prepare=_measure_by_charge, stays=("asleep", "asleep"))
def soc_stale_after_sleep(log: Log, rng: np.random.Generator) -> None:
    """Show the old charge for 20 to 60 s of driving after sleep, then fall by 2 to 6 %."""
    for begin, _ in log.car.track.drives[1:]:
        until = log.true < begin + rng.uniform(20.0, 60.0)
        fall = max(0.0, min(rng.uniform(2.0, 6.0), 99.0 - float(np.nanmax(log.columns["soc_pct"]))))
        log.columns["soc_pct"][until] += np.round(fall / log.car.quantum) * log.car.quantum


declare("soc_absent", "Send no state of charge.", _leave_out(("soc_pct",)), "charge", VALUES, "soc")
