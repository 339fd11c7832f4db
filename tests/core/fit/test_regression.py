"""Test that blockwise normal equations give least squares over all rows, and intervals of nominal coverage."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.linear_model import LinearRegression

from socast.core.fit.regression import GROUPS, ClusterScores, Influence, Moments, assign_groups, solve, sum_scores


def moments_of(*blocks) -> Moments:
    moments = Moments(blocks[0].shape[1])
    for block in blocks:
        moments.merge(Moments.of(block))
    return moments


def table(seed: int, rows: int = 200, width: int = 4) -> np.ndarray:
    """Return columns of very different sizes, far from zero, and last the column that they explain."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(rows, width)) * 10.0 ** np.arange(-3, width - 3) + 10.0 ** np.arange(width)
    y = 5.0 + x @ 10.0 ** -np.arange(-3.0, width - 3.0) + rng.normal(size=rows)
    return np.column_stack([x, y])


@given(st.integers(0, 2**32), st.lists(st.integers(0, 200), max_size=5))
def test_moments_do_not_depend_on_the_division_into_blocks(seed, cuts):
    whole = table(seed)
    edges = [0, *sorted(cuts), len(whole)]
    moments = moments_of(*(whole[a:b] for a, b in pairwise(edges)))
    assert moments.rows == len(whole)
    np.testing.assert_allclose(moments.mean, whole.mean(axis=0), rtol=1e-12)
    scale = np.sqrt(np.outer(np.diag(moments.scatter), np.diag(moments.scatter)))
    np.testing.assert_allclose(moments.scatter / scale, np.cov(whole.T) * (len(whole) - 1) / scale, atol=1e-11)


def test_large_means_do_not_reduce_precision():
    rng = np.random.default_rng(1)
    x = 1e9 + rng.normal(size=2000)
    y = 3.0 * (x - 1e9) + rng.normal(size=2000)
    blocks = np.array_split(np.column_stack([x, y]), 7)
    solution = solve(moments_of(*blocks), constant=True)
    expected = np.polyfit(x - 1e9, y, 1)
    assert solution.coefficients[0] == pytest.approx(expected[0], rel=1e-6)


@pytest.mark.parametrize("constant", [True, False])
def test_solution_equals_that_of_scikit_learn(constant):
    whole = table(3)
    if not constant:  # otherwise each column is constant within a thousandth, and all count as collinear
        whole[:, :-1] -= 10.0 ** np.arange(4)
    solution = solve(moments_of(*np.array_split(whole, 5)), constant=constant)
    expected = LinearRegression(fit_intercept=constant).fit(whole[:, :-1], whole[:, -1])
    np.testing.assert_allclose(solution.coefficients, expected.coef_, rtol=1e-6)
    assert (solution.constant or 0.0) == pytest.approx(expected.intercept_, rel=1e-6)
    left = whole[:, -1] - expected.predict(whole[:, :-1])
    assert solution.residual == pytest.approx(left @ left, rel=1e-6)
    assert solution.rank == 4
    assert solution.freedom == 196 - constant


def test_collinear_columns_share_coefficients_equally_and_predict_the_same():
    rng = np.random.default_rng(5)
    winter = (rng.random(500) < 0.25).astype(float)
    parts = rng.random((500, 6))
    whole = parts.sum(axis=1)
    y = 1.0 + 0.5 * winter + parts @ np.arange(6.0) + 0.01 * rng.normal(size=500)
    x = np.column_stack([winter, 1.0 - winter, parts, whole])
    solution = solve(moments_of(np.column_stack([x, y])), constant=True)
    least = solve(moments_of(np.column_stack([winter, parts, y])), constant=True)
    assert solution.rank == least.rank == 7
    assert solution.coefficients[0] == pytest.approx(-solution.coefficients[1], rel=1e-6)
    assert np.abs(solution.coefficients).max() < 6.0
    fresh = rng.random((50, 6))
    seasons = (rng.random(50) < 0.5).astype(float)
    full = np.column_stack([seasons, 1.0 - seasons, fresh, fresh.sum(axis=1)])
    one = full @ solution.coefficients + solution.constant
    other = np.column_stack([seasons, fresh]) @ least.coefficients + least.constant
    np.testing.assert_allclose(one, other, atol=1e-9)


