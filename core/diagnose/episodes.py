"""Find episodes: hours of a few dates in which the power is off by one amount, before any effect is judged.

An event, such as a faulty logger or weather that no column describes, may hold most of the error without being a
property of rides, cars or days in general. The search compares the same hours on different dates:

1. The power of each window that neither the model nor any effect of the library explains, with plausible
   coefficients, is averaged over the hours of each ride. Its scale is that of the median ride of the car, beside the
   noise of windows. Rides have heavy tails, so that their means are transformed from Student's t to normal deviates.
2. Rides are averaged to vehicle-days and these to dates. Each level has a variance of its own, by its median.
3. For each contiguous span of hours, of all cars together and of each car, the dates are sorted by their mean less that
   of the median date. The first k of n dates have the score Z = Σz/√k, and chance gives

       p = Φ(-Z) C(n, k) · 2 · (hours · places · largest k),

   the bound of Bonferroni over all sets of dates. Spans overlap, so that they count as so many as there are hours.
   The span of the clearest set is then the one whose one power fits these dates best.

The day begins at the hour with the least driving, so that an evening is not cut at midnight UTC.

References
----------
Neill, Journal of the Royal Statistical Society B 74 (2012) 337, DOI 10.1111/j.1467-9868.2011.01014.x: the best subset
is among the first k by priority. Wallace, Annals of Mathematical Statistics 30 (1959) 1124,
DOI 10.1214/aoms/1177706098: normal deviates of Student's t.
"""

from collections.abc import Iterator
from datetime import UTC, datetime
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear
from scipy.special import gammaln, log_ndtr, stdtrit

from socast.core.batch import Floats, Ints
from socast.core.diagnose.candidates import Candidates
from socast.core.diagnose.gains import LEAST_LEFT
from socast.core.diagnose.projection import BaseProjection
from socast.core.diagnose.records import FoundEpisode
from socast.core.fit.ride_blocks import get_names, get_numbers
from socast.core.fit.row_noise import estimate_variance
from socast.core.records import make_interval
from socast.core.stats.scores import NORMAL_MEDIAN, Estimate

LEVEL: Final = 0.01
"""Probability that a diagnosis without any episode reports one. [1]"""
SUSPECT: Final = 1.0
"""Probability of an episode by chance, by the bound of Bonferroni, below which it is judged beside fits without it."""
LEAST_SHARE: Final = 0.02
"""Share of the squared error of rides that an episode must hold to be reported."""
MOST_EPISODES: Final = 3
MOST_DATES: Final = 10
"""Largest number of dates of an episode, which are also a quarter of all dates at most."""
LEAST_DATES: Final = 6
"""Number of dates with driving in a span below which none is told from the others."""
ALONE: Final = 0.8
"""Share of the energy of an episode above which it is a matter of one car."""
CONCERNED: Final = 0.5
"""Power of a car over that of the episode above which the car is among those concerned."""
TAIL: Final = 0.9
"""Quantile from which the tails of rides are estimated, low enough for an episode not to matter."""
FREEDOMS: Final = (1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 4.5, 5.0)
"""Degrees of freedom that describe the tails of rides. [1]"""
LEAST_FREEDOM: Final = 3.0
"""Degrees of freedom below which the variance of Student's t is not computed. [1]"""
PRIOR: Final = 10.0
"""Number of rides or vehicle-days by which the variance of a car is drawn to that of all cars."""
SEEN: Final = 0.25
"""Least power of an episode by the model as given over that after refitting; less is a matter of the refit."""
LEAST_RIDES: Final = 3
"""Number of rides that an episode holds at least; a single ride is no property of a date."""
HOURS: Final = 24
CELLS: Final = 2_000_000
"""Number of rides times spans that are evaluated at once."""


