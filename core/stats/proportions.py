"""Intervals of proportions.

References
----------
Wilson, Journal of the American Statistical Association 22 (1927) 209, DOI 10.1080/01621459.1927.10502953.
"""

from math import nan, sqrt

from scipy import stats


def compute_wilson_interval(successes: float, trials: float, level: float = 0.95) -> tuple[float, float]:
    """Return Wilson's score interval of a proportion.

    Parameters
    ----------
    successes : float
        Number of successes.
    trials : float
        Number of independent trials, or the effective number where they have different weights.
    level : float
        Probability that the interval holds the proportion. [1]

    Returns
    -------
    float, float
        Lower and upper end; NaN without trials. [1]

    Notes
    -----
    With the proportion p of n trials and the normal quantile z, the interval is
    (p + z²/2n ± z √(p(1 - p)/n + z²/4n²)) / (1 + z²/n). Unlike p ± z √(p(1 - p)/n), it is valid for few trials and
    where p is near 0 or 1.

    Examples
    --------
    >>> [round(end, 3) for end in compute_wilson_interval(9, 10)]
    [0.596, 0.982]
    """
    if trials == 0.0:
        return nan, nan
    z = float(stats.norm.ppf((1.0 + level) / 2.0))
    share = successes / trials
    middle = share + z * z / (2.0 * trials)
    half = z * sqrt(share * (1.0 - share) / trials + z * z / (4.0 * trials**2))
    whole = 1.0 + z * z / trials
    return max((middle - half) / whole, 0.0), min((middle + half) / whole, 1.0)
