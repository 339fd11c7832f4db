"""Estimate how often chance gives as much evidence for a change of a car as was found.

A car has one evidence for a change: the Bayes factor averaged over candidates, dates and forms. Its tests are
correlated, because candidates have similar shapes and dates share shifts, so that no simple correction for their number
is right. Scores without any change are drawn from their known normal distribution instead, and the evidence of each
draw is that of chance.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
from scipy.special import logsumexp

from socast.core.batch import Floats, Ints
from socast.core.diagnose.siblings.scan import Scan, build_changes
from socast.core.diagnose.siblings.shift_scores import ShiftScores

DRAWS: Final = 1000
"""Number of draws."""
PART: Final = 250
"""Number of draws that are evaluated at once."""
TAIL: Final = 0.05
"""Share of the draws with the most evidence, from which the chance of still more evidence is extrapolated."""
NO_EVIDENCE: Final = 0.0
"""Evidence below which no chance is computed: the data speak for no change."""
SEED: Final = 0
"""Seed of the draws, so that the same data give the same result."""


def estimate_chance(scores: ShiftScores, start: Floats, scans: Sequence[Scan], sign: Ints) -> float:
    """Return the probability that a car without any change shows as much evidence for one.

    Notes
    -----
    An averaged Bayes factor B has the mean one without any change, so that P(log B > x) falls at least like exp(-x).
    Beyond the quantile x0 that `TAIL` of the draws exceed, the chance is TAIL exp(-(x - x0) / μ), with μ the mean
    excess over x0.
    """
    scans = [scan for scan in scans if len(scan.begin)]
    if not scans:
        return 1.0
    found = float(_average(scans, sign))
    if not found > NO_EVIDENCE:
        return 1.0
    rng = np.random.default_rng(SEED)
    tests = [_Test(scores, start, scan) for scan in scans]
    parts = (scores.draw(PART, rng) for _ in range(DRAWS // PART))
    chance = np.concatenate([_average([test.score(part) for test in tests], sign) for part in parts])
    edge = float(np.quantile(chance, 1.0 - TAIL))
    if found <= edge:
        return float(np.mean(chance >= found))
    excess = float(np.mean(chance[chance > edge]) - edge)
    return float(TAIL * np.exp(-(found - edge) / excess))


class _Test:
    """Give tests of a form of change to drawn scores."""

    def __init__(self, scores: ShiftScores, start: Floats, scan: Scan) -> None:
        if scan.kind == "always":
            raise ValueError("only changes have dates")
        self.scan = scan
        _, self.weights = build_changes(start, scan.kind)
        self.share = scores.project(self.weights).whole_share

    def score(self, drawn: Floats) -> Scan:
        """Return the tests of drawn scores (count, n, k), of shape (count, m, k)."""
        left = self.weights @ drawn - self.share * drawn.sum(axis=1, keepdims=True)
        return self.scan._replace(score=left * self.scan.unit)


def _average(scans: Sequence[Scan], sign: Ints) -> Floats:
    """Return the evidence averaged over forms, dates and candidates."""
    each = []
    for scan in scans:
        evidence = scan.compute_evidence(sign)
        count = len(scans) * evidence.shape[-1] * evidence.shape[-2]
        each.append(logsumexp(evidence, axis=(-2, -1)) - np.log(count))
    return np.asarray(np.logaddexp.reduce(each))