class Episode(NamedTuple):
    """Hold hours of some dates in which the power is off.

    Parameters
    ----------
    rows : (n,) bool
        Windows in it.
    column : (n, 1) float
        Energy of 1 kW in these windows. [kWh/kW]
    dates : tuple of str
        UTC dates on which its hours begin.
    hours : tuple of (int, int)
        Hours of the day, UTC, at which it begins and ends.
    whole : bool
        Whether its hours are all hours of driving on these dates.
    car : str, optional
        The car whose matter it is; None if it concerns several.
    cars : tuple of str
        Cars with at least half its power.
    driving : int
        Number of cars that drove in it.
    rides : tuple of str
        Keys of its rides, the one with the most unexplained energy first.
    power, low, high : float
        Mean power above what the model explains, with a 95 % interval. [kW]
    share : float
        Share of the squared error of rides, after refitting, that it holds beyond the effects of the library. [1]
    chance : float
        Probability that a diagnosis without any episode shows as clear a one, at most. [1]
    """

    rows: NDArray[np.bool_]
    column: Floats
    dates: tuple[str, ...]
    hours: tuple[int, int]
    whole: bool
    car: str | None
    cars: tuple[str, ...]
    driving: int
    rides: tuple[str, ...]
    power: float
    low: float
    high: float
    share: float
    chance: float

    def to_record(self) -> FoundEpisode:
        """Return the episode as a part of the diagnosis."""
        return FoundEpisode(
            dates=list(self.dates),
            hours_utc=self.hours,
            whole_dates=self.whole,
            car=self.car,
            cars=list(self.cars),
            cars_driving=self.driving,
            windows=int(self.rows.sum()),
            rides=list(self.rides),
            power_kw=self.power,
            power_ci95_kw=make_interval(self.low, self.high),
            share=self.share,
            chance=self.chance,
        )


def find_episodes(base: BaseProjection, candidates: Candidates) -> tuple[list[Episode], BaseProjection]:
    """Return the episodes, the clearest first, and the projection with a constant power of each."""
    found: list[Episode] = []
    while len(found) < MOST_EPISODES:
        known = _fit_library(base, candidates)
        hours = _HourlyPower(base, base.convert_to_energy(base.residual - base.project_out(known)[:, 0]))
        best = hours.find_best()
        if best is None or best.log_chance > np.log(SUSPECT):
            break
        fair, beside, known = _refit_beside(base, candidates, hours.select(best))
        if best.log_chance > np.log(LEVEL):  # it may bend the fits so much that it hides itself
            hours = _HourlyPower(fair, fair.convert_to_energy(fair.residual - fair.project_out(known)[:, 0]))
            best = hours.find_best()
            if best is None or best.log_chance > np.log(LEVEL):
                break
            fair, beside, known = _refit_beside(base, candidates, hours.select(best))
        episode = _describe(fair, beside, hours, best, known)
        if episode.share < LEAST_SHARE or _measure_as_given(base, episode) < SEEN * abs(episode.power):
            break
        found.append(episode)
        base = beside
    return found, base


def _measure_as_given(base: BaseProjection, episode: Episode) -> float:
    """Return by how much the model as given misses the power of an episode more than elsewhere, in its sign. [kW]"""
    windows, rows = base.windows, episode.rows
    missed, hours = windows.measured - windows.predicted, get_numbers(windows.table, "duration_s") / 3600.0
    others = ~rows & np.isin(windows.vehicle, windows.vehicle[rows])
    there, elsewhere = (missed[at].sum() / max(hours[at].sum(), 1e-300) for at in (rows, others))
    return float(np.sign(episode.power) * (there - elsewhere))


def _refit_beside(
    base: BaseProjection, candidates: Candidates, rows: NDArray[np.bool_]
) -> tuple[BaseProjection, BaseProjection, Floats]:
    """Return projections with weights beside the power of some windows, and off it, and the energy of the library."""
    column = _make_column(base, rows)
    fair = base.reweight(column)
    beside = fair.allow_for(column)
    return fair, beside, _fit_library(beside, candidates)


def _make_column(base: BaseProjection, rows: NDArray[np.bool_]) -> Floats:
    """Return the energy of 1 kW in some windows, (n, 1). [kWh/kW]"""
    return np.asarray((rows * get_numbers(base.windows.table, "duration_s") / 3600.0)[:, np.newaxis])


