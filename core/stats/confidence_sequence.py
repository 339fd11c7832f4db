"""A confidence sequence for a running mean over clusters of unequal size, valid however often it is read.

A 95 % interval that is read after every ride misses the true mean sooner or later. An interval that holds at all times
at once must be wider. This one uses the mixture method, and stays infinite until enough clusters have been seen.
"""

from collections.abc import Sequence
from math import exp, inf, log, sqrt
from typing import Final, NamedTuple

LEVEL: Final = 0.95
"""Probability with which an interval holds at all times. [1]"""
MIXTURE: Final = 0.05
"""Variance of the normal mixture, in squared standard deviations of a cluster.

Compared with an interval that is read once, the sequence is tightest at about 9 / `MIXTURE` = 180 clusters. A larger
variance would decide sooner, at numbers of clusters too small for their mean to be normal, and would then miss the mean
of skewed clusters too often.
"""


class MeanInterval(NamedTuple):
    """Hold the bounds of a mean.

    Parameters
    ----------
    lower, upper : float
        Bounds, in the unit of the mean.
    """

    lower: float
    upper: float


EVERYWHERE: Final = MeanInterval(-inf, inf)
"""Interval of a mean while too few clusters have been seen."""


def compute_reach(clusters: int, level: float = LEVEL) -> float:
    """Return how far the mean of clusters may deviate from the true mean, at any time.

    Parameters
    ----------
    level : float
        Probability that the mean stays within this distance for every number of clusters at once. [1]

    Returns
    -------
    float
        Distance in standard deviations of a cluster (with the number of clusters as divisor of the variance); infinite
        for few clusters. [1]

    Notes
    -----
    With the mean's square over the variance as x, the number of clusters as t and g = `MIXTURE`,

        (1 + g t)^(-1/2) ((1 + x) / (1 + x / (1 + g t)))^(t/2)

    is a martingale of mean 1 where clusters are normal, of mean 0 and of any variance. By Ville's inequality it ever
    reaches 1 / alpha with a probability of at most alpha. For many clusters it becomes the asymptotic confidence
    sequence of Waudby-Smith et al., which needs no normal clusters and holds for a running average of means that
    change, for example with the season. For few and skewed clusters it misses more often: in simulations with 500
    clusters, 3 % of runs miss at 95 % where clusters are normal or heavy-tailed, 7 % where they are exponential, 12 %
    where they are log-normal. An interval meant for a single reading misses in 40 to 60 % of runs.

    References
    ----------
    H. Wang and A. Ramdas, "Anytime-valid t-tests and confidence sequences for Gaussian means with unknown variance",
    arXiv:2310.03722, on the Gaussian mixture. I. Waudby-Smith et al., "Time-uniform central limit theory and asymptotic
    confidence sequences", arXiv:2103.06476. S. R. Howard et al., "Time-uniform, nonparametric, nonasymptotic confidence
    sequences", Annals of Statistics 49 (2021) 1055, DOI 10.1214/20-AOS1991.

    Examples
    --------
    >>> [round(compute_reach(clusters), 2) for clusters in (5, 20, 50, 200)]
    [inf, 1.15, 0.48, 0.22]
    """
    if clusters < 1:
        return inf
    spread = 1.0 + MIXTURE * clusters
    growth = exp(log(spread / (1.0 - level) ** 2) / clusters)
    return sqrt((growth - 1.0) / (1.0 - growth / spread)) if growth < spread else inf


class ClusterMoments:
    """Accumulate moments of completed clusters, each with its size and its total.

    Parameters
    ----------
    state : sequence of 6 floats, optional
        Value of `state` to continue from: number of clusters, then the sums of size, total, size², size times total,
        and total².
    """

    __slots__ = ("state",)

    def __init__(self, state: Sequence[float] = (0.0,) * 6) -> None:
        self.state = list(state)

    @property
    def count(self) -> int:
        """Number of clusters."""
        return int(self.state[0])

    @property
    def size(self) -> int:
        """Sum of the sizes of all clusters."""
        return int(self.state[1])

    @property
    def mean(self) -> float:
        """Sum of the totals over the sum of the sizes; NaN without clusters."""
        _, size, total, *_ = self.state
        return total / size if size else float("nan")

    def add(self, size: int, total: float) -> None:
        """Add a completed cluster."""
        for place, value in enumerate((1.0, size, total, size * size, size * total, total * total)):
            self.state[place] += value

    def interval(self, level: float = LEVEL) -> MeanInterval:
        """Return the interval that holds the mean at all times at once, with a given probability.

        Notes
        -----
        A mean m is inside where the mean of total - m size over the clusters is within `compute_reach` standard
        deviations of 0. This is Fieller's interval for a ratio, with that reach in place of Student's t. Clusters are
        assumed to be independent of each other; their members may depend on each other in any way.

        References
        ----------
        E. C. Fieller, "Some problems in interval estimation", JRSS B 16 (1954) 175.
        """
        count = self.state[0]
        reach_squared = compute_reach(self.count, level) ** 2
        if reach_squared == inf:
            return EVERYWHERE
        size, total, size_size, size_total, total_total = (moment / count for moment in self.state[1:])
        # m is inside the interval where a m^2 - 2 b m + c <= 0
        a = size * size - reach_squared * max(0.0, size_size - size * size)
        b = size * total - reach_squared * (size_total - size * total)
        c = total * total - reach_squared * max(0.0, total_total - total * total)
        root = b * b - a * c
        if a <= 0.0 or root < 0.0:
            return EVERYWHERE
        half = sqrt(root) / a
        return MeanInterval(b / a - half, b / a + half)
