"""Whether an effect is there: tests of what a model leaves against what candidates ask for.

Everything here is in weighted, projected terms (`core.diagnose.projection`): a residual r and candidates c, one a column, of
which the model's own terms can take up nothing. Then the coefficient of a candidate is c'r / c'c. Errors of windows of
one vehicle-day depend on each other in any way; the variance is their sums' squares, each over 1 - h with the share h
of c'c that the vehicle-day has, as if it were left out (CR3). A candidate that acts on a few days only has as many
degrees of freedom. Cars that drive on the same day share its weather, and what is wrong with it: so the test is made
over days too, and the worse of the two holds.

References
----------
Bell and McCaffrey, Survey Methodology 28 (2002) 169, bias reduction in standard errors for linear regression with
multi-stage samples. Cameron and Miller, Journal of Human Resources 50 (2015) 317, DOI 10.3368/jhr.50.2.317, sections II
and VI. Benjamini and Hochberg, Journal of the Royal Statistical Society B 57 (1995) 289.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from scipy import stats

from core.batch import Floats, Ints

FOLDS: Final = 10
"""Parts into which clusters are dealt."""
ALL_OF_IT: Final = 0.999
"""Share of a candidate in one vehicle-day from which on nothing tells its error."""
LEAST_FREEDOM: Final = 0.5
MOST_DISTORTED: Final = 3.0
"""Standard deviations of a distortion that are the most that is to be feared of it."""


class ClusterSums:
    """Vehicle-days, to sum over.

    Parameters
    ----------
    code : (n,) int64
        From 0, each at least once.
    """

    def __init__(self, code: Ints) -> None:
        self.code = code
        self.count = int(code.max()) + 1
        self._order = np.argsort(code, kind="stable")
        self._starts = np.flatnonzero(np.r_[True, np.diff(code[self._order]) > 0])

    def assign_folds(self, seed: int) -> Ints:
        """Return into which of at most `FOLDS` parts each is dealt, (count,)."""
        return np.random.default_rng(seed).permutation(self.count) % min(FOLDS, self.count)

    def sum_by_cluster(self, values: Floats) -> Floats:
        """Return the sum over each, (count, ...)."""
        return np.asarray(np.add.reduceat(values[self._order], self._starts, axis=0))


class Evidence(NamedTuple):
    """What each of k candidates is worth, alone beside the model.

    Parameters
    ----------
    coefficient, error : (k,) float
        And its standard error. [unit of the coefficient]
    freedom : (k,) float
        Degrees of freedom of the error.
    z, p : (k,) float
        Coefficient over error, and the probability of it or more where there is no effect worth the name, with the
        sign physics demands.
    """

    coefficient: Floats
    error: Floats
    freedom: Floats
    z: Floats
    p: Floats

    def allow_for_distortion(self, most: Floats) -> "Evidence":
        """Return the same with errors that hold what samples distort of coefficients too, `most` either way at most.

        Notes
        -----
        The most that is to be feared of a distortion is `MOST_DISTORTED` standard deviations of it.
        """
        return self._replace(error=np.hypot(self.error, most / MOST_DISTORTED))

    def compute_interval(self, at: int, level: float = 0.95) -> tuple[float, float]:
        """Return the confidence interval of a candidate's coefficient."""
        half = float(stats.t.ppf(0.5 + level / 2.0, self.freedom[at]) * self.error[at])
        return float(self.coefficient[at]) - half, float(self.coefficient[at]) + half


def compute_worst_case_evidence(
    residual: Floats, candidates: Floats, sign: Ints, clusters: Sequence[ClusterSums], least: Floats | None = None
) -> Evidence:
    """Return the evidence by the clusters that are least sure of each candidate, see `weigh`."""
    found = [compute_evidence(residual, candidates, sign, each, least) for each in clusters]
    worst = np.argmax([each.p for each in found], axis=0)
    widest = np.argmax([each.error * stats.t.ppf(0.975, each.freedom) for each in found], axis=0)
    error, freedom = (np.choose(widest, [getattr(each, name) for each in found]) for name in ("error", "freedom"))
    z, p = (np.choose(worst, [getattr(each, name) for each in found]) for name in ("z", "p"))
    return Evidence(found[0].coefficient, error, freedom, z, p)


def compute_evidence(
    residual: Floats, candidates: Floats, sign: Ints, clusters: ClusterSums, least: Floats | None = None
) -> Evidence:
    """Return the evidence for each candidate.

    Parameters
    ----------
    residual : (n,) float
    candidates : (n, k) float
    sign : (k,) int
        That physics demands: 1, -1, or 0 for either.
    clusters : Clusters
    least : (k,) float, optional
        Size of a coefficient that is not worth a name; the test is whether there is more. [unit of the coefficient]
    """
    size = np.maximum((candidates**2).sum(axis=0), 1e-300)
    coefficient = candidates.T @ residual / size
    share = clusters.sum_by_cluster(candidates**2) / size
    scores = clusters.sum_by_cluster(candidates * (residual[:, np.newaxis] - candidates * coefficient))
    scores /= 1.0 - np.minimum(share, ALL_OF_IT)
    alone = share.max(axis=0) > ALL_OF_IT
    error = np.where(alone, np.inf, np.sqrt((scores**2).sum(axis=0)) / size)
    freedom = np.maximum(1.0 / np.maximum((share**2).sum(axis=0), 1e-300) - 1.0, LEAST_FREEDOM)
    z = np.divide(coefficient, error, out=np.zeros(len(size)), where=error > 0.0)
    beyond = np.where(sign == 0, np.abs(coefficient), coefficient * sign) - (0.0 if least is None else least)
    over = np.divide(beyond, error, out=np.full(len(size), -np.inf), where=error > 0.0)
    one_sided = stats.t.sf(over, freedom)
    return Evidence(coefficient, error, freedom, z, np.where(sign == 0, np.minimum(2.0 * one_sided, 1.0), one_sided))
