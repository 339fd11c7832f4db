"""Faults of voltage, current and the state of charge, and of charging."""

import numpy as np

from socast.tools.bench.league.fault import VALUES, fault, find_drives, pick_block
from socast.tools.bench.league.loggers import Car, Log, blank


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
