"""Every fault by its name, and those of speed, position, odometer, current and charge."""

from typing import Any

import numpy as np

from socast.core.batch import Floats
from socast.tools.bench.league import clock_faults
from socast.tools.bench.league.loggers import FAULTS, VALUES, Car, Log, blank, fault, find_drives, pick_block

__all__ = ["FAULTS", "clock_faults"]


def _stick(log: Log, rng: np.random.Generator, value: float | None) -> None:
    """Keep the speed of each drive at one value for 60 to 300 s."""
    for rows in find_drives(log):
        block = pick_block(log, rows, rng, 60.0, 300.0)
        speed = log.columns["speed_kmh"]
        speed[block] = speed[block[0]] if value is None else value


@fault("speed", VALUES, "speed")
def speed_stuck_at_zero(log: Log, rng: np.random.Generator) -> None:
    """Report a speed of 0 for 60 to 300 s of each drive."""
    _stick(log, rng, 0.0)


@fault("speed", VALUES, "speed")
def speed_stuck(log: Log, rng: np.random.Generator) -> None:
    """Repeat one speed for 60 to 300 s of each drive."""
    _stick(log, rng, None)


@fault("speed", VALUES, "speed")
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


def _scale(log: Log, factor: float) -> None:
    """Multiply the speed."""
    log.columns["speed_kmh"] *= factor


@fault("speed", VALUES, "speed")
def speed_in_mph(log: Log, _: np.random.Generator) -> None:
    """Report the speed in miles per hour."""
    _scale(log, 1.0 / 1.609344)


@fault("speed", VALUES, "speed")
def speed_in_m_s(log: Log, _: np.random.Generator) -> None:
    """Report the speed in metres per second."""
    _scale(log, 1.0 / 3.6)


@fault("speed", VALUES, "speed")
def speed_scaled(log: Log, rng: np.random.Generator) -> None:
    """Multiply the speed by 0.9 to 1.1."""
    _scale(log, float(rng.choice((0.9, 0.95, 1.03, 1.06, 1.1))))


@fault("speed", VALUES, "speed")
def speed_absent(log: Log, _: np.random.Generator) -> None:
    """Send no speed."""
    blank(log, ("speed_kmh",))


@fault("speed", VALUES, "speed")
def speed_missing(log: Log, rng: np.random.Generator) -> None:
    """Send no speed for one to four minutes of each drive."""
    for rows in find_drives(log):
        blank(log, ("speed_kmh",), pick_block(log, rows, rng, 60.0, 240.0))


@fault("speed", VALUES, "speed")
def speed_tunnel(log: Log, rng: np.random.Generator) -> None:
    """Lose the fix for 30 to 200 s with a speed of 0, then report 900 to 2,000 km/h once or twice."""
    for rows in find_drives(log):
        block = pick_block(log, rows, rng, 30.0, 200.0)
        blank(log, ("latitude_deg", "longitude_deg", "elevation_m"), block)
        log.columns["speed_kmh"][block] = 0.0
        log.columns["speed_kmh"][block[-1] : block[-1] + int(rng.integers(1, 3))] = rng.uniform(900.0, 2000.0)


@fault("position", VALUES, "position", stays=("awake", "awake"))
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


@fault("position", VALUES, "position")
def position_frozen(log: Log, rng: np.random.Generator) -> None:
    """Repeat one fix for 60 to 300 s of each drive."""
    for rows in find_drives(log):
        block = pick_block(log, rows, rng, 60.0, 300.0)
        for name in ("latitude_deg", "longitude_deg", "elevation_m"):
            log.columns[name][block] = log.columns[name][block[0]]


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


@fault("position", VALUES, "position")
def position_absent(log: Log, _: np.random.Generator) -> None:
    """Send no fixes."""
    blank(log, ("latitude_deg", "longitude_deg", "elevation_m"))


@fault("position", VALUES, "position")
def position_missing(log: Log, rng: np.random.Generator) -> None:
    """Send no fix for one to four minutes of each drive."""
    for rows in find_drives(log):
        blank(log, ("latitude_deg", "longitude_deg", "elevation_m"), pick_block(log, rows, rng, 60.0, 240.0))


@fault("position", VALUES, "position")
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


@fault("position", VALUES, "speed", "odometer", prepare=_fixes_only)
def fixes_only(log: Log, _: np.random.Generator) -> None:
    """Send neither speed nor odometer."""
    blank(log, ("speed_kmh", "odometer_km"))


def _drive_by_odometer(car: Car, _: np.random.Generator) -> None:
    """Send an odometer."""
    car.sends.add("odometer")


@fault("odometer", VALUES, "odometer")
def odometer_absent(log: Log, _: np.random.Generator) -> None:
    """Send no odometer."""
    blank(log, ("odometer_km",))


@fault("odometer", VALUES, "odometer", prepare=_drive_by_odometer)
def odometer_in_miles(log: Log, _: np.random.Generator) -> None:
    """Report the odometer in miles."""
    log.columns["odometer_km"] /= 1.609344


def _count_kilometres(car: Car, _: np.random.Generator) -> None:
    """Send an odometer in whole kilometres."""
    car.sends.add("odometer")
    car.odometer_step = 1.0


@fault("odometer", prepare=_count_kilometres)
def odometer_coarse(log: Log, _: np.random.Generator) -> None:
    """Report the odometer in whole kilometres."""


@fault("current", VALUES, "power")
def current_inverted(log: Log, _: np.random.Generator) -> None:
    """Report the current with the wrong sign."""
    log.columns["battery_current_a"] *= -1.0


@fault("current", VALUES, "power")
def current_frozen(log: Log, rng: np.random.Generator) -> None:
    """Repeat one current for 60 to 300 s of each drive."""
    for rows in find_drives(log):
        block = pick_block(log, rows, rng, 60.0, 300.0)
        log.columns["battery_current_a"][block] = log.columns["battery_current_a"][block[0]]


@fault("current", VALUES, "power")
def current_absent(log: Log, _: np.random.Generator) -> None:
    """Send no current."""
    blank(log, ("battery_current_a",))


@fault("current", VALUES, "power")
def current_missing(log: Log, rng: np.random.Generator) -> None:
    """Send no current for one to four minutes of each drive."""
    for rows in find_drives(log):
        blank(log, ("battery_current_a",), pick_block(log, rows, rng, 60.0, 240.0))


@fault("charge", stays=("charging", "charging"))
def charging_unflagged(log: Log, _: np.random.Generator) -> None:
    """Charge between drives without saying so."""
    blank(log, ("charging",))


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


@fault("charge", VALUES, "soc")
def soc_absent(log: Log, _: np.random.Generator) -> None:
    """Send no state of charge."""
    blank(log, ("soc_pct",))
