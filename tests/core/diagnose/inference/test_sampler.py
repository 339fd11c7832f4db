"""The sampler gives the probabilities that counting every set of alternatives gives."""

from dataclasses import replace
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
        limits=np.tile([[0.0 if positive else -np.inf], [np.inf]], k),
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
    limits = np.tile([[-np.inf], [np.inf]], len(given.family))
    either = replace(given, match=-given.match, limits=limits)
    negative = replace(either, limits=np.maximum(limits, 0.0))
    assert sample_alternatives(negative).chances.sum() < 0.5 * sample_alternatives(either).chances.sum()


def test_alternative_that_must_be_implausibly_large_leaves_its_place_to_another():
    """Two columns are nearly one, but only the second has a coefficient within its range."""
    column = np.random.default_rng(5).normal(size=400)
    columns = np.column_stack([column, column + 0.1 * np.random.default_rng(6).normal(size=400)])
    given = replace(
        draw_alternatives(0),
        family=np.arange(2),
        limits=np.array([[0.0, 0.0], [0.5, 2.0]]),
        log_odds=np.full(2, -1.5),
        own=columns.T @ columns,
        match=columns.T @ column,
    )
    plausible, free = (
        sample_alternatives(each).chances for each in (given, replace(given, limits=np.array([[0.0] * 2, [2.0] * 2])))
    )
    assert free[0] > 0.7 > 0.3 > free[1]
    assert plausible[1] > 0.9 > plausible[0]


def test_effect_of_all_cars_is_found_from_a_start_in_single_cars():
    """One effect in four cars is one effect in all, and not four that happen to be the same."""
    rng = np.random.default_rng(3)
    column = rng.normal(size=400)
    parts = [np.where(np.arange(400) // 100 == car, column, 0.0) for car in range(4)]
    columns = np.column_stack([column, *parts])
    given = replace(
        draw_alternatives(0),
        family=np.arange(5),
        limits=np.tile([[-np.inf], [np.inf]], 5),
        log_odds=np.log([0.1 / 0.9, *[0.01 / 0.99] * 4]),
        own=100.0 * columns.T @ columns,
        match=100.0 * columns.T @ column,
    )
    for seed in range(8):
        chance = sample_alternatives(given, seed).chances
        assert chance[0] > 0.95
        assert chance[1:].max() < 0.2
