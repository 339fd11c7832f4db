"""Test scores of shifts: drawn scores have the covariance of the tests, and single shifts can be left out."""

import numpy as np
import pytest

from socast.core.diagnose.siblings.shift_scores import ShiftScores

N, K = 14, 3


def make_scores(per_shift=None):
    """Return scores of shifts whose columns were projected off four common columns."""
    rng = np.random.default_rng(4)
    columns, common = rng.standard_normal((N, 30, K)), rng.standard_normal((N, 30, 4))
    root = np.linalg.cholesky(np.linalg.inv(np.einsum("nri,nrj->ij", common, common)))
    factor = np.einsum("nrk,nri->nki", columns, common) @ root
    score = np.zeros((N, K)) if per_shift is None else np.tile(np.array(per_shift, dtype=float)[:, np.newaxis], K)
    return ShiftScores(score, np.einsum("nri,nrj->nij", columns, columns), factor)


def test_drawn_scores_have_their_covariance():
    scores = make_scores()
    drawn = scores.draw(60_000, np.random.default_rng(5)).reshape(60_000, N * K)
    flat = scores.factor.reshape(N * K, -1)
    expected = -flat @ flat.T
    for shift in range(N):
        own = slice(shift * K, (shift + 1) * K)
        expected[own, own] += scores.blocks[shift]
    assert np.cov(drawn.T) == pytest.approx(expected, abs=0.03 * expected.max())


def test_variance_of_a_test_is_its_information():
    scores = make_scores()
    weights = (np.arange(N) >= np.array([[4], [9]])).astype(float)
    found = scores.project(weights)
    drawn = scores.draw(40_000, np.random.default_rng(6))
    tests = weights @ drawn - found.whole_share * drawn.sum(axis=1, keepdims=True)
    assert tests.var(axis=0) == pytest.approx(found.remove_whole()[1], rel=0.04)


def test_absent_candidate_has_no_drawn_score():
    scores = make_scores()
    scores.blocks[3, 1], scores.blocks[3, :, 1], scores.factor[3, 1] = 0.0, 0.0, 0.0
    drawn = scores.draw(10, np.random.default_rng(7))
    assert np.isfinite(drawn).all()
    assert drawn[:, 3, 1] == pytest.approx(0.0)


@pytest.mark.parametrize(
    ("per_shift", "remains"),
    [([5.0] * N, True), ([0.0] * 6 + [80.0] + [0.0] * 7, False), ([-3.0] * 6 + [120.0] + [-3.0] * 7, False)],
    ids=["all shifts", "one shift", "one shift against the others"],
)
def test_deviation_remains_without_any_one_shift_only_if_others_show_it(per_shift, remains):
    least = make_scores(per_shift).test_without_shifts(0, np.ones(N), own_past=False)
    assert (least > 1.645) == remains
