"""Shares of forecasts with their intervals, where forecasts of a cluster are alike."""

from math import nan, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from core.stats.clustered import compute_clustered_mean
from core.stats.scores import Codes

LEAST_CLUSTERS: Final = 30
"""Of fewer clusters a share tells too little to be shown as a figure."""


def compute_clustered_share(holds: NDArray[np.bool_], clusters: Codes) -> dict[str, float]:
    """Return a share with the 95 % interval that allows for cases of a cluster being alike.

    Parameters
    ----------
    holds : (n,) bool
    clusters : (n,) int64

    Returns
    -------
    dict
        `value`, `low` and `high`; and `clusters`, how many there are.

    Notes
    -----
    Wilson's interval for the effective number of cases m,

        (p + z²/2m ± z sqrt(p (1 - p)/m + z²/4m²)) / (1 + z²/m),

    where m is less than the number of cases by the ratio of the variance of independent cases to the clustered one,
    and for its degrees of freedom; where all or none hold, it is the number of clusters.

    References
    ----------
    Wilson, Journal of the American Statistical Association 22 (1927) 209, DOI 10.1080/01621459.1927.10502953. Korn and
    Graubard, Survey Methodology 24 (1998) 193, section 3, on the effective number.

    Examples
    --------
    >>> found = clustered_share(np.array([True] * 18 + [False] * 2), np.arange(20))
    >>> [round(found[name], 2) for name in ("value", "low", "high")]
    [0.9, 0.7, 0.97]
    """
    estimate, count = compute_clustered_mean(holds.astype(np.float64), clusters), len(np.unique(clusters))
    n, share = float(len(holds)), estimate.value
    if not n or not estimate.freedom > 0.0:
        return {"value": share, "low": nan, "high": nan, "clusters": count}
    if estimate.error > 0.0:
        stretch = stats.t.ppf(0.975, n - 1.0) / stats.t.ppf(0.975, estimate.freedom)
        alone = share * (1.0 - share) / (n - 1.0)
        n = min(n, n * alone / estimate.error**2 * stretch**2)
    else:
        n = float(count)
    low, high = compute_wilson_interval(share, n)
    return {"value": share, "low": low, "high": high, "clusters": count}


def compute_wilson_interval(share: float, n: float) -> tuple[float, float]:
    """Return the ends of Wilson's 95 % interval of a share of n cases.

    Examples
    --------
    >>> [round(end, 3) for end in wilson(0.0, 10)]
    [0.0, 0.278]
    """
    z = float(stats.norm.ppf(0.975))
    middle, reach = share + z * z / (2.0 * n), z * sqrt(share * (1.0 - share) / n + z * z / (4.0 * n * n))
    whole = 1.0 + z * z / n
    return (middle - reach) / whole if share > 0.0 else 0.0, (middle + reach) / whole if share < 1.0 else 1.0
