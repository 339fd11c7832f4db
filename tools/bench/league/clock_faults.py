"""Faults of clocks, counters and senders."""

import numpy as np

from socast.tools.bench.league.loggers import (
    CLOCK,
    ORDER,
    SAMPLES,
    Apply,
    Car,
    Log,
    Prepare,
    declare,
    fault,
    find_drives,
    keep,
    pick_block,
)


def _count(car: Car, _: np.random.Generator) -> None:
    """Give the samples a counter."""
    car.counts = True


def _count_fast(car: Car, rng: np.random.Generator) -> None:
    """Give the samples a counter, and a period that is short of a burst."""
    car.counts, car.period = True, float(rng.choice((1.0, 3.0, 5.0)))


def _be_fast(car: Car, rng: np.random.Generator) -> None:
    """Make the period short of the resolution of the stamps."""
    car.period = float(rng.choice((1.0, 2.0, 3.0)))
    car.counts = car.counts or rng.random() < 0.5


@fault("clock", CLOCK)
def clock_jitter(log: Log, rng: np.random.Generator) -> None:
    """Shift each stamp by 0.3 to 1 s, by 0.5 s at most without a counter."""
    spread = rng.uniform(0.3, 1.0 if log.car.counts else 0.5) * min(1.0, log.car.period / 3.0)
    log.columns["time_s"] += rng.normal(0.0, spread, len(log))


@fault("clock", CLOCK, "counter", prepare=_count)
def clock_set_forward(log: Log, rng: np.random.Generator) -> None:
    """Set the clock forward by 20 s to 2 h within each drive."""
    for rows in find_drives(log):
        log.columns["time_s"][rng.choice(rows) :] += np.exp(rng.uniform(np.log(20.0), np.log(7200.0)))


@fault("clock", CLOCK)
def clock_set_back(log: Log, rng: np.random.Generator) -> None:
    """Set the clock back by 20 s to 2 h within a drive."""
    rows = list(find_drives(log))
    log.columns["time_s"][rng.choice(rows[rng.integers(len(rows))]) :] -= np.exp(rng.uniform(3.0, np.log(7200.0)))


