"""Follow a slow quantity of each car by a state-space model: a level that wanders, and a constant rate.

The value of car i on date t is

    value = level + noise,    level(t + dt) = level(t) + rate dt + wander,    wander ~ N(0, q dt),

with noise of a variance that is the same for all days, and one that falls with what was measured. The three variances
are the same for all cars. They are estimated by the likelihood of all series together, with a weak prior. A value far
off has a larger variance, as if noise was of Student's t: a day of a car may have been another kind of day.

A filter over all cars at once gives the likelihood. `socast.core.condition.level_smoother` gives the paths; the filter
and the smoother of filterpy are its reference in tests.

References
----------
Harvey, Forecasting, Structural Time Series Models and the Kalman Filter, Cambridge 1989, DOI
10.1017/CBO9781107049994, sections 2.3 and 3.4. Rauch, Tung, Striebel, AIAA Journal 3 (1965) 1445, DOI 10.2514/3.3166.
Lange, Little, Taylor, Journal of the American Statistical Association 84 (1989) 881, DOI 10.2307/2290063.
"""

from collections.abc import Collection, Iterator, Sequence
from math import isnan, log
from typing import Any, Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Floats, Ints
from socast.core.compiled_cache import njit
from socast.core.condition.level_smoother import SmoothedLevel, smooth_level
from socast.core.condition.step_mixture import NO_SHOCK, ShockMixture

YEAR: Final = 365.25
"""Length of a year. [d]"""
LEVEL_SD: Final = 0.3
"""Standard deviation of the level of a car before any data. [1]"""
FREEDOM: Final = 5.0
"""Degrees of freedom of the noise."""
INFORMATION: Final = (FREEDOM + 3.0) / (FREEDOM + 1.0)
"""Variance of a mean of such noise over that which the variances of single values give it. [1]"""
QUICK: Final = 0.3
"""Wander, in a year, of the level beside which a value is far off: a step of the level is followed within days. [1]"""
MOST_CARS: Final = 100
"""Number of cars from which the variances are estimated."""
ROUNDS: Final = 2
"""Number of times that variances of values far off are enlarged."""


class Series(NamedTuple):
    """Hold logarithms of a factor of n cars on t dates.

    Parameters
    ----------
    dates : (t,) int
        Ordinals of the dates, ascending.
    value : (n, t) float
        Logarithm of the factor, NaN where it was not measured. [1]
    amount : (n, t) float
        What the noise falls with: the variance of a value is one part plus another one over the amount.
    extra : (n, t) float
        Further variance that is known. [1]
    """

    dates: Ints
    value: Floats
    amount: Floats
    extra: Floats

    def compute_variance(self, sizes: "Wandering") -> Floats:
        """Return the variance of each value. [1]"""
        return np.asarray(sizes.of_day**2 + sizes.of_amount**2 / np.maximum(self.amount, 1e-9) + self.extra)


class Wandering(NamedTuple):
    """Hold the standard deviations of a quantity and how often it changes suddenly, or the prior of them.

    Parameters
    ----------
    of_day : float
        Standard deviation of the noise of a day. [1]
    of_amount : float
        That of a day on which one unit of the amount was measured, beside the other. [1]
    wander : float
        That of the change of the level in a year. [1]
    rate : float
        That of the rates of cars. [1/year]
    steps : float
        Number of sudden changes of a car that is expected before any data. [1/year]
    """

    of_day: float
    of_amount: float
    wander: float
    rate: float
    steps: float = 1.0

    def compute_variances(self) -> tuple[float, float, float]:
        """Return the variance of the first level, of its wandering in a day, and of the rate. [1], [1/d], [1/d^2]"""
        return LEVEL_SD**2, self.wander**2 / YEAR, (self.rate / YEAR) ** 2


CONSUMPTION: Final = Wandering(0.04, 0.15, 0.01, 0.03)
"""Prior of the consumption of cars: a car differs by 4 % from day to day, and ages by some per cent a year."""
CAPACITY: Final = Wandering(0.02, 0.5, 0.01, 0.04, 0.3)
"""Prior of the usable capacity: batteries lose 1 to 4 % a year, seldom at once; readings are uncertain by 1 %."""
WANDER_SD: Final = 1.5
"""Scale of a half-normal prior of the wander over which it is averaged, over its first guess. [1]"""
_WANDERS: Final = np.append(0.0, np.geomspace(0.1, 6.4, 13))
"""Wanders over which is averaged, over the first guess. [1]"""
_PRIOR_SDS: Final = np.log([2.0, 2.0, 2.0])
"""Standard deviations of the logarithms of the first three of a prior."""