def _fit_library(base: BaseProjection, candidates: Candidates) -> Floats:
    """Return the energy of the best variant of each effect, with plausible coefficients, (n, 1). [kWh]"""
    columns, residual = base.project_out(candidates.columns), base.residual
    size, whole = (columns**2).sum(axis=0), (base.apply_weights(candidates.columns) ** 2).sum(axis=0)
    low, high = np.array([candidates.get_limits(i) for i in range(len(size))]).reshape(-1, 2).T
    alone = np.divide(columns.T @ residual, size, out=np.zeros(len(size)), where=size > LEAST_LEFT * whole)
    alone = np.clip(alone, low, high)
    fall = alone * (2.0 * (columns.T @ residual) - alone * size)
    best = [int(i[np.argmax(fall[i])]) for e in range(len(candidates.names)) if len(i := _at(candidates, e))]
    best = [i for i in best if fall[i] > 0.0]
    if not best:
        return np.zeros((len(residual), 1))
    unit = np.sqrt(size[best])
    orthogonal, upper = np.linalg.qr(columns[:, best] / unit)
    fitted = lsq_linear(upper, orthogonal.T @ residual, (low[best] * unit, high[best] * unit)).x
    return np.asarray(candidates.columns[:, best] @ (fitted / unit)[:, np.newaxis])


def _at(candidates: Candidates, effect: int) -> Ints:
    """Return the places of the variants of an effect."""
    return np.flatnonzero(candidates.effects == effect)


class _Best(NamedTuple):
    """Hold the clearest set of dates: the car or -1 for all, hours of the day, dates, sign, and log probability."""

    car: int
    first: int
    last: int
    dates: Ints
    log_chance: float


