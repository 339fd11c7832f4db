"""Test that exported trees predict as scikit-learn, that fitted trees are small, and that damaged ones are refused."""

from itertools import pairwise

import msgspec
import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.ensemble import HistGradientBoostingRegressor
from threadpoolctl import threadpool_limits

from core.errors import ModelError
from core.fit.trees import LEAVES, TREES, export_trees, fit_trees, make_booster
from core.models.trees import LEAF, Trees

pytestmark = pytest.mark.usefixtures("one_thread")
NAMES = ("ambient_c", "duration_s", "stops", "occupants")


@pytest.fixture(scope="module")
def one_thread():
    """Limit the linear algebra to one thread, as threads that wait for each other are far slower."""
    with threadpool_limits(1):
        yield


def features(rows: int, seed: int, unknown: float = 0.1) -> np.ndarray:
    """Return features of very different size, some of them unknown."""
    random = np.random.default_rng(seed)
    table = random.normal(size=(rows, len(NAMES))) * [10.0, 1e6, 1e-6, 1.0]
    table[:, 3] = np.round(table[:, 3])
    table[random.random(table.shape) < unknown] = np.nan
    return table


def answers(table: np.ndarray, seed: int) -> np.ndarray:
    random = np.random.default_rng(seed + 1)
    known = np.nan_to_num(table)
    return (
        np.where(known[:, 0] > 3.0, 2.0, 0.0) * known[:, 3]
        + np.isnan(table[:, 1])
        + random.normal(0.0, 0.3, len(table))
    )


@settings(max_examples=8, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    unknown=st.sampled_from([0.0, 0.05, 0.6]),
    loss=st.sampled_from(["squared_error", "absolute_error"]),
)
def test_exported_trees_predict_as_scikit_learn(seed, unknown, loss):
    table = features(600, seed, unknown)
    model = HistGradientBoostingRegressor(loss=loss, max_iter=15, min_samples_leaf=5, random_state=0)
    model.fit(table, answers(table, seed))
    inputs = np.concatenate([table, features(300, seed + 7, 0.3), features(20, seed + 9) * 1e6])
    trees = export_trees(model, NAMES)
    np.testing.assert_allclose(trees.sum_leaves(inputs), model.predict(inputs), rtol=0.0, atol=1e-10)


def test_feature_unknown_only_in_prediction_follows_scikit_learn():
    table = features(500, 3, unknown=0.0)
    model = make_booster().fit(table, answers(table, 3))
    table[::3, 0] = np.nan
    np.testing.assert_allclose(export_trees(model, NAMES).sum_leaves(table), model.predict(table), atol=1e-10)


def test_infinite_threshold_survives_the_file():
    table = np.where(np.random.default_rng(0).random((400, 1)) < 0.5, np.nan, 5.0)
    target = np.isnan(table[:, 0]) * 1.0
    model = make_booster().fit(table, target)
    trees = export_trees(model, NAMES[:1])
    assert msgspec.json.decode(msgspec.json.encode(trees), type=Trees) == trees
    np.testing.assert_allclose(trees.sum_leaves(table), model.predict(table), atol=1e-10)
    assert abs(trees.sum_leaves(table) - target).max() < 0.1


@pytest.fixture(scope="module")
def fitted() -> Trees:
    table = features(1500, 1)
    return fit_trees(table, NAMES, answers(table, 1), np.ones(1500), per="distance_km")


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


def test_prediction_reads_columns_by_name_and_multiplies_by_the_per_column(fitted):
    table = features(50, 5)
    columns = pd.DataFrame(table, columns=list(NAMES)).assign(distance_km=np.arange(50.0), other=1.0)
    assert fitted.needs == (*fitted.features, "distance_km")
    assert fitted.predict(columns).tobytes() == (fitted.sum_leaves(table) * np.arange(50.0)).tobytes()


def test_prediction_of_a_row_does_not_depend_on_other_rows(fitted):
    columns = pd.DataFrame(features(40, 6), columns=list(NAMES)).assign(distance_km=3.0)
    one_by_one = np.concatenate([fitted.predict(columns.iloc[i : i + 1]) for i in range(40)])
    assert one_by_one.tobytes() == fitted.predict(columns).tobytes()


def test_missing_column_is_refused_by_name(fitted):
    with pytest.raises(ModelError, match="column 'stops' is missing"):
        fitted.predict({name: np.ones(3) for name in (*NAMES, "distance_km") if name != "stops"})


def test_trees_survive_their_file_exactly(fitted):
    again = msgspec.json.decode(msgspec.json.encode(fitted), type=Trees)
    assert again == fitted
    table = features(100, 4)
    assert again.sum_leaves(table).tobytes() == fitted.sum_leaves(table).tobytes()


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


GOOD = {
    "features": ("ambient_c",),
    "baseline": 0.0,
    "roots": (0,),
    "feature": (0, LEAF, LEAF),
    "threshold": (1.0, 0.0, 0.0),
    "left": (1, 0, 0),
    "right": (2, 0, 0),
    "missing_left": (1, 0, 0),
    "value": (0.0, -1.0, 1.0),
}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"value": (0.0, 1.0)}, "arrays of"),
        ({"roots": (3,)}, "roots are not among"),
        ({"feature": (1, LEAF, LEAF)}, "compares feature 1 of 1"),
        ({"left": (0, 0, 0)}, "not to later nodes"),
        ({"right": (7, 0, 0)}, "not to later nodes"),
        ({"value": (0.0, float("nan"), 1.0)}, "not finite"),
        ({"baseline": float("inf")}, "not finite"),
    ],
)
def test_malformed_trees_are_refused(change, message):
    assert Trees(**GOOD).sum_leaves(np.array([[0.5], [1.0], [1.5], [np.nan]])).tolist() == [-1.0, -1.0, 1.0, -1.0]
    with pytest.raises(ValueError, match=message):
        Trees(**(GOOD | change))
    raw = {key: list(value) if isinstance(value, tuple) else value for key, value in (GOOD | change).items()}
    with pytest.raises(msgspec.ValidationError, match=message):
        msgspec.convert(raw, Trees)