class Path(NamedTuple):
    """Hold the smoothed path of n cars on t dates.

    Parameters
    ----------
    level, sd : (n, t) float
        Level and its standard deviation. [1]
    rate, rate_sd : (n,) float
        Rate and its standard deviation by the data alone, without the prior that holds in the level. [1/year]
    """

    level: Floats
    sd: Floats
    rate: Floats
    rate_sd: Floats

    @classmethod
    def make_empty(cls, series: Series) -> Self:
        """Return paths of which nothing is known."""
        n, days = series.value.shape
        return cls(*(np.full(shape, np.nan) for shape in ((n, days), (n, days), (n,), (n,))))

    def put(self, row: int, smoothed: SmoothedLevel, found: Wandering, added: ShockMixture = NO_SHOCK) -> None:
        """Write the path of a car, and what shocks add to its level.

        The prior precision of the rate is taken off: an interval that is drawn towards zero misses large rates.
        """
        self.level[row] = smoothed.level + added.level
        self.sd[row] = np.sqrt(np.maximum(smoothed.variance + added.variance, 0.0))
        prior, variance = (found.rate / YEAR) ** 2, float(smoothed.rate_variance[-1])
        freed = prior / max(prior - variance, 1e-6 * prior)
        self.rate[row], self.rate_sd[row] = YEAR * freed * float(smoothed.rate[-1]), YEAR * (freed * variance) ** 0.5


def estimate_wandering(series: Series, prior: Wandering) -> tuple[Wandering, Series]:
    """Return the sizes of noise and wandering, and the series in which values far off have a larger variance.

    At most `MOST_CARS` cars, evenly spaced, tell the variances.
    """
    found, out = prior, series
    for _ in range(ROUNDS):
        found = _maximise(_select_cars(out), prior)
        level, variance, noise = _predict_levels(out, found._replace(wander=QUICK))
        plain = series.compute_variance(found)
        off = (series.value - level) ** 2 / np.maximum(variance - noise + plain, 1e-12)
        heavier = (off + FREEDOM) / (FREEDOM + 1.0)
        out = _add_variance(series, plain * np.maximum(heavier - 1.0, 0.0))
    return found, _add_variance(series, plain * (INFORMATION * heavier - 1.0))


def average_wander(series: Series, heavy: Series, found: Wandering, prior: Wandering) -> Wandering:
    """Return the sizes with the root of the mean square of the wander, over all that the series leave possible.

    The most probable wander of a small fleet may be far too small, and the intervals of rates with it. The variance of
    a rate is nearly linear in the square of the wander, so that its mean gives the width of the mixture over all.

    Parameters
    ----------
    heavy, found :
        What `estimate_wandering` returns for the series and this prior.
    """
    plain = series.compute_variance(found)
    used = _add_variance(series, np.maximum(heavy.compute_variance(found) / INFORMATION - plain, 0.0))
    wanders = prior.wander * _WANDERS
    logs = np.array([_compute_likelihood(_select_cars(used), found._replace(wander=each)) for each in wanders.tolist()])
    chances = np.exp(logs - logs.max() - 0.5 * (_WANDERS / WANDER_SD) ** 2) * np.gradient(_WANDERS)
    return found._replace(wander=float(np.sqrt(np.average(wanders**2, weights=chances))))