class _HourlyPower:
    """Hold the unexplained power of each ride by hour of the day, and its usual variance.

    Parameters
    ----------
    base : BaseProjection
        Projection off the terms of the model.
    energy : (n,) float
        Unexplained energy of each window. [kWh]
    """

    def __init__(self, base: BaseProjection, energy: Floats) -> None:
        windows = base.windows
        self.cars = [windows.table["vehicle_id"].iloc[int(rows[0])] for rows in base.cars]
        duration = get_numbers(windows.table, "duration_s") / 3600.0
        middle = get_numbers(windows.table, "start_s") / 3600.0 + duration / 2.0
        self.begin = _find_quiet_hour(middle, duration)
        first = np.flatnonzero(np.r_[True, np.diff(windows.ride) != 0])
        day = np.floor((middle[first] - self.begin) / HOURS).astype(np.int64)
        self.hour = np.clip(middle - self.begin - HOURS * day[windows.ride], 0, HOURS - 1).astype(np.int64)
        self.days, self.date = np.unique(day, return_inverse=True)
        self.car = windows.vehicle[first]
        self.window_car, self.window_date = windows.vehicle, self.date[windows.ride]
        variance = estimate_variance(base.get_variance_parts(), energy)
        precision = _cumulate(windows.ride, self.hour, duration**2 / variance)
        self._precision, self._score = precision, _cumulate(windows.ride, self.hour, duration * energy / variance)
        new = np.r_[True, (np.diff(self.car) != 0) | (np.diff(self.date) != 0)]
        self._shifts = np.flatnonzero(new)  # rides are ordered by vehicle and time
        self.shift_car, self.shift_date = self.car[self._shifts], self.date[self._shifts]
        self._by_date = np.argsort(self.shift_date, kind="stable")
        self._dates = np.flatnonzero(np.r_[True, np.diff(self.shift_date[self._by_date]) != 0])
        self._estimate_variances()

    def _estimate_variances(self) -> None:
        """Estimate the variances of rides by car, of vehicle-days and of dates, and the tails of rides."""
        precision = self._precision[:, -1]
        mean, noise = self._score[:, -1] / precision, 1.0 / precision
        self.freedom = FREEDOMS[-1]
        for _ in range(2):
            median = float(stdtrit(self.freedom, 0.75))
            self.of_ride = _match_medians(mean, noise, self.car, median)[self.car]
            size = np.abs(mean) / np.sqrt(self.of_ride + noise)
            grid = np.array(FREEDOMS)
            tail = np.quantile(size, TAIL) / max(float(np.median(size)), 1e-300)
            usual = stdtrit(grid, 0.5 + TAIL / 2.0) / stdtrit(grid, 0.75)
            self.freedom = float(np.interp(-tail, -usual, grid))
        self.of_shift, self.of_date = np.zeros(len(self._shifts)), 0.0
        whole = np.array([0]), np.array([HOURS])
        mean, precision = (values[0] for values in self._average_rides(*whole))
        self.of_shift = _match_medians(mean, 1.0 / precision, self.shift_car, NORMAL_MEDIAN)[self.shift_car]
        if len(self.cars) > 1:
            mean, variance = (values[0] for values in self._average_shifts(*self._average_rides(*whole)))
            self.of_date = _match_median(mean, variance, NORMAL_MEDIAN)

    def _average_rides(self, first: Ints, last: Ints) -> tuple[Floats, Floats]:
        """Return the mean power of each vehicle-day in some spans and its precision, (spans, vehicle-days)."""
        precision = (self._precision[:, last] - self._precision[:, first]).T
        known = precision > 0.0
        safe = np.where(known, precision, 1.0)
        variance = self.of_ride + 1.0 / safe
        z = (self._score[:, last] - self._score[:, first]).T / safe / np.sqrt(variance)
        weight = known / variance
        total = np.add.reduceat(weight, self._shifts, axis=1)
        sums = np.add.reduceat(weight * np.sqrt(variance) * self._to_normal(z), self._shifts, axis=1)
        return np.divide(sums, total, out=np.zeros_like(sums), where=total > 0.0), total

    def _count_rides(self, first: Ints, last: Ints) -> Ints:
        """Return the number of rides of each vehicle-day in some spans, (spans, vehicle-days)."""
        inside = self._precision[:, last].T > self._precision[:, first].T
        return np.asarray(np.add.reduceat(inside.astype(np.int64), self._shifts, axis=1))

    def _average_shifts(self, mean: Floats, precision: Floats) -> tuple[Floats, Floats]:
        """Return the mean power of each date and its variance, infinite without driving, (spans, dates)."""
        weight = precision / (1.0 + self.of_shift * precision)
        total = np.add.reduceat(weight[:, self._by_date], self._dates, axis=1)
        sums = np.add.reduceat((weight * mean)[:, self._by_date], self._dates, axis=1)
        with np.errstate(divide="ignore"):
            variance = self.of_date + 1.0 / total
        return np.divide(sums, total, out=np.zeros_like(sums), where=total > 0.0), variance

    def _to_normal(self, z: Floats) -> Floats:
        """Return deviates of Student's t as normal deviates."""
        n = self.freedom
        return np.asarray(np.sign(z) * ((8.0 * n + 1.0) / (8.0 * n + 3.0)) * np.sqrt(n * np.log1p(z**2 / n)))

    def find_best(self) -> _Best | None:
        """Return the clearest set of dates over all spans and cars, None where dates are too few."""
        driven = np.flatnonzero(np.diff(self._precision.sum(axis=0)) > 0.0)
        first, last = np.triu_indices(len(driven))
        starts, ends = driven[first], driven[last] + 1
        places = len(self.cars) + (len(self.cars) > 1)
        tests = float(np.log(2.0 * len(driven) * places))
        best: _Best | None = None
        step = max(1, CELLS // len(self.car))
        for at in range(0, len(starts), step):
            spans = slice(at, at + step)
            for car, dates, mean, variance, rides in self._list_places(starts[spans], ends[spans]):
                log_chance, row, chosen = _find_dates(mean, variance, rides, tests)
                if best is None or log_chance < best.log_chance:
                    span = at + row
                    best = _Best(car, int(starts[span]), int(ends[span]), dates[chosen], log_chance)
        return None if best is None else self._fit_span(best, starts, ends)

    def _fit_span(self, best: _Best, starts: Ints, ends: Ints) -> _Best:
        """Return a set of dates with the span whose one power fits its hours best, as scores level off with size."""
        rides = np.isin(self.date, best.dates) & ((self.car == best.car) | (best.car < 0))
        enough = (self._precision[rides][:, ends] > self._precision[rides][:, starts]).sum(axis=0) >= LEAST_RIDES
        precision, score = self._precision[rides].sum(axis=0), self._score[rides].sum(axis=0)
        size = precision[ends] - precision[starts]
        gain = np.divide((score[ends] - score[starts]) ** 2, size, out=np.zeros_like(size), where=size > 0.0)
        at = int(np.argmax(np.where(enough & (starts < best.last) & (ends > best.first), gain, -1.0)))
        return best._replace(first=int(starts[at]), last=int(ends[at]))

    def _list_places(self, first: Ints, last: Ints) -> Iterator[tuple[int, Ints, Floats, Floats, Ints]]:
        """Yield all cars and each car with enough dates: its code, dates, and mean, variance and rides by span."""
        mean, precision = self._average_rides(first, last)
        rides = self._count_rides(first, last)
        if len(self.cars) > 1 and len(self.days) >= LEAST_DATES:
            of_date = np.add.reduceat(rides[:, self._by_date], self._dates, axis=1)
            yield -1, np.arange(len(self.days)), *self._average_shifts(mean, precision), of_date
        with np.errstate(divide="ignore"):
            variance = self.of_date + self.of_shift + 1.0 / precision
        edges = np.flatnonzero(np.r_[True, np.diff(self.shift_car) != 0, True])
        for a, b in pairwise(edges.tolist()):
            if b - a >= LEAST_DATES:
                yield int(self.shift_car[a]), self.shift_date[a:b], mean[:, a:b], variance[:, a:b], rides[:, a:b]

    def select(self, best: _Best) -> NDArray[np.bool_]:
        """Return the windows of a set of dates, (n,)."""
        rows = np.isin(self.window_date, best.dates) & (self.hour >= best.first) & (self.hour < best.last)
        return np.asarray(rows if best.car < 0 else rows & (self.window_car == best.car))

    def measure_error(self, best: _Best) -> float:
        """Return the standard error of the mean power of a set of dates, with the tails of rides. [kW]"""
        span = np.array([best.first]), np.array([best.last])
        mean, precision = self._average_rides(*span)
        inside = np.isin(self.shift_date, best.dates) & (precision[0] > 0.0)
        if best.car >= 0:
            inside &= self.shift_car == best.car
            information = (1.0 / (self.of_date + self.of_shift[inside] + 1.0 / precision[0, inside])).sum()
        else:
            information = (1.0 / self._average_shifts(mean, precision)[1][0, best.dates]).sum()
        freedom = max(self.freedom, LEAST_FREEDOM)
        return float(np.sqrt(freedom / (freedom - 2.0) / information))


def _find_quiet_hour(middle: Floats, duration: Floats) -> int:
    """Return the hour of the day, UTC, with the least driving around it; 0 where none has less."""
    driven = np.bincount((middle % HOURS).astype(np.int64), duration, HOURS)
    around = driven + np.roll(driven, 1) + np.roll(driven, -1)
    return int(np.argmin(around))


def _cumulate(ride: Ints, hour: Ints, values: Floats) -> Floats:
    """Return the sum of values of each ride before each hour, (rides, hours + 1)."""
    count = int(ride.max()) + 1
    sums = np.bincount(ride * HOURS + hour, values, count * HOURS).reshape(count, HOURS)
    return np.hstack([np.zeros((count, 1)), np.cumsum(sums, axis=1)])


def _match_median(mean: Floats, noise: Floats, median: float) -> float:
    """Return the variance with which the median of absolute means, standardised beside noise, has a value; or 0."""
    if not len(mean) or float(np.median(np.abs(mean) / np.sqrt(noise))) <= median:
        return 0.0
    low, high = 0.0, float(np.max(mean**2)) / median**2
    for _ in range(30):
        middle = 0.5 * (low + high)
        above = float(np.median(np.abs(mean) / np.sqrt(middle + noise))) > median
        low, high = (middle, high) if above else (low, middle)
    return high


def _match_medians(mean: Floats, noise: Floats, car: Ints, median: float) -> Floats:
    """Return the variance of each car as of `_match_median`, drawn to that of all cars, (cars,)."""
    every = _match_median(mean, noise, median)
    count = np.bincount(car)
    own = np.array([_match_median(mean[car == c], noise[car == c], median) for c in range(len(count))])
    return np.asarray((count * own + PRIOR * every) / (count + PRIOR))


def _find_dates(mean: Floats, variance: Floats, rides: Ints, tests: float) -> tuple[float, int, Ints]:
    """Return the least log probability over spans and sets of dates, the span, and the places of the dates."""
    known = np.isfinite(variance)
    count = known.sum(axis=1)
    z = (mean - _find_median(mean, known, count)[:, np.newaxis]) / np.sqrt(np.where(known, variance, 1.0))
    # hours that differ more between dates than whole days let expect
    z /= np.maximum(1.0, _find_median(np.abs(z), known, count) / NORMAL_MEDIAN)[:, np.newaxis]
    most = np.minimum(MOST_DATES, count // 4)
    ks = np.arange(1, min(MOST_DATES, mean.shape[1]) + 1)
    n = np.maximum(count[:, np.newaxis], ks).astype(np.float64)
    sets = gammaln(n + 1.0) - gammaln(ks + 1.0) - gammaln(n - ks + 1.0)
    allowed = (ks <= most[:, np.newaxis]) & (count >= LEAST_DATES)[:, np.newaxis]
    best: tuple[float, int, Ints] = (np.inf, 0, np.empty(0, dtype=np.int64))
    for sign in (1.0, -1.0):
        order = np.argsort(np.where(known, -sign * z, np.inf), axis=1, kind="stable")[:, : len(ks)]
        score = np.cumsum(sign * np.take_along_axis(z, order, axis=1), axis=1) / np.sqrt(ks)
        log_chance = log_ndtr(-score) + sets + tests + np.log(np.maximum(most, 1))[:, np.newaxis]
        enough = np.cumsum(np.take_along_axis(rides, order, axis=1), axis=1) >= LEAST_RIDES
        log_chance = np.where(allowed & enough, log_chance, np.inf)
        row, k = divmod(int(np.argmin(log_chance)), len(ks))
        if log_chance[row, k] < best[0]:
            best = float(log_chance[row, k]), row, np.sort(order[row, : k + 1])
    return best


def _find_median(values: Floats, known: NDArray[np.bool_], count: Ints) -> Floats:
    """Return the median of the known values of each row, 0 without any."""
    ordered = np.sort(np.where(known, values, np.inf), axis=1)
    at = np.maximum(np.stack([(count - 1) // 2, count // 2], axis=1), 0)
    middle = np.take_along_axis(ordered, at, axis=1).mean(axis=1)
    return np.where(count > 0, middle, 0.0)


def _describe(
    base: BaseProjection,
    beside: BaseProjection,
    hours: _HourlyPower,
    best: _Best,
    known: Floats,
) -> Episode:
    """Return an episode with its size, its share of the squared error, and its cars."""
    windows, rows = base.windows, hours.select(best)
    left, after = (each.residual - each.project_out(known)[:, 0] for each in (base, beside))
    column = base.project_out(_make_column(base, rows))[:, 0]
    power = float(column @ left / (column @ column))
    error = hours.measure_error(best)
    energy, duration = base.convert_to_energy(left), get_numbers(windows.table, "duration_s") / 3600.0
    whole = windows.by_ride(base.convert_to_energy(base.residual))
    fall = windows.by_ride(energy) ** 2 - windows.by_ride(beside.convert_to_energy(after)) ** 2
    share = max(float(fall.sum()) / max(float(whole @ whole), 1e-300), 0.0)
    of_car = np.bincount(windows.vehicle[rows], energy[rows], len(hours.cars))
    time = np.bincount(windows.vehicle[rows], duration[rows], len(hours.cars))
    driving = np.flatnonzero(time > 0.0)
    off = driving[of_car[driving] / (time[driving] * power) > CONCERNED]
    alone = best.car if best.car >= 0 else int(np.argmax(of_car * np.sign(power)))
    single = best.car >= 0 or of_car[alone] / of_car.sum() > ALONE
    of_ride = np.abs(np.bincount(windows.ride[rows], energy[rows], len(windows.rides)))
    worst = np.argsort(-of_ride, kind="stable")[: len(np.unique(windows.ride[rows]))]
    first, last = int(hours.hour[rows].min()), int(hours.hour[rows].max()) + 1  # the span may reach beyond the drives
    start = HOURS * hours.days[np.sort(best.dates)] + hours.begin + first
    low, high = Estimate(power, error, np.inf).interval
    others = np.isin(hours.window_date, best.dates) & (np.isin(windows.vehicle, driving))
    return Episode(
        rows=rows,
        column=_make_column(base, rows),
        dates=tuple(datetime.fromtimestamp(3600.0 * float(at), UTC).date().isoformat() for at in start),
        hours=((hours.begin + first) % HOURS, (hours.begin + last) % HOURS),
        whole=bool(rows.sum() == others.sum()),
        car=str(hours.cars[alone]) if single else None,
        cars=tuple(str(hours.cars[car]) for car in off),
        driving=len(driving),
        rides=tuple(np.array(get_names(windows.rides, "ride_key"), dtype=object)[worst].tolist()),
        power=power,
        low=low,
        high=high,
        share=share,
        chance=float(np.exp(best.log_chance)),
    )
