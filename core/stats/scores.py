"""Error measures of predictions, and their uncertainty.

An estimate over repeated splits is a mean with a standard error. The repeats draw from the same rides and overlap, so a
plain standard error of their mean is far too small: it would vanish with the number of repeats although the rides stay
the same. The variance between repeats, s², is therefore corrected for the overlap (Nadeau and Bengio 2003),

    var = (1/J + n_test/n_train) s²,

with J repeats; intervals use Student's t with J - 1 degrees of freedom. They apply to the error on new rides like those
of the table. They do not apply to unseen cars or days; splits by vehicle and by date cover these. The paper does not
say how its own intervals were made.

References
----------
Nadeau and Bengio, Machine Learning 52 (2003) 239, "Inference for the Generalization Error", DOI
10.1023/A:1024068626366. Holt and Smith, Journal of the Royal Statistical Society A 142 (1979) 33, "Post
Stratification", DOI 10.2307/2344652. Satterthwaite, Biometrics Bulletin 2 (1946) 110, DOI 10.2307/3002019.
"""

from collections.abc import Sequence
from math import ceil, inf, isnan, nan, sqrt
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri, stdtr, stdtrit

from socast.core.batch import Floats

Codes = NDArray[np.int64]

BANDS: Final = (5, 10, 15)
"""Relative errors within which rides are counted. [%]"""
NORMAL_MEDIAN: Final = 0.6745
"""Median of the absolute value of a normal deviate."""
NORMAL_95: Final = float(ndtri(0.975))
"""Half width of a 95 % interval of a normal estimate. [standard errors]"""


def compute_half_widths(error: Floats | float, freedom: Floats | float, level: float = 0.95) -> Floats:
    """Return half the widths of confidence intervals by Student's t; NaN where degrees of freedom are not positive."""
    return np.asarray(stdtrit(freedom, 0.5 + level / 2.0) * error)


class Estimate(NamedTuple):
    """Hold a value and its uncertainty.

    Parameters
    ----------
    value : float
        Estimated value.
    error : float
        Standard error, NaN where it is unknown.
    freedom : float
        Degrees of freedom of the standard error.
    """

    value: float
    error: float
    freedom: float

    @property
    def ci95(self) -> float:
        """Half width of the 95 % confidence interval."""
        return float(compute_half_widths(self.error, self.freedom))

    @property
    def interval(self) -> tuple[float, float]:
        """Ends of the 95 % confidence interval."""
        return self.value - self.ci95, self.value + self.ci95

    @property
    def upper95(self) -> float:
        """End of the one-sided 95 % confidence interval: the true value is higher in one case of twenty."""
        if self.error == 0.0:
            return self.value
        return self.value + float(compute_half_widths(self.error, self.freedom, 0.9))

    @property
    def p(self) -> float:
        """Two-sided probability of a value at least as far from zero where the true value is zero. [1]"""
        if self.error == 0.0:
            return 1.0 if self.value == 0.0 else 0.0
        return float(2.0 * stdtr(self.freedom, -abs(self.value) / self.error)) if self.freedom > 0 else nan


UNKNOWN: Final = Estimate(nan, nan, nan)


def average_over_repeats(values: Floats, overlap: float) -> Estimate:
    """Return the mean over repeats, with a standard error that allows for their overlap.

    Parameters
    ----------
    values : (repeats,) float
        Value of each repeat, NaN where it has none.

    Examples
    --------
    >>> average_over_repeats(np.array([1.0, 2.0, 3.0]), overlap=2 / 3)
    Estimate(value=2.0, error=1.0, freedom=2)
    """
    known = values[~np.isnan(values)]
    repeats = len(known)
    if repeats == 0:
        return UNKNOWN
    error = sqrt((1.0 / repeats + overlap) * float(np.var(known, ddof=1))) if repeats > 1 else nan
    return Estimate(float(np.mean(known)), error, repeats - 1)


def compute_widening(repeats: int, overlap: float) -> float:
    """Return how much wider an interval over repeats is than one over an unlimited number of them.

    Examples
    --------
    >>> [round(compute_widening(repeats, 0.25), 1) for repeats in (2, 3, 5, 8, 10)]
    [11.2, 3.4, 1.9, 1.5, 1.4]
    """
    return float(compute_half_widths(sqrt((1.0 / repeats + overlap) / overlap), repeats - 1) / NORMAL_95)


def combine_strata(parts: Sequence[Estimate], weights: Sequence[float] | None = None) -> Estimate:
    """Return the weighted mean of independent estimates of strata: the post-stratified estimate (Holt and Smith 1979).

    Parameters
    ----------
    weights : sequence of float, optional
        Weights of the strata; equal where not given, as in the starred averages of the paper.

    Returns
    -------
    Estimate
        The variance is conditional on the number of rides in each stratum, the sum of W² var. The degrees of freedom
        are Satterthwaite's.

    Examples
    --------
    >>> combine_strata([Estimate(1.0, 0.5, 9), Estimate(2.0, 0.5, 9)], weights=[1, 1]).value
    1.5
    """
    given = [1.0] * len(parts) if weights is None else list(weights)
    pairs = [(part, weight) for part, weight in zip(parts, given, strict=True) if not isnan(part.value) and weight > 0]
    total = sum(weight for _, weight in pairs)
    if not pairs:
        return UNKNOWN
    shares = [(weight / total * part.error) ** 2 for part, weight in pairs]
    variance = sum(shares)
    spread = sum(share**2 / part.freedom for share, (part, _) in zip(shares, pairs, strict=True) if share > 0.0)
    value = sum(weight / total * part.value for part, weight in pairs)
    return Estimate(value, sqrt(variance), variance**2 / spread if spread > 0.0 else nan if isnan(variance) else inf)