@fault("clock", CLOCK, "stamp", prepare=_count_fast)
def clock_bursts(log: Log, rng: np.random.Generator) -> None:
    """Send 3 to 19 samples together with one stamp, that of the last."""
    size = int(rng.integers(3, 20))
    last = np.minimum((np.arange(len(log)) // size + 1) * size - 1, len(log) - 1)
    awake = np.cumsum(np.diff(log.true, prepend=log.true[0]) > 300.0)
    last = np.where(awake[last] == awake, last, np.arange(len(log)))
    log.columns["time_s"] = log.columns["time_s"][last]
    log.receipt = log.receipt[last]


def _floor(step: float) -> Apply:
    """Return a fault that cuts stamps to a multiple of some seconds."""

    def apply(log: Log, _: np.random.Generator) -> None:
        log.columns["time_s"] = np.floor(log.columns["time_s"] / step) * step

    return apply


declare("clock_floored_1_s", "Cut stamps to whole seconds.", _floor(1.0), "clock", CLOCK)
declare("clock_floored_10_s", "Cut stamps to tens of seconds.", _floor(10.0), "clock", CLOCK, "stamp", prepare=_be_fast)
declare("clock_floored_60_s", "Cut stamps to whole minutes.", _floor(60.0), "clock", CLOCK, "stamp", prepare=_be_fast)


@fault("clock", CLOCK)
def clock_week_rollover(log: Log, _: np.random.Generator) -> None:
    """Lose 1024 weeks, as the week number of a receiver has overflowed."""
    log.columns["time_s"] -= 1024 * 7 * 86400.0


@fault("clock", CLOCK)
def clock_drift(log: Log, rng: np.random.Generator) -> None:
    """Run fast or slow by up to 0.3 %."""
    log.columns["time_s"] += rng.uniform(-3e-3, 3e-3) * (log.true - log.true[0])


@fault("clock", CLOCK, "counter", prepare=_count)
def clock_summer_time(log: Log, rng: np.random.Generator) -> None:
    """Change the clock by an hour within a drive, as local time does."""
    rows = list(find_drives(log))
    log.columns["time_s"][rng.choice(rows[rng.integers(len(rows))]) :] += rng.choice((-3600.0, 3600.0))


@fault("clock", CLOCK, "counter")
def counter_absent(log: Log, _: np.random.Generator) -> None:
    """Send no counter."""
    log.columns["seq"][:] = np.nan


@fault("clock", CLOCK, "counter", prepare=_count)
def counter_restarts(log: Log, rng: np.random.Generator) -> None:
    """Restart the counter at 0 within each drive."""
    for rows in find_drives(log):
        at = rng.choice(rows)
        end = rows[-1] + 1
        log.columns["seq"][at:end] -= log.columns["seq"][at]


@fault("clock", CLOCK, "counter", prepare=_count, stays=("asleep", "asleep"))
def counter_kept_asleep(log: Log, rng: np.random.Generator) -> None:
    """Continue the counter over hours of sleep."""
    log.columns["seq"] = np.arange(len(log), dtype=float) + float(rng.integers(0, 5000))


@fault("clock", ORDER)
def sent_twice(log: Log, rng: np.random.Generator) -> None:
    """Send up to a third of the samples twice, some seconds apart."""
    rows = np.arange(len(log))
    again = rows[rng.random(len(log)) < rng.uniform(0.05, 0.3)]
    when = log.receipt[again] + rng.uniform(0.0, 10.0, len(again))
    first = len(log)
    log.take(np.concatenate([rows, again]))
    log.receipt[first:] = when
    log.take(np.argsort(log.receipt, kind="stable"))


@fault("clock", ORDER)
def sent_late(log: Log, rng: np.random.Generator) -> None:
    """Send single samples after newer ones."""
    late = rng.random(len(log)) < rng.uniform(0.01, 0.08)
    log.receipt[late] += rng.uniform(0.5, 6.0, int(late.sum())) * log.car.period
    log.take(np.argsort(log.receipt, kind="stable"))


@fault("clock", ORDER, prepare=_count)
def sent_from_cache(log: Log, rng: np.random.Generator) -> None:
    """Send one to five minutes of samples after an outage, behind newer ones."""
    for rows in find_drives(log):
        block = pick_block(log, rows, rng, 60.0, 300.0)
        log.receipt[block] = log.receipt[block[-1]] + 2.5 * log.car.period + 1e-3 * np.arange(len(block))
    log.take(np.argsort(log.receipt, kind="stable"))


@fault("clock", SAMPLES)
def samples_lost(log: Log, rng: np.random.Generator) -> None:
    """Lose up to a fifth of the samples."""
    log.take(np.flatnonzero(rng.random(len(log)) >= rng.uniform(0.02, 0.2)))


@fault("clock", SAMPLES)
def samples_lost_for_a_minute(log: Log, rng: np.random.Generator) -> None:
    """Lose all samples of 20 to 60 s of each drive."""
    lost = np.concatenate([pick_block(log, rows, rng, 20.0, 60.0) for rows in find_drives(log)])
    log.take(np.setdiff1d(np.arange(len(log)), lost))


_SHOWN = ("speed_kmh", "battery_current_a")
"""Fields whose changes make a sample."""


def _send_changes(car: Car, rng: np.random.Generator) -> None:
    """Sample every second, and send what has changed."""
    car.period, car.on_change, car.announces = 1.0, True, bool(rng.random() < 0.5)


@fault("clock", SAMPLES, "stamp", prepare=_send_changes)
def sent_on_change(log: Log, _: np.random.Generator) -> None:
    """Send a sample when speed or current has changed, and every minute."""
    kept, last = list[int](), (-99.0, 0.0, 0.0)
    values = zip(*(log.columns[name].tolist() for name in _SHOWN), log.true.tolist(), strict=True)
    for row, (speed, current, time) in enumerate(values):
        if abs(speed - last[0]) >= 1.0 or abs(current - last[1]) >= 2.0 or time - last[2] >= 55.0:
            kept.append(row)
            last = (speed if speed == speed else last[0], current if current == current else last[1], time)  # noqa: PLR0124
    fresh = np.diff(log.columns["seq"][kept], prepend=-1.0) < 0.0
    log.take(np.array(kept))
    runs = np.maximum.accumulate(np.where(fresh, np.arange(len(log)), 0))
    log.columns["seq"] += np.arange(len(log)) - runs - log.columns["seq"]


def _sample_slowly(period: float) -> Prepare:
    """Return a function that makes a car sample at a period, which half of the cars announce."""

    def prepare(car: Car, rng: np.random.Generator) -> None:
        car.period, car.announces = period, bool(rng.random() < 0.5)

    return prepare


declare(
    "every_1_s",
    "Sample every second, not always announced.",
    keep,
    "clock",
    SAMPLES,
    "stamp",
    prepare=_sample_slowly(1.0),
)
declare(
    "every_10_s",
    "Sample every 10 s, not always announced.",
    keep,
    "clock",
    SAMPLES,
    "stamp",
    prepare=_sample_slowly(10.0),
)
declare(
    "every_60_s",
    "Sample once a minute, not always announced.",
    keep,
    "clock",
    SAMPLES,
    "stamp",
    prepare=_sample_slowly(60.0),
)
