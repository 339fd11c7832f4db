"""Test that exported trees answer as the fitted ones, are small, and predict as well as scikit-learn's booster."""

from itertools import pairwise

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.ensemble import HistGradientBoostingRegressor
from threadpoolctl import threadpool_limits

from socast.core.fit import trees as fitting
from socast.core.fit.trees import (
    LEARNING_RATE,
    LEAVES,
    SHRINKAGE,
    TREES,
    assign_bins,
    boost,
    compute_bin_edges,
    fit_trees,
)
from socast.core.models.trees import LEAF, Trees
from tests.support.tree_features import NAMES, answers, features

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def one_thread():
    """Limit the linear algebra to one thread, as threads that wait for each other are far slower."""
    with threadpool_limits(1):
        yield


@pytest.fixture(scope="module")
def fitted() -> Trees:
    table = features(1500, 1)
    return fit_trees(table, NAMES, answers(table, 1), np.ones(1500), per="distance_km")


def _bins(table, edges):
    """Return the bin of each feature, as the trees are fitted to it."""
    return np.column_stack([assign_bins(*each) for each in zip(table.T, edges, strict=True)]).astype(np.float32)


@settings(max_examples=6, deadline=None)
@given(seed=st.integers(0, 10_000), unknown=st.sampled_from([0.0, 0.05, 0.6]))
def test_exported_trees_answer_as_scikit_learns_trees_on_bins(seed, unknown):
    """Apply the fitted estimators to bins, and the exported trees to the features of the same and of other rides."""
    table = features(600, seed, unknown)
    target, weight = answers(table, seed), np.random.default_rng(seed).uniform(0.5, 2.0, 600)
    exported = fit_trees(table, NAMES, target, weight)
    edges = [compute_bin_edges(column) for column in table.T]
    grown = boost(_bins(table, edges), target - np.average(target, weights=weight), weight / weight.mean())
    inputs = np.concatenate([table, features(300, seed + 7, 0.3), features(20, seed + 9) * 1e6])
    expected = np.full(len(inputs), exported.baseline)
    for tree, answer in grown:
        expected += answer[tree.tree_.apply(_bins(inputs, edges))]
    np.testing.assert_allclose(exported.sum_leaves(inputs), expected, rtol=0.0, atol=1e-12)


def test_values_on_edges_of_bins_go_to_the_same_side_as_in_training():
    table = np.repeat(np.arange(10.0), 60)[:, np.newaxis]
    target = np.where(table[:, 0] >= 5.0, 1.0, 0.0)
    exported = fit_trees(table, NAMES[:1], target, np.ones(600))
    (edge,) = {bound for bound in exported.threshold if 4.0 < bound < 5.0}
    at, above = exported.sum_leaves(np.array([[edge], [np.nextafter(edge, 9.0)]]))
    assert at == exported.sum_leaves(np.array([[4.0]]))[0]
    assert above == exported.sum_leaves(np.array([[5.0]]))[0]


def test_leaf_is_shrunk_mean_of_weighted_residual():
    table = np.repeat([0.0, 1.0], [100, 50])[:, np.newaxis]
    target, weight = np.repeat([-1.0, 2.0], [100, 50]), np.repeat([1.0, 2.0], [100, 50])
    (tree, answer), *_ = boost(table.astype(np.float32), target, weight)
    leaves = answer[tree.tree_.apply(np.array([[0.0], [1.0]], dtype=np.float32))]
    expected = LEARNING_RATE * np.array([-100.0 / (100.0 + SHRINKAGE), 200.0 / (100.0 + SHRINKAGE)])
    np.testing.assert_allclose(leaves, expected, rtol=1e-12)


@pytest.mark.parametrize("rides", [2000, 2 * fitting._SEARCHED_RIDES])
def test_trees_predict_other_rides_as_well_as_histogram_booster(rides):
    """Compare with the library's own booster at equal settings, on rides that neither has seen."""
    train, test = features(rides, 11), features(3000, 12)
    edges = [compute_bin_edges(column) for column in train.T]
    mine = fit_trees(train, NAMES, answers(train, 11), np.ones(rides))
    booster = HistGradientBoostingRegressor(
        max_iter=TREES, learning_rate=LEARNING_RATE, max_leaf_nodes=LEAVES, l2_regularization=SHRINKAGE,
        min_samples_leaf=fitting._LEAST_LEAF_RIDES, max_bins=fitting._BINS, early_stopping=False,
    ).fit(_bins(train, edges), answers(train, 11))  # fmt: skip
    predictions = mine.sum_leaves(test), booster.predict(_bins(test, edges))
    errors = [np.std(answers(test, 12) - predicted) for predicted in predictions]
    assert errors[0] < 1.02 * errors[1]


def test_feature_unknown_only_in_prediction_follows_most_rides_of_training():
    table = np.repeat([0.0, 1.0], [300, 100])[:, np.newaxis]
    exported = fit_trees(table, NAMES[:1], table[:, 0], np.ones(400))
    unknown, most = exported.sum_leaves(np.array([[np.nan], [0.0]]))
    assert unknown == most


def test_feature_that_is_known_or_unknown_splits_and_survives_the_file():
    table = np.where(np.random.default_rng(0).random((400, 1)) < 0.5, np.nan, 5.0)
    target = np.isnan(table[:, 0]) * 1.0
    exported = fit_trees(table, NAMES[:1], target, np.ones(400))
    assert msgspec.json.decode(msgspec.json.encode(exported), type=Trees) == exported
    assert abs(exported.sum_leaves(table) - target).max() < 0.1


def test_target_without_structure_grows_no_trees():
    table = features(60, 5)
    exported = fit_trees(table, NAMES, np.ones(60), np.ones(60))
    assert (exported.features, exported.roots, exported.baseline) == ((), (), 1.0)


def test_equal_rides_give_equal_trees(fitted):
    table = features(1500, 1)
    assert fit_trees(table, NAMES, answers(table, 1), np.ones(1500), per="distance_km") == fitted


def test_planted_relation_is_learned(fitted):
    table = features(1500, 2)
    truth = answers(table, 2)
    left = truth - fitted.sum_leaves(table)
    assert np.std(left) < 0.6 * np.std(truth)


def test_trees_are_few_and_small(fitted):
    assert len(fitted.roots) <= TREES
    edges = [*fitted.roots, len(fitted.feature)]
    leaves = [fitted.feature[a:b].count(LEAF) for a, b in pairwise(edges)]
    assert max(leaves) <= LEAVES


def test_features_without_information_are_left_out():
    table = features(300, 8, unknown=0.0)
    table[:, 1], table[:, 2] = np.nan, 7.0
    trees = fit_trees(table, NAMES, answers(table, 8), np.ones(300))
    assert trees.features == ("ambient_c", "occupants")


def test_trees_answer_the_mean_without_informative_features():
    trees = fit_trees(np.full((50, 4), np.nan), NAMES, np.arange(50.0), np.ones(50))
    assert (trees.features, trees.roots, trees.baseline) == ((), (), 24.5)
    assert trees.sum_leaves(np.empty((3, 0))).tolist() == [24.5] * 3


def test_rides_with_small_weight_have_little_influence():
    table = features(400, 9, unknown=0.0)
    target = np.where(np.arange(400) % 2 == 0, 1.0, 3.0)
    trees = fit_trees(table, NAMES, target, np.where(target == 1.0, 1.0, 1e-6))
    assert abs(trees.sum_leaves(table) - 1.0).max() < 0.05
