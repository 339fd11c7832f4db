"""Turn the evidence of all causes into probabilities that are right as often as they say.

Among the effects of the library, log evidences are compared as they are, apart from a factor. How probable it is that
several effects act together, or one that is not in the library, follows from the evidence that remains beside the most
probable effect, by a logistic regression whose coefficients were fitted to simulated fleets.
"""

from dataclasses import dataclass
from typing import Final, NamedTuple, TypeVar

import numpy as np

from socast.core.diagnose.posterior.causes import CauseEvidence, SelectedForm

NONE: Final = "none"
SEVERAL: Final = "several"
UNKNOWN: Final = "not in the library"
Key = TypeVar("Key", str, tuple[str, str])
LEVEL: Final = 0.9
"""Probability of a credible set."""


class Calibration(NamedTuple):
    """Hold the coefficients of the log odds; the notes of `compute_probabilities` give the equations. [1]

    Parameters
    ----------
    effects : float
        Weight of the evidence M of the best effect.
    rivals : float
        Weight of the evidence of each effect less M.
    several, several_second, several_first : float
        Constant of several effects, and weights of log(1 + D) and of log(1 + M).
    unknown, unknown_first : float
        Constant of a cause that is not in the library, and weight of log(1 + M).
    unknown_beside, unknown_bends, unknown_lead, unknown_shared : float
        Weights of v, b², l and s.
    """

    effects: float
    rivals: float
    none: float
    several: float
    several_second: float
    several_first: float
    unknown: float
    unknown_beside: float
    unknown_bends: float
    unknown_first: float
    unknown_lead: float
    unknown_shared: float


CALIBRATION: Final = Calibration(
    effects=1.237,
    rivals=0.725,
    none=0.994,
    several=-4.065,
    several_second=0.875,
    several_first=0.211,
    unknown=0.991,
    unknown_beside=3.62,
    unknown_bends=4.588,
    unknown_first=-0.255,
    unknown_lead=-1.759,
    unknown_shared=-3.011,
)
"""Fitted to 440 data sets of simulated fleets in plain and bent forms, seeds 500 to 521."""
FAINT: Final = 5.0
"""Evidence that is added to that of the best effect before other evidence is divided by it."""


@dataclass(frozen=True)
class Causes:
    """Hold the probability of each cause of what a model leaves.

    Parameters
    ----------
    probabilities : dict of str to float
        Of each effect alone, of `NONE`, of `SEVERAL` and of `UNKNOWN`, the largest first. They sum to 1. [1]
    leading : dict of str to float
        The same, with `SEVERAL` divided among the effects by which of the several explains most, the largest first. [1]
    forms : dict of str to SelectedForm
        Most probable form and coefficient of each effect.
    """

    probabilities: dict[str, float]
    leading: dict[str, float]
    forms: dict[str, SelectedForm]

    @property
    def first(self) -> str:
        """The most probable leading cause: an effect, `NONE` or `UNKNOWN`."""
        return next(iter(self.leading))

    def list_credible_set(self, level: float = LEVEL) -> list[str]:
        """Return the fewest leading causes whose probabilities sum to at least a level, the most probable first."""
        total = np.cumsum(list(self.leading.values()))
        return list(self.leading)[: int(np.searchsorted(total, min(level, total[-1]) - 1e-12)) + 1]


def compute_probabilities(evidence: CauseEvidence, calibration: Calibration = CALIBRATION) -> Causes:
    """Return the probability of each cause.

    Notes
    -----
    Evidence is logarithmic. Each of K effects has the evidence e, the best one M, and D is what a second effect adds.
    The log odds are

        no cause:        none
        an effect:       effects M + rivals (e - M) - log K
        several:         t + several + several_second log(1 + D) + several_first log(1 + M)
        not in library:  t + unknown + unknown_first log(1 + M) + unknown_beside v + unknown_bends b²
                         + unknown_lead l + unknown_shared s

    where t is the logarithm of the sum of the odds of all single effects. Shapes that no effect has are evidence for an
    unknown cause: U alone, and V beside the best effect. The others are shares of M + `FAINT`, at most 1: v = V, b is
    what the bends add to the evidence of the best effect, l its lead over the second-best one, and s = M + V - U what
    such shapes explain as well as the best effect.
    """
    single = {name: value for name, value in evidence.single.items() if np.isfinite(value)}
    c = calibration
    if not single:
        return Causes({NONE: 1.0}, {NONE: 1.0}, {})
    best = max(single, key=lambda name: single[name])
    top = max(single[best], 0.0)
    second = max(max(evidence.pairs.values(), default=top) - top, 0.0)
    common = c.effects * top - np.log(len(single))
    logits = {name: common + c.rivals * (value - top) for name, value in single.items()}
    together = float(np.logaddexp.reduce(list(logits.values())))
    logits[NONE] = c.none
    if evidence.pairs:
        logits[SEVERAL] = together + c.several + c.several_second * np.log1p(second) + c.several_first * np.log1p(top)
    logits[UNKNOWN] = together + _weigh_unknown(evidence, best, calibration)
    probabilities = _normalise(logits)
    leading = {name: value for name, value in probabilities.items() if name != SEVERAL}
    if evidence.pairs:
        shares = _normalise({pair: c.rivals * value for pair, value in evidence.pairs.items()})
        for (one, other), share in shares.items():
            leader = one if single.get(one, -np.inf) >= single.get(other, -np.inf) else other
            leading[leader] += share * probabilities[SEVERAL]
    return Causes(_sort(probabilities), _sort(leading), {name: evidence.forms[name] for name in single})


def _weigh_unknown(evidence: CauseEvidence, best: str, c: Calibration) -> float:
    """Return the log odds of an unknown cause relative to all single effects."""
    top = max(evidence.single[best], 0.0)
    rival = max((value for name, value in evidence.single.items() if name != best), default=-np.inf)
    beside = max(evidence.beside.get(best, 0.0), 0.0)
    shared = top + beside - max(evidence.unknown, 0.0)
    parts = np.array([beside, top - evidence.stiff[best], top - rival, shared])
    beside, bends, lead, shared = np.clip(parts, 0.0, top) / (top + FAINT)
    return float(
        c.unknown
        + c.unknown_beside * beside
        + c.unknown_bends * bends**2
        + c.unknown_first * np.log1p(top)
        + c.unknown_lead * lead
        + c.unknown_shared * shared
    )


def _normalise(logits: dict[Key, float]) -> dict[Key, float]:
    """Return probabilities from their logarithms up to a constant."""
    top = max(logits.values())
    weights = {key: float(np.exp(value - top)) for key, value in logits.items()}
    total = sum(weights.values())
    return {key: weight / total for key, weight in weights.items()}


def _sort(values: dict[str, float]) -> dict[str, float]:
    """Return the entries of a dictionary, the largest value first."""
    return dict(sorted(values.items(), key=lambda item: -item[1]))
