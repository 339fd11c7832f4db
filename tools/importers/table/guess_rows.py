"""Guess whether the rows of a table carry only what changed, and then a period for samples and how long values hold."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np

from socast.core.batch import Floats
from socast.tools.importers.table.cells import Bools
from socast.tools.importers.table.sampling import HOLD, STAND
from socast.tools.importers.table.units import POWER

PERIODS: Final = (1.0, 2.0, 3.0, 5.0, 10.0, 15.0, 20.0, 30.0, 60.0)
"""Periods that are proposed. [s]"""
TOGETHER: Final = 0.5
"""Share of the rows with speed that hold power, or the reverse, below which rows carry only what changed. [1]"""
LONGEST_STEP: Final = 300.0
"""Longest time between two values that counts as one step. [s]"""
FAST: Final[tuple[str, ...]] = ("speed_kmh", "battery_current_a", POWER)
"""Fields of which it matters how long a value holds."""
LEAST_VALUES: Final = 20
"""Values of a field from which its way of sending is learned."""
FEW: Final = 0.03
"""Share of values that repeat the one before up to which a field is sent on change alone. [1]"""
HEARTBEAT: Final = 3.0
"""Ratio of the time to a repeated value to that to a changed one from which repetitions are heartbeats. [1]"""
LATE: Final = 1.5
"""Heartbeats after which a value is unknown. [1]"""
SILENT: Final = 3.0
"""Ratio of a silence after which the values of a driving car are unknown to the longest usual one. [1]"""
LONGEST_SILENCE: Final = 120.0
"""Longest such silence. [s]"""
PAUSE: Final = 10.0
"""Time without rows from which the odometer is asked whether the car stood. [s]"""
MOVED: Final = 0.05
"""Distance by the odometer from which it did not. [km]"""
MOST_MOVED: Final = 0.2
"""Share of silences over which the car moved, of a sender on change. [1]"""


THROTTLE: Final = 1.8
"""Shortest time between two values of a power from which they may be too few for its energy. [s]"""
WHOLE: Final = 0.12
"""Deviation of a time from whole shortest times up to which it is one. [1]"""
MOST_WHOLE: Final = 0.75
"""Share of such times of a sender that looks in periods. [1]"""
FEWEST_LONGER: Final = 10
"""Times longer than the shortest one from which this is judged."""


class GuessedRows(NamedTuple):
    """Hold how rows become samples.

    Parameters
    ----------
    period, hold : float
        Time between samples, and the age up to which a value stays known. [s]
    silence : float, optional
        Time without any row after which the values of a driving car are unknown, where values are sent on change. [s]
    holds : mapping of str to float
        Ages of single fields. [s]
    unresolved : mapping of str to str
        Fields that are sent too seldom to show what happened between two values, with the reason.
    """

    period: float
    hold: float
    reason: str
    silence: float | None = None
    holds: Mapping[str, float] = MappingProxyType({})
    unresolved: Mapping[str, str] = MappingProxyType({})


class _Sending(NamedTuple):
    """Hold how a field is sent: whether on change, and after which time a value is repeated all the same [s]."""

    on_change: bool
    heartbeat: float | None


def guess_rows(rows: np.ndarray, on_change: bool = False) -> GuessedRows | None:
    """Return how rows become samples; None where each row is a sample.

    Parameters
    ----------
    on_change : bool
        Whether the sender is known to send on change, where the rows are too few to show it.
    """
    names = rows.dtype.names or ()
    energy: list[str] = [name for name in ("battery_current_a", POWER) if name in names]
    if "speed_kmh" not in names or not energy:
        return None
    speed = np.isfinite(rows["speed_kmh"])
    power = np.logical_or.reduce([np.isfinite(rows[name]) for name in energy])
    fewer, both = int(min(speed.sum(), power.sum())), int((speed & power).sum())
    if not fewer or both >= TOGETHER * fewer:
        return None
    step = max(_measure_step(rows, speed), _measure_step(rows, power))
    period = next((each for each in PERIODS if each >= 0.9 * step), PERIODS[-1])
    share = f"{both / fewer:.0%} of the rows with the one of speed and power hold the other"
    reason = f"{share}; each changes every {step:.2g} s"
    ways = {name: way for name in FAST if name in names and (way := _learn_sending(rows, name)) is not None}
    way = ways.get("speed_kmh")
    if not (way.on_change if way else on_change) or _moves_in_silence(rows):
        return GuessedRows(period, max(HOLD, 3.0 * period), reason)
    holds = {name: max(LATE * each.heartbeat, 3.0 * period) for name, each in ways.items() if each.heartbeat}
    # a field that is repeated in any case is known no longer than usual
    holds |= {name: max(HOLD, 3.0 * period) for name, each in ways.items() if not each.on_change}
    silence = _measure_silence(rows)
    found = "unchanged values are " + (
        f"repeated after {way.heartbeat:.3g} s" if way and way.heartbeat else "not repeated"
    )
    unresolved = {name: words for name in energy if (words := _find_throttle(rows, name))}
    return GuessedRows(period, STAND, f"{reason}; {found}", silence, holds, unresolved)


def _take_series(rows: np.ndarray, known: Bools) -> tuple[np.ndarray, Floats, Bools]:
    """Return rows by car and time, the times between them, and which of these are of one car. [s]"""
    chosen = rows[known]
    chosen = chosen[np.argsort(chosen["vehicle"], kind="stable")]
    return chosen, np.diff(chosen["time"]), np.diff(chosen["vehicle"]) == 0


def _measure_step(rows: np.ndarray, known: Bools) -> float:
    """Return the usual time between two rows in which a field is known. [s]"""
    _, step, same = _take_series(rows, known)
    step = step[same & (step > 0) & (step <= LONGEST_STEP)]
    return float(np.median(step)) if len(step) else HOLD


def _learn_sending(rows: np.ndarray, name: str) -> _Sending | None:
    """Return how a field is sent, None where it has too few values.

    A sender in periods repeats a value that does not change, such as the speed at a stop. A sender on change does not,
    or only as a heartbeat, which takes much longer than a change.
    """
    chosen, step, same = _take_series(rows, np.isfinite(rows[name]))
    same &= (step > 0) & (step <= LONGEST_STEP)
    repeats = np.diff(chosen[name]) == 0
    again, changed = step[same & repeats], step[same & ~repeats]
    if len(again) + len(changed) < LEAST_VALUES or not len(changed):
        return None
    if len(again) <= FEW * (len(again) + len(changed)):
        return _Sending(True, None)
    heartbeat = float(np.median(again))
    if heartbeat >= HEARTBEAT * np.median(changed) and np.percentile(again, 20) >= 0.5 * heartbeat:
        return _Sending(True, heartbeat)
    return _Sending(False, None)


def _find_throttle(rows: np.ndarray, name: str) -> str:
    """Return why values of a power do not show its energy, empty where they do.

    A sender that sends each first change, and then nothing for some seconds, sees the beginnings of braking and
    accelerating more often than their ends: the energy would be wrong by some 10 %. A sender that looks in periods sees
    all of it alike; its times are whole periods apart.
    """
    _, step, same = _take_series(rows, np.isfinite(rows[name]))
    step = step[same & (step > 0) & (step <= LONGEST_STEP)]
    if len(step) < LEAST_VALUES:
        return ""
    shortest = float(np.percentile(step, 10))
    longer = step[step > 1.3 * shortest] / shortest
    is_whole = np.abs(longer - np.round(longer)) <= WHOLE
    if shortest < THROTTLE or len(longer) < FEWEST_LONGER or np.mean(is_whole) > MOST_WHOLE:
        return ""
    return f"it is sent when it changes, at most every {shortest:.3g} s: too seldom for the energy"


def _hold_last(values: Floats, same: Bools) -> Floats:
    """Return values with the last known one of the same car in place of unknown ones."""
    places = np.where(np.isfinite(values), np.arange(len(values)), -1)
    places[0] = max(places[0], 0)
    first = np.append(0, np.flatnonzero(~same) + 1)
    places[first] = np.maximum(places[first], first)
    held: Floats = values[np.maximum.accumulate(places)]
    return held


def _measure_silence(rows: np.ndarray) -> float:
    """Return the time without any row after which the values of a driving car are unknown. [s]"""
    by_car, step, same = _take_series(rows, np.ones(len(rows), bool))
    driving = _hold_last(by_car["speed_kmh"], same)[:-1] > 0.0
    step = step[same & driving & (step > 0) & (step <= LONGEST_STEP)]
    usual = float(np.percentile(step, 99)) if len(step) else 0.0
    return max(HOLD, min(LONGEST_SILENCE, SILENT * usual))


def _moves_in_silence(rows: np.ndarray) -> bool:
    """Return whether the odometer advances in silences in which the car stands by its last speed: rows are lost.

    The distance between two readings of the odometer is compared with that of the speed, held until its next value.
    """
    if "odometer_km" not in (rows.dtype.names or ()):
        return False
    by_car, step, same = _take_series(rows, np.ones(len(rows), bool))
    speed = np.nan_to_num(_hold_last(by_car["speed_kmh"], same))
    held = np.append(0.0, np.cumsum(np.where(same, speed[:-1] * step / 3600.0, 0.0)))
    silent = same & (speed[:-1] == 0.0) & (step > PAUSE) & (step <= LONGEST_STEP)
    silences = np.append(0, np.cumsum(silent))
    read = np.flatnonzero(np.isfinite(by_car["odometer_km"]))
    if len(read) < 2:
        return False
    driven, by_speed = np.diff(by_car["odometer_km"][read]), np.diff(held[read])
    asked = (np.diff(by_car["vehicle"][read]) == 0) & (np.diff(silences[read]) > 0) & (driven >= 0.0)
    if not asked.any():
        return False
    resolution = float(np.min(driven[driven > 0.0], initial=1.0))
    return float(np.mean((driven - by_speed)[asked] > MOVED + resolution)) > MOST_MOVED
