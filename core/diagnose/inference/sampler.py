"""Sample which alternatives are true together: block Gibbs over families, with swaps between families.

Given a set S of alternatives, the log evidence against none is

    -log|I + A_SS| / 2 + g_S' (I + A_SS)^-1 g_S / 2 + sum of log (share after / share before),

where the shares are those of the distributions of each coefficient, after and before the data, that lie in its
plausible range. The last term is exact for one alternative, and approximate for several.

References
----------
George and McCulloch, Journal of the American Statistical Association 88 (1993) 881, DOI 10.1080/01621459.1993.10476353.
"""

from collections import Counter
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np

from socast.core.batch import Floats, Ints
from socast.core.diagnose.inference.alternatives import Alternatives, log_share_within

SWEEPS: Final = 120
"""Number of sweeps over all families."""
BURNT: Final = 20
"""Number of sweeps at the beginning that do not count."""
MOST_KEPT: Final = 1024
"""Largest number of sets whose odds are kept."""


def weigh_further(given: Alternatives, chosen: list[int], further: Ints) -> Floats:
    """Return the log evidence of a set and one further alternative, less that of the set alone, for each of several."""
    own = given.own[further, further]
    if chosen:
        rows = np.array(chosen)
        inverse = np.linalg.inv(given.own[np.ix_(rows, rows)] + np.eye(len(chosen)))
        beside = given.own[np.ix_(rows, further)]
        gain = inverse @ beside
        precise, match = 1.0 + own - (beside * gain).sum(axis=0), given.match[further] - gain.T @ given.match[chosen]
    else:
        precise, match = 1.0 + own, given.match[further]
    precise = np.maximum(precise, 1e-9)
    mean = match / precise
    out = 0.5 * match * mean - 0.5 * np.log(precise)
    limits = given.limits[:, further]
    out += log_share_within(limits, mean, 1.0 / np.sqrt(precise)) - log_share_within(limits)
    if chosen:
        before, sd = (inverse @ given.match[chosen])[:, np.newaxis], np.sqrt(np.diag(inverse))[:, np.newaxis]
        wider = np.sqrt(sd**2 + gain**2 / precise)
        beside_limits = given.limits[:, chosen, np.newaxis]
        after = log_share_within(beside_limits, before - gain * mean, wider)
        out += (after - log_share_within(beside_limits, before, sd)).sum(axis=0)
    return np.asarray(out)


class Sample(NamedTuple):
    """Hold what may be true.

    Parameters
    ----------
    chances : (k,) float
        Probability of each alternative, averaged over what may be true beside it. [1]
    together : dict of int to int
        Family -> its alternative, in the most frequent set of what is true together.
    """

    chances: Floats
    together: dict[int, int]


class _Odds:
    """Hold the distributions of what each family has beside a set of alternatives of other families.

    Parameters
    ----------
    odds : (k,) float
        Log odds of each alternative beside the set.
    open_rows : (m,) int
        Alternatives of the families that are not in the set.
    """

    def __init__(self, odds: Floats, open_rows: Ints) -> None:
        self.odds = odds
        self.open_rows = open_rows
        self._of_family: dict[int, tuple[Floats, Floats]] = {}

    def of_family(self, family: int, rows: Ints) -> tuple[Floats, Floats]:
        """Return the probabilities of the alternatives of a family and of none, and their cumulative sums."""
        if family not in self._of_family:
            chances = normalise(np.append(self.odds[rows], 0.0))
            self._of_family[family] = chances[:-1], _accumulate(chances)
        return self._of_family[family]

    @cached_property
    def of_open(self) -> Floats:
        """Cumulative probabilities of the alternatives of the families that are not in the set."""
        return _accumulate(normalise(self.odds[self.open_rows]))


class _KnownOdds:
    """Compute the odds beside each set once, because most sets come again.

    Parameters
    ----------
    rows : dict of int to (m,) int64
        Family -> its alternatives.
    """

    def __init__(self, given: Alternatives, rows: dict[int, Ints]) -> None:
        self.given, self.rows = given, rows
        self._kept: dict[tuple[int, ...], _Odds] = {}

    def weigh(self, state: dict[int, int]) -> _Odds:
        """Return the odds of each alternative beside what is true, family -> its alternative."""
        true = tuple([state[family] for family in sorted(state)])
        if true not in self._kept:
            if len(self._kept) >= MOST_KEPT:
                self._kept.clear()
            odds = weigh_further(self.given, list(true), np.arange(len(self.given.family))) + self.given.log_odds
            rows = np.concatenate([at for family, at in self.rows.items() if family not in state])
            self._kept[true] = _Odds(odds, rows)
        return self._kept[true]


def sample_alternatives(given: Alternatives, seed: int = 0) -> Sample:
    """Return the probability of each alternative, and the set that is most often true together."""
    rng = np.random.default_rng(seed)
    rows = {family: np.flatnonzero(given.family == family) for family in sorted(set(given.family.tolist()))}
    families, state = np.array(list(rows)), dict[int, int]()
    total = np.zeros(len(given.family))
    sets: Counter[tuple[int, ...]] = Counter()
    known = _KnownOdds(given, rows)
    for sweep in range(SWEEPS):
        beside: _Odds | None = None
        for family in rng.permutation(families).tolist():
            if state.pop(family, None) is not None or beside is None:
                beside = known.weigh(state)
            chances, cumulative = beside.of_family(family, rows[family])
            drawn = int(cumulative.searchsorted(rng.random(), side="right"))
            if drawn < len(chances):
                state[family], beside = int(rows[family][drawn]), None
            if sweep >= BURNT:
                total[rows[family]] += chances
        for family in sorted(state):  # one moves to any free family
            del state[family]
            beside = known.weigh(state)
            drawn = int(beside.open_rows[beside.of_open.searchsorted(rng.random(), side="right")])
            state[int(given.family[drawn])] = drawn
        if sweep >= BURNT:
            sets[tuple(sorted(state))] += 1
    chances = total / (SWEEPS - BURNT)
    most = max(sets, key=lambda families: (sets[families], families)) if sets else ()
    return Sample(chances, {family: int(rows[family][np.argmax(chances[rows[family]])]) for family in most})


def _accumulate(chances: Floats) -> Floats:
    """Return cumulative probabilities, of which the last is 1."""
    cumulative = chances.cumsum()
    return np.asarray(cumulative / cumulative[-1])


def normalise(odds: Floats) -> Floats:
    """Return probabilities from their logarithms up to a constant."""
    chances = np.exp(odds - odds.max())
    return np.asarray(chances / chances.sum())
