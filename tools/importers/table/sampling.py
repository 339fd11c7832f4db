"""Make samples of rows that carry only part of the fields: values stay known for a time, and rows join to a period."""

from collections.abc import Iterable, Iterator, Mapping
from typing import Final, Literal, NamedTuple

import numpy as np

from socast.core.batch import Floats, Ints
from socast.tools.importers.table.units import OF_WEATHER, POWER

HOLD: Final = 30.0
"""Age up to which a value that changes fast stays known. [s]"""
VOLTAGE_HOLDS: Final = 10.0
"""Ratio of the age up to which a voltage stays known, which changes little, to that of a current. [1]"""
SLOW_HOLD: Final = 1800.0
"""Age up to which a temperature, the number of occupants or the state of charging stays known. [s]"""
STAND: Final = 600.0
"""Time without any row for which the values of a standing car stay known, where values are sent on change. [s]"""
AHEAD: Final = 2.0
"""Periods after a sample whose rows it needs, where values are sent on change. [1]"""
LONGEST_HOLD: Final = 86400.0
"""Largest age that a map may state. [s]"""
SHORTEST_PERIOD: Final = 0.1
"""Shortest period of samples. [s]"""
LONGEST_PERIOD: Final = 60.0
"""Longest period of samples. [s]"""
AVERAGED: Final = ("speed_kmh", "battery_voltage_v", "battery_current_a", POWER, "hvac_w")
"""Fields of which a sample holds the mean over its period; of all others it holds the latest value."""
SLOW: Final = ("battery_temperature_c", "ambient_c", "occupants", "charging", *OF_WEATHER)
"""Fields that change slowly."""
NOT_HELD: Final = ("latitude_deg", "longitude_deg", "elevation_m", "odometer_km", "soc_pct")
"""Fields that are sent only where a row has them: a value of before would say that the car stood still."""
_KEYS: Final = ("time", "vehicle", "ride")
_SPEED: Final = "speed_kmh"
_VOLTAGE: Final = "battery_voltage_v"
_CURRENT: Final = "battery_current_a"
_Series = tuple[Floats, Floats]


class Sampling(NamedTuple):
    """Describe how rows become samples.

    Parameters
    ----------
    period : float, optional
        Time between two samples; None keeps the times of the rows. [s]
    holds : mapping of str to float
        Age of each field up to which its value stays known. [s]
    silence : float, optional
        For values that are sent on change: time without any row of a car after which its values are unknown unless it
        stands, for which `STAND` holds. None where values are not sent on change. [s]
    """

    period: float | None
    holds: Mapping[str, float]
    silence: float | None = None


def find_holds(usual: float = HOLD) -> dict[str, float]:
    """Return the age of each field up to which its value stays known. [s]

    Units: usual [s].
    """
    fast = dict.fromkeys(AVERAGED, usual) | {_VOLTAGE: min(VOLTAGE_HOLDS * usual, LONGEST_HOLD)}
    return fast | dict.fromkeys(SLOW, max(usual, SLOW_HOLD)) | dict.fromkeys(NOT_HELD, 0.0)


def sample_rows(blocks: Iterable[np.ndarray], sampling: Sampling) -> Iterator[np.ndarray]:
    """Yield the samples of rows in the order of time."""
    sampler = _Sampler(sampling)
    for rows in blocks:
        if len(samples := sampler.take(rows)):
            yield samples
    if len(samples := sampler.finish()):
        yield samples


