"""Test that trees predict by name and row by row, survive their file, and are refused where they are damaged."""

import msgspec
import numpy as np
import pandas as pd
import pytest
from threadpoolctl import threadpool_limits

from socast.core.errors import ModelError
from socast.core.fit.trees import fit_trees
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
