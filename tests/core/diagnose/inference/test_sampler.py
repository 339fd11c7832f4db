"""The sampler gives the probabilities that counting every set of alternatives gives."""

from itertools import product

import numpy as np
import pytest

from socast.core.diagnose.inference.alternatives import Alternatives
from socast.core.diagnose.inference.sampler import sample_alternatives, weigh_further

SIZES = (3, 2, 2, 1)
"""Numbers of alternatives of each family."""


def draw_alternatives(seed: int, *, positive: bool = False, strength: float = 2.0) -> Alternatives:
    """Return alternatives of some families whose columns are correlated."""
    rng = np.random.default_rng(seed)
    k = sum(SIZES)
    columns = rng.normal(size=(40, k)) + rng.normal(size=(40, 1))
    y = strength * columns[:, 0] * 0.2 + rng.normal(size=40)
    family = np.repeat(np.arange(len(SIZES)), SIZES)
    return Alternatives(
        family=family,
        effect=np.arange(k),
        place=np.zeros(k, dtype=np.int64),
        size=np.ones(k),
        positive=np.full(k, positive),
        log_odds=np.full(k, -1.5),
        weight=np.ones((k, 1)),
        own=columns.T @ columns,
        match=columns.T @ y,
        identified=frozenset(),
    )


def weigh_set(given: Alternatives, chosen: list[int]) -> float:
    """Return the log evidence of a set against none by its determinant and its inverse."""
    if not chosen:
        return 0.0
    precise = given.own[np.ix_(chosen, chosen)] + np.eye(len(chosen))
    match = given.match[chosen]
    return float(0.5 * match @ np.linalg.solve(precise, match) - 0.5 * np.linalg.slogdet(precise)[1])


def count_all(given: Alternatives) -> np.ndarray:
    """Return the probability of each alternative by going through all sets."""
    rows = [[None, *np.flatnonzero(given.family == family)] for family in range(len(SIZES))]
    total, chance = 0.0, np.zeros(len(given.family))
    for picked in product(*rows):
        chosen = [int(at) for at in picked if at is not None]
        weight = np.exp(weigh_set(given, chosen) + given.log_odds[chosen].sum())
        total += weight
        chance[chosen] += weight
    return chance / total


@pytest.mark.parametrize("seed", range(4))
def test_further_evidence_is_the_difference_of_two_sets(seed):
    given = draw_alternatives(seed)
    rows = np.array([5, 6, 7])
    for chosen in ([], [1], [0, 3]):
        expected = [weigh_set(given, [*chosen, at]) - weigh_set(given, chosen) for at in rows.tolist()]
        np.testing.assert_allclose(weigh_further(given, chosen, rows), expected, atol=1e-9)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("strength", [0.0, 2.0])
def test_probabilities_are_those_of_all_sets(seed, strength):
    given = draw_alternatives(seed, strength=strength)
    np.testing.assert_allclose(sample_alternatives(given, seed).chances, count_all(given), atol=0.08)


def test_at_most_one_alternative_of_a_family_is_true():
    chance = sample_alternatives(draw_alternatives(1)).chances
    assert all(chance[draw_alternatives(1).family == family].sum() <= 1.0 + 1e-9 for family in range(len(SIZES)))


def test_coefficient_of_the_wrong_sign_is_improbable():
    given = draw_alternatives(2)
    negative, either = (
        Alternatives(**{**vars(given), "match": -given.match, "positive": np.full(len(given.family), positive)})
        for positive in (True, False)
    )
    assert sample_alternatives(negative).chances.sum() < 0.5 * sample_alternatives(either).chances.sum()


def test_effect_of_all_cars_is_found_from_a_start_in_single_cars():
    """One effect in four cars is one effect in all, and not four that happen to be the same."""
    rng = np.random.default_rng(3)
    column = rng.normal(size=400)
    parts = [np.where(np.arange(400) // 100 == car, column, 0.0) for car in range(4)]
    columns = np.column_stack([column, *parts])
    given = Alternatives(
        **{
            **vars(draw_alternatives(0)),
            "family": np.arange(5),
            "effect": np.zeros(5, dtype=np.int64),
            "place": np.zeros(5, dtype=np.int64),
            "size": np.ones(5),
            "positive": np.zeros(5, dtype=np.bool_),
            "log_odds": np.log([0.1 / 0.9, *[0.01 / 0.99] * 4]),
            "weight": np.ones((5, 1)),
            "own": 100.0 * columns.T @ columns,
            "match": 100.0 * columns.T @ column,
        }
    )
    for seed in range(8):
        chance = sample_alternatives(given, seed).chances
        assert chance[0] > 0.95
        assert chance[1:].max() < 0.2