class _Sampler:
    """Hold what the next rows need of those before."""

    def __init__(self, sampling: Sampling) -> None:
        self.period, self.holds, self.silence = sampling
        self._waiting: np.ndarray | None = None
        self._known: dict[int, dict[str, tuple[float, float]]] = {}
        self._filled: dict[int, float] = {}
        self._rides: dict[int, int] = {}
        self._last: dict[int, tuple[float, float]] = {}  # time of the last row of a car, and until when it speaks

    def take(self, rows: np.ndarray) -> np.ndarray:
        """Return the samples that no later row changes."""
        if not len(rows):
            return rows
        if self._waiting is not None:
            rows = np.concatenate([self._waiting, rows])
        end, bound = len(rows), np.inf
        if self.period is not None:
            bound = float(np.floor(rows["time"][-1] / self.period)) - (0.0 if self.silence is None else AHEAD)
            end = int(np.searchsorted(rows["time"], bound * self.period, "left"))
        self._waiting = rows[end:].copy() if end < len(rows) else None
        return self._convert(rows[:end], bound, rows[end:])

    def finish(self) -> np.ndarray:
        """Return the samples of the rows that waited."""
        waiting, self._waiting = self._waiting, None
        if waiting is None:
            return np.zeros(0)
        bound = np.floor(waiting["time"][-1] / self.period) + 1.0 if self.period is not None else np.inf
        return self._convert(waiting, float(bound), waiting[:0])

    def _convert(self, rows: np.ndarray, bound: float, ahead: np.ndarray) -> np.ndarray:
        """Return the samples of whole periods before a number of periods; `ahead` are rows after them."""
        vehicles = set(rows["vehicle"].tolist())
        if self.silence is not None and self.period is not None:
            vehicles |= set(self._last)
        parts = [
            self._convert_car(vehicle, rows[rows["vehicle"] == vehicle], ahead[ahead["vehicle"] == vehicle], bound)
            for vehicle in sorted(vehicles)
        ]
        if not parts:
            return rows
        samples = np.concatenate(parts)
        return samples[np.lexsort((samples["vehicle"], samples["time"]))]

    def _convert_car(self, vehicle: int, rows: np.ndarray, ahead: np.ndarray, bound: float) -> np.ndarray:
        """Return the samples of one car."""
        before = self._known.setdefault(vehicle, {})
        both = rows if self.silence is None else np.concatenate([rows, ahead])
        series = {name: _prepend(before.get(name), both, name) for name in rows.dtype.names or () if name not in _KEYS}
        times, ends_at = self._find_ends(vehicle, both, series)
        past = len(times) - (len(both) - len(rows))
        if self.period is None:
            samples, starts, ends = rows.copy(), rows["time"], rows["time"]
        else:
            ticks = np.floor(rows["time"] / self.period)
            last = np.append(np.diff(ticks) > 0, True)[: len(rows)]
            samples, ticks = rows[last].copy(), ticks[last]
            if self.silence is not None:
                samples, ticks = self._fill(vehicle, samples, ticks, self.period, times[:past], ends_at[:past], bound)
            starts = ticks * self.period
            ends = starts + self.period
            samples["time"] = starts + self.period / 2
        spoken = {name: _find_until(each[0], times, ends_at) for name, each in series.items()}
        for name, (at, values) in series.items():
            samples[name] = self._sample(name, at, values, spoken[name], starts, ends)
            # only rows up to here are of before, for the next ones
            own = len(at) if self.silence is None else int(np.searchsorted(at, times[past - 1], "right"))
            if own:
                before[name] = (float(at[own - 1]), float(values[own - 1]))
                if self.silence is not None and spoken[name][own - 1] < times[past - 1]:  # silent since
                    del before[name]
        if self.period is not None and {_VOLTAGE, _CURRENT} <= series.keys():
            samples[_CURRENT] = self._sample_current(series, spoken, samples[_VOLTAGE], samples[_CURRENT], starts, ends)
        if self.silence is not None:
            self._last[vehicle] = (float(times[past - 1]), float(ends_at[past - 1]))
            self._rides[vehicle] = int(rows["ride"][-1]) if len(rows) else self._rides.get(vehicle, -1)
        return samples

    def _find_ends(self, vehicle: int, rows: np.ndarray, series: Mapping[str, _Series]) -> tuple[Floats, Floats]:
        """Return the times of rows, after the last one of before, and until when each says that nothing changed."""
        if self.silence is None:
            return np.zeros(0), np.zeros(0)
        speeds = find_latest(*series.get(_SPEED, (np.zeros(0), np.zeros(0))), rows["time"], np.inf)
        ends = rows["time"] + np.where(speeds == 0.0, max(STAND, self.silence), self.silence)
        if vehicle not in self._last:
            return rows["time"], ends
        last, end = self._last[vehicle]
        return np.append(last, rows["time"]), np.append(end, ends)

    def _fill(
        self,
        vehicle: int,
        samples: np.ndarray,
        ticks: Floats,
        period: float,
        times: Floats,
        ends: Floats,
        bound: float,
    ) -> tuple[np.ndarray, Floats]:
        """Return samples and their numbers of periods with those between, as long as nothing changed."""
        of_rows = np.floor(times / period)
        last = np.append(np.diff(of_rows) > 0, True)
        known, until = of_rows[last], np.minimum(np.floor(ends[last] / period), bound - 1.0)
        until = np.minimum(until, np.append(known[1:], np.inf) - 1.0)
        if (done := self._filled.get(vehicle)) is not None:
            known = np.maximum(known, done)
        counts = np.maximum(until - known, 0.0).astype("i8")
        added = np.repeat(known, counts) + 1.0 + _count_up(counts)
        self._filled[vehicle] = max(float(bound) - 1.0, float(of_rows[-1]))
        if not len(added):
            return samples, ticks
        order = np.argsort(np.append(ticks, added), kind="stable")
        filled = np.concatenate([samples, np.zeros(len(added), samples.dtype)])[order]
        filled["vehicle"] = vehicle
        of_row = np.where(order < len(samples), np.arange(len(order)), -1)
        latest = np.maximum.accumulate(of_row)
        filled["ride"] = np.where(latest >= 0, filled["ride"][latest], self._rides.get(vehicle, -1))
        return filled, np.append(ticks, added)[order]

    def _sample_current(
        self,
        series: Mapping[str, _Series],
        spoken: Mapping[str, Floats],
        voltage: Floats,
        current: Floats,
        starts: Floats,
        ends: Floats,
    ) -> Floats:
        """Return the current that gives the mean power at the mean voltage."""
        times, amperes = series[_CURRENT]
        volts = find_latest(*series[_VOLTAGE], times, self.holds[_VOLTAGE])
        at = np.isfinite(volts)
        power = self._sample(_CURRENT, times[at], (amperes * volts)[at], spoken[_CURRENT][at], starts, ends)
        return np.divide(power, voltage, out=current.copy(), where=np.isfinite(power) & (voltage > 0))

    def _sample(self, name: str, times: Floats, values: Floats, spoken: Floats, starts: Floats, ends: Floats) -> Floats:
        """Return the values of a field in periods; `spoken` says until when a car without a later row speaks."""
        hold = self.holds[name]
        if self.period is None:
            return find_latest(times, values, ends, np.minimum(hold, spoken - times))
        longest = np.minimum(max(hold, self.period), np.maximum(spoken - times, self.period))
        latest = find_latest(times, values, ends, longest, "left")
        if name not in AVERAGED:
            return latest
        # a sender on change sends at most once a period: what changed since the last value did so within one
        ramp = 0.0 if self.silence is None else self.period
        return compute_held_means(times, values, starts, ends, longest, latest, ramp)