def compute_group_means(values: Floats, groups: Codes, count: int) -> Floats:
    """Return the mean of each group.

    Parameters
    ----------
    groups : (n,) int64
        Group of each value, from 0. Negative codes and those from `count` on are left out.

    Returns
    -------
    (count,) float
        Mean of each group, NaN for an empty group.
    """
    counted = (groups >= 0) & (groups < count)
    rides = np.bincount(groups[counted], minlength=count)
    sums = np.bincount(groups[counted], weights=values[counted], minlength=count)
    return np.divide(sums, rides, out=np.full(count, np.nan), where=rides > 0)


def compute_buffer(measured: Floats, predicted: Floats, share: float) -> float:
    """Return the least reserve that suffices for a share of rides: measured <= predicted + buffer. [kWh]

    Negative where that share of rides uses less than predicted; NaN without rides.

    Units: measured [kWh], predicted [kWh].

    Examples
    --------
    >>> compute_buffer(np.array([1.0, 2.0, 3.0, 9.0]), np.array([1.0, 1.0, 1.0, 1.0]), 0.75)
    2.0
    """
    excess = np.sort(measured - predicted)
    return float(excess[ceil(share * len(excess) - 1e-9) - 1]) if len(excess) else nan


def compute_band_shares(measured: Floats, predicted: Floats) -> dict[str, float | None]:
    """Return the share of rides whose error is within 5, 10 and 15 % of the measured energy. [1]"""
    error, limit = np.abs(predicted - measured), np.abs(measured) / 100.0
    return {str(band): float(np.mean(error <= band * limit)) if len(error) else nan for band in BANDS}


def compute_bias(measured: Floats, predicted: Floats) -> float:
    """Return the mean of predicted minus measured energy, NaN without rides. [kWh]"""
    return float(np.mean(predicted - measured)) if len(measured) else nan


def compute_mae(measured: Floats, predicted: Floats) -> float:
    """Return the mean absolute error, NaN without rides. [kWh]"""
    return float(np.mean(np.abs(predicted - measured))) if len(measured) else nan


def compute_relative_errors(measured: Floats, predicted: Floats, least: float) -> Floats:
    """Return the absolute error of each ride over its measured energy. [1]

    Units: measured [kWh], predicted [kWh], least [kWh].

    Returns
    -------
    (n,) float
        Relative error, NaN where the measured energy is below `least`. [1]

    Examples
    --------
    >>> compute_relative_errors(np.array([2.0, 0.01, -0.5]), np.array([1.5, 0.5, 0.0]), least=0.1)
    array([0.25,  nan,  nan])
    """
    counted = measured >= least
    return np.divide(np.abs(predicted - measured), measured, out=np.full(len(measured), np.nan), where=counted)


def compute_mape(measured: Floats, predicted: Floats, least: float) -> float:
    """Return the mean absolute percentage error, as a share, of the rides that used at least an energy. [1]

    Rides of almost no energy are left out, because their relative errors have no bound: a ride downhill may even regain
    energy. NaN where no ride is left.

    Units: measured [kWh], predicted [kWh], least [kWh].

    Examples
    --------
    >>> compute_mape(np.array([2.0, 4.0, 0.01]), np.array([1.5, 5.0, 1.0]), least=0.1)
    0.25
    """
    errors = compute_relative_errors(measured, predicted, least)
    known = errors[~np.isnan(errors)]
    return float(np.mean(known)) if len(known) else nan


def compute_wmape(measured: Floats, predicted: Floats) -> float:
    """Return the weighted mean absolute percentage error, as a share: sum of absolute errors over sum of energy. [1]

    It counts every ride, each by its energy. NaN where the energies do not add up to more than zero.

    Units: measured [kWh], predicted [kWh].

    References
    ----------
    Kolassa and Schütz, Foresight 6 (2007) 40, "Advantages of the MAD/Mean ratio over the MAPE".

    Examples
    --------
    >>> compute_wmape(np.array([2.0, 4.0, -1.0]), np.array([1.5, 5.0, 0.0]))
    0.5
    """
    total = float(np.sum(measured))
    return float(np.sum(np.abs(predicted - measured))) / total if total > 0.0 else nan


def compute_rmse(measured: Floats, predicted: Floats) -> float:
    """Return the root mean square error, NaN without rides. [kWh]"""
    return sqrt(float(np.mean((predicted - measured) ** 2))) if len(measured) else nan


def compute_coverage(measured: Floats, lower: Floats, upper: Floats) -> float:
    """Return the share of rides inside their intervals, ends included; NaN without rides. [1]"""
    return float(np.mean((lower <= measured) & (measured <= upper))) if len(measured) else nan


def compute_bin_errors(
    measured: Floats, predicted: Floats, groups: Codes, labels: Sequence[str]
) -> list[dict[str, float | int | str]]:
    """Return the errors in each bin that has any predictions.

    Units: measured [kWh], predicted [kWh].

    Parameters
    ----------
    groups : (n,) int64
        Bin of each ride, an index into `labels`; outside of it where the ride is in no bin.

    Returns
    -------
    list of dict
        `bin`, `n`, `bias` and `mae` [kWh], `relative` (mean absolute error over mean consumption) [1].
    """
    bins: list[dict[str, float | int | str]] = []
    for code, label in enumerate(labels):
        actual, forecast = measured[groups == code], predicted[groups == code]
        if len(actual):
            error = compute_mae(actual, forecast)
            used = float(np.mean(actual))
            relative = error / used if used > 0.0 else nan
            n, bias = len(actual), compute_bias(actual, forecast)
            bins.append({"bin": label, "n": n, "bias": bias, "mae": error, "relative": relative})
    return bins
