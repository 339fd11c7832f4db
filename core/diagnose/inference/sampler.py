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
from typing import Final, NamedTuple

import numpy as np

from socast.core.batch import Floats, Ints
from socast.core.diagnose.inference.alternatives import Alternatives, log_share_within

SWEEPS: Final = 120
"""Number of sweeps over all families."""
BURNT: Final = 20
"""Number of sweeps at the beginning that do not count."""
MOST_KEPT: Final = 1024
"""Largest number of sets whose odds are kept, as most sets come again."""


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


def sample_alternatives(given: Alternatives, seed: int = 0) -> Sample:
    """Return the probability of each alternative, and the set that is most often true together."""
    rng = np.random.default_rng(seed)
    rows = {family: np.flatnonzero(given.family == family) for family in sorted(set(given.family.tolist()))}
    state: dict[int, int | None] = dict.fromkeys(rows)
    total = np.zeros(len(given.family))
    sets: Counter[tuple[int, ...]] = Counter()

    every, kept = np.arange(len(given.family)), dict[tuple[int, ...], Floats]()

    def weigh(without: int) -> Floats:
        """Return the odds of each alternative beside what is true in other families than one."""
        others = tuple(at for family, at in state.items() if at is not None and family != without)
        if others not in kept:
            if len(kept) >= MOST_KEPT:
                kept.clear()
            kept[others] = weigh_further(given, list(others), every) + given.log_odds
        return kept[others]

    for sweep in range(SWEEPS):
        for family in rng.permutation(list(rows)).tolist():
            odds = weigh(family)[rows[family]]
            chances = normalise(np.append(odds, 0.0))
            drawn = int(rng.choice(len(chances), p=chances))
            state[family] = None if drawn == len(odds) else int(rows[family][drawn])
            if sweep >= BURNT:
                total[rows[family]] += chances[:-1]
        for family in [family for family, at in state.items() if at is not None]:  # one moves to any free family
            open_rows = np.concatenate([rows[each] for each in rows if each == family or state[each] is None])
            odds = weigh(family)[open_rows]
            drawn = int(rng.choice(open_rows, p=normalise(odds)))
            state[family] = None
            state[int(given.family[drawn])] = drawn
        if sweep >= BURNT:
            sets[tuple(sorted(int(given.family[at]) for at in state.values() if at is not None))] += 1
    chances = total / (SWEEPS - BURNT)
    most = max(sets, key=lambda families: (sets[families], families)) if sets else ()
    return Sample(chances, {family: int(rows[family][np.argmax(chances[rows[family]])]) for family in most})


def normalise(odds: Floats) -> Floats:
    """Return probabilities from their logarithms up to a constant."""
    chances = np.exp(odds - odds.max())
    return np.asarray(chances / chances.sum())
