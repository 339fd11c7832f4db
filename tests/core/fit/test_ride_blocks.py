"""Test that columns of any type give the same names, numbers and reasons, and that a fit converts each once."""

from collections import Counter
from datetime import date

import numpy as np
import pandas as pd
import pytest

from socast.core.errors import ModelError
from socast.core.fit.fitting import fit_terms
from socast.core.fit.recipes import RECIPES
from socast.core.fit.ride_blocks import (
    RideFrame,
    RideParquet,
    ThinnedRides,
    convert_to_arrays,
    get_names,
    parse_ride_date,
    select_trainable,
)
from tests.support.planted_rides import noisy, physical_energy, rides


@pytest.mark.parametrize(
    ("column", "names"),
    [
        (["b", None, float("nan"), "", "a", "b"], ["b", "", "", "", "a", "b"]),
        (pd.array(["b", pd.NA, "a"], dtype="string"), ["b", "", "a"]),
        (pd.Categorical(["b", None, "a"]), ["b", "", "a"]),
        ([7, 7, 5], ["7", "7", "5"]),
        ([date(2018, 1, 2), None], ["2018-01-02", ""]),
        ([None, None], ["", ""]),
        ([], []),
    ],
)
def test_names_are_text_and_empty_where_unknown(column, names):
    block = pd.DataFrame({"vehicle_id": column})
    assert get_names(block, "vehicle_id") == names
    assert convert_to_arrays(block, [])["vehicle_id"].tolist() == names


def test_names_of_an_absent_column_are_empty():
    block = pd.DataFrame({"lost_m": [1.0, 2.0]})
    assert get_names(block, "date") == ["", ""]
    assert set(convert_to_arrays(block, ["lost_m"])) == {"lost_m"}


def test_arrays_hold_numbers_as_float_and_unknown_ones_as_nan():
    block = pd.DataFrame({"winter": pd.array([1, None], dtype="Int64"), "summer": [0, 1], "lost_m": [1.5, np.nan]})
    arrays = convert_to_arrays(block, list(block))
    np.testing.assert_array_equal(arrays["winter"], [1.0, np.nan])
    np.testing.assert_array_equal(arrays["summer"], [0.0, 1.0])
    np.testing.assert_array_equal(arrays["lost_m"], [1.5, np.nan])
    assert {array.dtype for array in arrays.values()} == {np.dtype(np.float64)}


@pytest.mark.parametrize("text", ["0000-99-99\0", "", "nan", "2018-11-20T00:00"])
def test_date_that_is_none_is_refused(text):
    assert parse_ride_date("2018-11-20") == date(2018, 11, 20)
    with pytest.raises(ModelError, match=r"column 'date' of the ride table holds .*, no date such as 2018-11-20"):
        parse_ride_date(text)


def test_text_in_a_column_of_numbers_is_refused():
    with pytest.raises(ModelError, match="column 'lost_m' of the ride table is no number"):
        convert_to_arrays(pd.DataFrame({"lost_m": ["steep"]}), ["lost_m"])


@pytest.mark.parametrize("index", [range(5), [9, 9, 3, 3, 0]])
def test_rides_are_left_out_by_their_own_reason(index):
    block = pd.DataFrame(
        {
            "energy_kwh": [1.0, np.nan, 1.0, np.nan, 2.0],
            "effect_rolling": [1.0, 1.0, np.nan, 1.0, 1.0],
            "fit_for_training": pd.array([False, False, True, True, None], dtype="boolean"),
            "unfit_reason": ["too_short", None, "", "", None],
        },
        index=index,
    )
    good, left_out = select_trainable(block, ["effect_rolling"])
    assert left_out == Counter(too_short=1, unfit=2, unknown_vehicle_or_effect=1, no_measured_energy=1)
    assert good.empty
    good, left_out = select_trainable(block.iloc[2:].drop(columns=["unfit_reason", "fit_for_training"]), [])
    assert good["energy_kwh"].tolist() == [1.0, 2.0]
    assert left_out == Counter(no_measured_energy=1)


def test_fit_converts_each_column_of_a_block_once_for_all_vehicle_models(monkeypatch):
    table = rides(600, seed=3)
    table = noisy(table, physical_energy(table, {}))
    read = pd.DataFrame.__getitem__
    columns: Counter[str] = Counter()

    def count(frame, key):
        if isinstance(key, str):
            columns[key] += 1
        return read(frame, key)

    def count_reads(rides) -> Counter[str]:
        columns.clear()
        fit_terms(RECIPES["fitted_physical"], RideFrame(rides))
        return columns.copy()

    monkeypatch.setattr(pd.DataFrame, "__getitem__", count)
    assert len(set(table["vehicle_model"])) > 1
    several = count_reads(table)
    assert several == count_reads(table.assign(vehicle_model="one"))
    assert several["duration_s"] == 1  # later passes read the converted rides


@pytest.mark.parametrize(("most", "step"), [(20_000, 1), (10_000, 2), (9_999, 3)])
def test_thinned_rides_pass_all_rides_on_and_keep_every_kth_across_files(most, step, tmp_path):
    table = pd.DataFrame({"lost_m": np.arange(20_000.0), "distance_km": 1.0, "vehicle_id": "taxi-001"})
    table[:9_001].to_parquet(tmp_path / "a.parquet")
    table[9_001:].drop(columns="distance_km").to_parquet(tmp_path / "b.parquet")
    rides = ThinnedRides(RideParquet((tmp_path / "a.parquet", tmp_path / "b.parquet")), most, ["distance_km", "absent"])
    for _ in range(2):
        passed = pd.concat(rides.blocks(["lost_m"]), ignore_index=True)
        np.testing.assert_array_equal(passed["lost_m"], table["lost_m"])
        kept = rides.table()
        assert set(kept) == {"lost_m", "distance_km", "vehicle_id"}
        np.testing.assert_array_equal(kept["lost_m"], table["lost_m"][::step])
        assert int(kept["distance_km"].notna().sum()) == len(table[:9_001:step])


def test_thinned_rides_of_an_unreadable_file_are_refused(tmp_path):
    (tmp_path / "rides.parquet").write_text("no table")
    with pytest.raises(ModelError, match=r"rides\.parquet: no Parquet table"):
        ThinnedRides(RideParquet((tmp_path / "rides.parquet",)), 10, [])
