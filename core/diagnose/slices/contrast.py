"""Compare the mean error of a slice of the rides with that of all other rides, with vehicle-days as clusters.

The errors of a vehicle on one day depend on each other, so vehicle-days are the independent units. The variance of the
difference of the two means is estimated by the jackknife over vehicle-days. Its degrees of freedom follow
Satterthwaite: they count vehicle-days by their weight in the difference, so a slice of three days has the certainty of
three days.

Few days contain little information about their variance. The variance is therefore moderated, as in [3]_ for genes: it
is averaged with a variance that follows from the errors of the slice within days and from the share of all errors that
the rides of a day have in common. The latter counts for `PRIOR` degrees of freedom.

References
----------
.. [1] MacKinnon, White 1985, J. Econometrics 29:305, DOI 10.1016/0304-4076(85)90158-7: the jackknife.
.. [2] Bell, McCaffrey 2002, Survey Methodology 28:169: its degrees of freedom with few clusters.
.. [3] Smyth 2004, Stat. Appl. Genet. Mol. Biol. 3:3, DOI 10.2202/1544-6115.1027, eq. (8) of the moderated t.
.. [4] Searle, Casella, McCulloch, Variance Components, Wiley 1992, section 3.6: variance between days by analysis of
   variance.
.. [5] Wallace 1959, Ann. Math. Stat. 30:1121, DOI 10.1214/aoms/1177706100: Student's t as a normal score.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Floats, Ints

PRIOR: Final = 4.0
"""Degrees of freedom of the expected variance. Simulated errors without structure, also with cars and weather whose
days differ more than others, show that this value keeps false results at their level. With 0, a slice of three days is
hardly ever confirmed."""
LEAST_FREEDOM: Final = PRIOR + 0.8
"""Least degrees of freedom of a slice that is tested: those of about two vehicle-days."""
SHRINK: Final = 5.0
"""Number of rides for which the variance within days of all rides counts in that of a slice."""


class Contrast(NamedTuple):
    """Hold the mean errors of k slices relative to the other rides.

    Parameters
    ----------
    difference, error : (k,) float
        Mean error of a slice less that of the other rides, and its standard error. [kWh]
    freedom : (k,) float
        Degrees of freedom of the standard error; 0 where the slice or the rest is too small. [1]
    """

    difference: Floats
    error: Floats
    freedom: Floats

    def score(self) -> Floats:
        """Return the normal score of each difference [5]_, 0 where the slice or the rest is too small, (k,). [1]"""
        nu = np.maximum(self.freedom, 1.0)
        t2 = np.divide(self.difference**2, self.error**2, out=np.zeros(len(nu)), where=self.error > 0.0)
        return (8.0 * nu + 1.0) / (8.0 * nu + 3.0) * np.sqrt(nu * np.log1p(t2 / nu)) * np.sign(self.difference)


class _Sums(NamedTuple):
    """Hold the rides, errors and squared errors of k slices on each vehicle-day, (k, days)."""

    rides: Floats
    error: Floats
    square: Floats

    def mean(self) -> Floats:
        """Return the mean error of each slice, (k,)."""
        return self.error.sum(axis=1) / self.rides.sum(axis=1)

    def without(self) -> Floats:
        """Return the mean error of each slice without each vehicle-day, (k, days)."""
        left = self.error.sum(axis=1, keepdims=True) - self.error
        return left / (self.rides.sum(axis=1, keepdims=True) - self.rides)

    def share(self) -> Floats:
        """Return the share of the rides of each slice on each vehicle-day, (k, days)."""
        return self.rides / self.rides.sum(axis=1, keepdims=True)

    def within(self) -> tuple[Floats, Floats]:
        """Return the sum of squares about the means of vehicle-days and its degrees of freedom, (k,)."""
        squares = self.square - self.error**2 / np.maximum(self.rides, 1.0)
        return squares.sum(axis=1).clip(0.0), (self.rides - (self.rides > 0.0)).sum(axis=1)

    def spread_over(self) -> NDArray[np.bool_]:
        """Return whether the rides of a slice are on more than one vehicle-day, (k,)."""
        return self.rides.max(axis=1) < self.rides.sum(axis=1)


def compute_contrast(masks: NDArray[np.bool_], error: Floats, starts: Ints) -> Contrast:
    """Return the mean error of slices relative to the other rides.

    Units: error [kWh].

    Examples
    --------
    >>> inside = np.tile([True, False], (1, 6))
    >>> error = np.array([1.0, 0.0, 2.0, 0.0, 3.0, 0.0, 2.0, 0.0, 1.0, 0.0, 3.0, 0.0])
    >>> compute_contrast(inside, error, np.array([0, 4, 8])).difference.tolist()
    [2.0]
    """
    every = _Sums(*(np.add.reduceat(x, starts)[None, :] for x in (np.ones(len(error)), error, error**2)))
    inside = _Sums(
        np.add.reduceat(masks, starts, axis=1, dtype=np.float64),
        np.add.reduceat(masks * error, starts, axis=1),
        np.add.reduceat(masks * error**2, starts, axis=1),
    )
    outside = _Sums(*(whole - part for whole, part in zip(every, inside, strict=True)))
    sufficient = inside.spread_over() & outside.spread_over()
    with np.errstate(divide="ignore", invalid="ignore"):
        difference = inside.mean() - outside.mean()
        moved = inside.without() - outside.without() - difference[:, None]
        jackknife = (1.0 - 1.0 / len(starts)) * np.einsum("kd,kd->k", moved, moved)
        freedom = _freedom(inside, outside)
        variance = (PRIOR * _expected(inside, outside, every) + freedom * jackknife) / (PRIOR + freedom)
        sufficient &= freedom + PRIOR >= LEAST_FREEDOM
    return Contrast(
        np.where(sufficient, difference, 0.0),
        np.where(sufficient, np.sqrt(variance), np.inf),
        np.where(sufficient, freedom + PRIOR, 0.0),
    )


def _freedom(inside: _Sums, outside: _Sums) -> Floats:
    """Return the degrees of freedom of the jackknife if the error of a day is as large as that of a ride, (k,)."""
    one, other = inside.share(), outside.share()
    weight = one**2 / inside.rides.clip(1.0) + other**2 / outside.rides.clip(1.0) + (one - other) ** 2
    return weight.sum(axis=1) ** 2 / np.einsum("kd,kd->k", weight, weight) - 1.0


def _expected(inside: _Sums, outside: _Sums, every: _Sums) -> Floats:
    """Return the variance of the difference that follows from errors within days and from the common error of days."""
    squares, freedom = every.within()
    within = float(squares[0] / max(freedom[0], 1.0))
    days, rides = every.rides.shape[1], every.rides.sum()
    between = np.sum(every.rides * (every.error / every.rides - every.mean()) ** 2) / max(days - 1.0, 1.0)
    size = (rides - np.sum(every.rides**2) / rides) / max(days - 1.0, 1.0)
    common = max(float(between) - within, 0.0) / size / within if within > 0.0 else 0.0
    parts = []
    for part in (inside, outside):
        squares, freedom = part.within()
        parts.append((squares + SHRINK * within) / (freedom + SHRINK))
    apart = np.sum((inside.share() - outside.share()) ** 2, axis=1)
    of_rides = parts[0] / inside.rides.sum(axis=1) + parts[1] / outside.rides.sum(axis=1)
    return of_rides + common * apart * np.maximum(*parts)