def _find_until(at: Floats, times: Floats, ends: Floats) -> Floats:
    """Return until when values at some times are known to be unchanged: to the first time a car is silent for long."""
    if not len(times):
        return np.full(len(at), np.inf)
    silent = np.where(ends < np.append(times[1:], np.inf), ends, np.inf)
    first = np.minimum.accumulate(silent[::-1])[::-1]
    until: Floats = first[np.minimum(np.searchsorted(times, at, "left"), len(times) - 1)]
    return until


def _count_up(counts: Ints) -> Ints:
    """Return 0, 1, ... for each count.

    >>> _count_up(np.array([2, 0, 3])).tolist()
    [0, 1, 0, 1, 2]
    """
    return np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)


def _prepend(before: tuple[float, float] | None, rows: np.ndarray, name: str) -> _Series:
    """Return times and values of a field where it is known, after the last one of before."""
    at = np.isfinite(rows[name])
    times, values = rows["time"][at], rows[name][at]
    if before is None:
        return times, values
    return np.append(before[0], times), np.append(before[1], values)


def find_latest(
    times: Floats, values: Floats, at: Floats, hold: float | Floats, side: Literal["left", "right"] = "right"
) -> Floats:
    """Return the latest value of a quantity at each moment, NaN where it is older than a limit.

    Units: at [s], hold [s].

    Parameters
    ----------
    times : (n,) float64
        Times at which the value is known, ascending. [s]
    """
    if not len(times):
        return np.full(len(at), np.nan)
    latest = np.searchsorted(times, at, side) - 1
    is_known = (latest >= 0) & (at - times[latest] <= (hold if np.ndim(hold) == 0 else np.asarray(hold)[latest]))
    return np.where(is_known, values[latest], np.nan)


def compute_held_means(
    times: Floats,
    values: Floats,
    starts: Floats,
    ends: Floats,
    hold: float | Floats,
    otherwise: Floats,
    ramp: float = 0.0,
) -> Floats:
    """Return the means of a quantity over periods; each value counts until the next one, at most for a time.

    Units: starts [s], ends [s], hold [s].

    Parameters
    ----------
    times : (n,) float64
        Times at which the value is known, ascending. [s]
    ramp : float
        Time before the next value within which the quantity changes to it, along a line. [s]

    Examples
    --------
    >>> times, values = np.array([0.0, 3.0]), np.array([10.0, 20.0])
    >>> compute_held_means(times, values, np.array([2.0, 4.0]), np.array([4.0, 6.0]), 2.0, np.full(2, np.nan)).tolist()
    [20.0, 20.0]
    >>> compute_held_means(times, values, np.array([0.0]), np.array([3.0]), 5.0, np.full(1, np.nan), 1.0).tolist()
    [11.666666666666666]
    """
    if not len(times):
        return otherwise
    following = np.append(times[1:], np.inf)
    until = np.minimum(following, times + hold)
    goes_on = until >= following  # the value is known up to the next one
    line = np.where(goes_on & (ramp > 0.0), np.where(following - times <= 1.5 * ramp, until - times, ramp), 0.0)
    knots = np.column_stack((times, until - line, until)).ravel()
    known = np.column_stack((until - line - times, line, np.zeros(len(times)))).ravel()
    slope = np.divide(np.append(np.diff(values), 0.0), line, out=np.zeros(len(times)), where=line > 0.0)
    level = np.column_stack((values, values, np.zeros(len(times)))).ravel()
    rise = np.column_stack((np.zeros(len(times)), slope, np.zeros(len(times)))).ravel()

    def integrate(at: Floats) -> tuple[Floats, Floats]:
        place = np.maximum(np.searchsorted(knots, at, "right") - 1, 0)
        inside = np.clip(at - knots[place], 0.0, known[place])
        total = amount[place] + inside * (level[place] + 0.5 * rise[place] * inside)
        return total, time[place] + inside

    time = np.append(0.0, np.cumsum(known))[:-1]
    amount = np.append(0.0, np.cumsum(known * (level + 0.5 * rise * known)))[:-1]
    (first, since), (last, to) = integrate(starts), integrate(ends)
    span = to - since
    return np.divide(last - first, span, out=otherwise.copy(), where=span > 1e-6)