@pytest.mark.parametrize("value", [0.0, 27.0, -1e6, 1e-9])
def test_constant_column_has_no_influence(value):
    whole = table(7)
    with_it = np.insert(whole, 2, value, axis=1)
    solution = solve(moments_of(*np.array_split(with_it, 3)), constant=True)
    without = solve(moments_of(whole), constant=True)
    assert solution.coefficients[2] == 0.0
    np.testing.assert_allclose(np.delete(solution.coefficients, 2), without.coefficients, rtol=1e-9)
    assert solution.rank == without.rank


def test_weight_acts_as_one_more_observation_of_a_coefficient():
    whole = table(9)
    weight, toward = np.array([0.0, 4.0, 0.0, 0.0]), np.array([0.0, 7.0, 0.0, 0.0])
    pulled = solve(moments_of(whole), constant=False, weight=weight, toward=toward)
    row = np.array([[0.0, 2.0, 0.0, 0.0, 14.0]])
    seen = solve(moments_of(whole, row), constant=False)
    np.testing.assert_allclose(pulled.coefficients, seen.coefficients, rtol=1e-8)


def covered(seed: int, *, robust: bool) -> np.ndarray:
    """Return whether the 95 % interval of each planted coefficient, and of the constant, contains it."""
    rng = np.random.default_rng(seed)
    cars, days, each = 15, 12, 6
    car, day = np.repeat(np.arange(cars), days * each), np.tile(np.repeat(np.arange(days), each), cars)
    n = len(car)
    shared = rng.normal(size=(cars, days))[car, day] if robust else 0.0
    x = np.column_stack([rng.normal(2.0, 1.0, n), rng.normal(size=(cars, days))[car, day], rng.random(n)])
    y = x @ [1.0, -2.0, 0.5] + 3.0 + rng.normal(size=n) * (x[:, 0] if robust else 1.0) + shared
    moments = moments_of(*np.array_split(np.column_stack([x, y]), 4))
    solution = solve(moments, constant=True)
    influence = Influence(moments, solution)
    covariance = influence.classical()
    if robust:
        left = (y - x @ solution.coefficients - solution.constant) / (1.0 - influence.leverage(x - influence.mean))
        scores = ClusterScores(len(influence.mean) + 1)
        group = assign_groups([f"c{i}" for i in car], [f"d{i}" for i in day])
        for part in np.array_split(np.arange(n), 5):
            scores.add(sum_scores(x[part] - influence.mean, left[part], group[part], constant=True))
        covariance = influence.robust(scores)
    z = (np.array([*solution.coefficients, solution.constant]) - [1.0, -2.0, 0.5, 3.0]) / np.sqrt(np.diag(covariance))
    return np.abs(z) < 1.96


@pytest.mark.parametrize("robust", [False, True])
def test_intervals_cover_planted_coefficients_at_the_nominal_level(robust):
    held = np.array([covered(seed, robust=robust) for seed in range(300)])
    assert 0.93 <= held.mean() <= 0.97
    assert (held.mean(axis=0) >= 0.90).all()
    assert (held.mean(axis=0) <= 0.98).all()


def test_robust_covariance_accounts_for_errors_shared_within_a_day():
    """The classical covariance is far too small for a column that varies only by day."""
    rng = np.random.default_rng(2)
    by_day = np.repeat(rng.normal(size=60), 20)
    y = np.repeat(rng.normal(size=60), 20) + 0.1 * rng.normal(size=1200)
    moments = moments_of(np.column_stack([by_day, y]))
    solution = solve(moments, constant=True)
    influence = Influence(moments, solution)
    scores = ClusterScores(len(influence.mean) + 1)
    left = y - by_day * solution.coefficients[0] - solution.constant
    days = np.repeat(np.arange(60), 20)
    scores.add(sum_scores(by_day[:, np.newaxis] - influence.mean, left, days, constant=True))
    assert influence.robust(scores)[0, 0] > 8.0 * influence.classical()[0, 0]


def test_classical_covariance_equals_the_textbook_formula():
    whole = table(11)
    moments = moments_of(whole)
    solution = solve(moments, constant=True)
    design = np.column_stack([whole[:, :-1], np.ones(len(whole))])
    expected = np.linalg.inv(design.T @ design) * solution.variance
    np.testing.assert_allclose(Influence(moments, solution).classical(), expected, rtol=1e-5)


def test_rides_of_one_car_and_day_share_a_group():
    keys = [("a", "1"), ("b", "1"), ("a", "2"), ("a", "1")]
    cars, days = zip(*keys, strict=True)
    group = assign_groups(cars, days)
    assert group[0] == group[3]
    assert len(set(group.tolist())) == 3
    assert (group < GROUPS).all()
    assert assign_groups(cars[2:], days[2:]).tolist() == group[2:].tolist()