def _select_cars(series: Series) -> Series:
    """Return at most `MOST_CARS` cars, evenly spaced."""
    every = max(-(-len(series.value) // MOST_CARS), 1)
    return Series(series.dates, *(each[::every] for each in series[1:]))


def _add_variance(series: Series, more: Floats) -> Series:
    """Return a series with a larger variance of what was measured."""
    return series._replace(extra=series.extra + np.where(np.isfinite(series.value), more, 0.0))


def _maximise(series: Series, prior: Wandering) -> Wandering:
    """Return the most probable variances."""
    from scipy.optimize import minimize  # noqa: PLC0415 - takes 0.3 s to import, and `socast live` needs none of it

    middle = np.log(prior[:3])

    def unpack(log: Floats) -> Wandering:
        of_day, of_amount, wander = np.exp(log).tolist()
        return prior._replace(of_day=of_day, of_amount=of_amount, wander=wander)

    def compute_loss(log: Floats) -> float:
        loss = 0.5 * float((((log - middle) / _PRIOR_SDS) ** 2).sum())
        return loss - _compute_likelihood(series, unpack(log))

    best = minimize(compute_loss, middle, method="Nelder-Mead", options={"xatol": 0.05, "fatol": 0.05, "maxiter": 100})
    return unpack(best.x)


def _compute_likelihood(series: Series, found: Wandering) -> float:
    """Return the logarithm of the likelihood of all cars, up to a constant."""
    return _filter(series, found)[0]


def _predict_levels(series: Series, found: Wandering) -> tuple[Floats, Floats, Floats]:
    """Return the level that the days before predict for each value, the variance of their difference, and the noise."""
    _, noise, predicted = _filter(series, found)
    return predicted[0], predicted[1], noise


def _filter(series: Series, found: Wandering) -> tuple[float, Floats, Floats]:
    """Return the log-likelihood of all cars, the noise, and the predicted levels with their variances, (2, n, t)."""
    noise = series.compute_variance(found)
    out = np.empty((2, *series.value.shape))
    gaps = np.diff(series.dates, prepend=series.dates[0]).astype(np.float64)
    likelihood = _filter_levels(series.value, noise, gaps, found.wander**2 / YEAR, (found.rate / YEAR) ** 2, out)
    return float(likelihood), noise, out


@njit(cache=True)
def _filter_levels(value: Any, noise: Any, gaps: Any, wander: float, rate_variance: float, out: Any) -> float:
    """Write the predicted level of each value and the variance of their difference, and return the log-likelihood."""
    twice = 0.0
    for i in range(value.shape[0]):
        level, rate = 0.0, 0.0
        for t in range(value.shape[1]):  # the level before is that of no data: it begins at the first value
            if not isnan(value[i, t]):
                level = value[i, t]
                break
        p_ll, p_lr, p_rr = LEVEL_SD**2, 0.0, rate_variance
        for t in range(value.shape[1]):
            dt = gaps[t]
            level += rate * dt
            p_ll += 2.0 * dt * p_lr + dt**2 * p_rr + wander * dt
            p_lr += dt * p_rr
            variance = p_ll + noise[i, t]
            out[0, i, t], out[1, i, t] = level, variance
            if isnan(value[i, t]):
                continue
            off, gain, gain_rate = value[i, t] - level, p_ll / variance, p_lr / variance
            twice += off**2 / variance + log(variance)
            level += gain * off
            rate += gain_rate * off
            p_rr -= gain_rate * p_lr
            p_lr -= gain * p_lr
            p_ll -= gain * p_ll
    return -0.5 * twice


class SmoothedCar(NamedTuple):
    """Hold the smoothed level of a car, its row, and what of it was given to `smooth_level`."""

    row: int
    known: NDArray[np.bool_]
    noise: Floats
    gaps: Floats
    shocks: Floats
    smoothed: SmoothedLevel


def smooth_cars(series: Series, found: Wandering, breaks: Sequence[Collection[int]] = ()) -> Iterator[SmoothedCar]:
    """Yield the smoothed level of each car with a value.

    `breaks` are the ordinals at which the level of each car changes suddenly, by an unknown amount.
    """
    noise = series.compute_variance(found)
    gaps = np.diff(series.dates, prepend=series.dates[0]).astype(np.float64)
    every, variances = np.isfinite(series.value), found.compute_variances()
    for row, (value, known) in enumerate(zip(series.value, every, strict=True)):
        if not known.any():
            continue
        shocks = np.zeros(len(value))
        if breaks:
            shocks[np.searchsorted(series.dates, list(breaks[row]))] = LEVEL_SD**2
        start = float(value[known.argmax()])
        smoothed = smooth_level(value, noise[row], gaps, shocks, start=start, variances=variances)
        yield SmoothedCar(row, known, noise[row], gaps, shocks, smoothed)


def smooth_levels(series: Series, found: Wandering) -> Path:
    """Return the smoothed paths of the levels of cars."""
    path = Path.make_empty(series)
    for car in smooth_cars(series, found):
        path.put(car.row, car.smoothed, found)
    return path
