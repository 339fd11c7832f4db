"""Test the measured rows of physical fits: metered windows of rides fit for training, with columns of their ride."""

import numpy as np
import pandas as pd
import pytest

from socast.core.errors import ModelError
from socast.core.fit.measured_rows import RIDE_COLUMNS, join_tables
from socast.core.fit.measurement_noise import is_metered
from tests.support.synthetic_windows import make_tables, make_windows

CARS, DAYS, RIDES, WINDOWS = 3, 6, 3, 8


@pytest.fixture
def tables():
    return make_tables(make_windows(CARS, DAYS, RIDES, WINDOWS))


def of(rides, *keys):
    return rides["ride_key"].isin(keys)


def test_joined_windows_are_ordered_and_have_ride_columns(tables):
    rides, windows = tables
    shuffled = windows.sample(frac=1.0, random_state=3)
    result = join_tables(rides.sample(frac=1.0, random_state=4), shuffled)
    assert len(result) == CARS * DAYS * RIDES * WINDOWS
    assert list(result.index) == list(range(len(result)))
    pd.testing.assert_frame_equal(result, result.sort_values(["vehicle_id", "start_s"], ignore_index=True))
    own = rides.set_index("ride_key").loc[result["ride_key"]]
    for name in RIDE_COLUMNS:
        assert result[name].tolist() == own[name].tolist(), name


def test_ride_columns_take_precedence_over_window_columns(tables):
    rides, windows = tables
    result = join_tables(rides, windows.assign(winter=7))
    assert set(result["winter"]) == {0, 1}


def test_rides_unfit_for_training_or_without_measured_energy_are_left_out(tables):
    rides, windows = tables
    rides.loc[of(rides, "taxi-0#0"), ["fit_for_training", "unfit_reason"]] = False, "too_short"
    rides.loc[of(rides, "taxi-1#1"), "fit_for_training"] = False
    rides.loc[of(rides, "taxi-2#2"), "energy_kwh"] = np.nan
    result = join_tables(rides, windows)
    gone = {"taxi-0#0", "taxi-1#1", "taxi-2#2"}
    assert set(windows["ride_key"]) - set(result["ride_key"]) == gone
    assert len(result) == len(windows) - len(gone) * WINDOWS


def test_windows_without_measured_energy_or_duration_are_left_out(tables):
    rides, windows = tables
    windows.loc[5, ["energy_kwh", "energy_vi_kwh"]] = np.nan
    windows.loc[17, "duration_s"] = 0.0
    result = join_tables(rides, windows)
    assert len(result) == len(windows) - 2
    assert np.isfinite(result["energy_kwh"]).all()
    assert (result["duration_s"] > 0.0).all()


def test_ride_replaces_windows_without_meter(tables):
    rides, windows = tables
    by_charge = windows["vehicle_id"] == "taxi-1"
    for table, rows in ((windows, by_charge), (rides, rides["vehicle_id"] == "taxi-1")):
        table.loc[rows, "energy_kwh"] = table.loc[rows, "energy_soc_kwh"]
        table.loc[rows, "energy_vi_kwh"] = np.nan
    result = join_tables(rides, windows)
    theirs = result[result["vehicle_id"] == "taxi-1"]
    own = rides[rides["vehicle_id"] == "taxi-1"]
    assert theirs["ride_key"].tolist() == own["ride_key"].tolist()
    np.testing.assert_array_equal(theirs["energy_kwh"], own["energy_soc_kwh"])
    np.testing.assert_array_equal(theirs["effect_rolling"], own["effect_rolling"])
    assert not is_metered(theirs).any()
    assert is_metered(result[result["vehicle_id"] != "taxi-1"]).all()
    assert len(result) == len(windows) - by_charge.sum() + len(own)


def test_unmetered_window_of_metered_ride_is_left_out(tables):
    rides, windows = tables
    windows.loc[3, ["energy_kwh", "energy_vi_kwh"]] = windows.loc[3, "energy_soc_kwh"], np.nan
    assert len(join_tables(rides, windows)) == len(windows) - 1


@pytest.mark.parametrize("name", ["ride_key", "vehicle_id", "start_s", "energy_kwh"])
@pytest.mark.parametrize("which", ["ride", "window"])
def test_error_names_missing_column_and_its_table(tables, name, which):
    rides, windows = (
        t.drop(columns=name) if w == which else t for t, w in zip(tables, ("ride", "window"), strict=True)
    )
    with pytest.raises(ModelError, match=f"the {which} table has no column '{name}': make the tables again"):
        join_tables(rides, windows)


def test_tables_of_different_rides_are_refused(tables):
    rides, windows = tables
    with pytest.raises(ModelError, match=r"no window belongs to any of the rides: give the windows\.parquet"):
        join_tables(rides, windows.assign(ride_key="van-" + windows["ride_key"]))
    with pytest.raises(ModelError, match="ride taxi-0#0 is in the ride table twice: give each recording's tables once"):
        join_tables(pd.concat([rides, rides.iloc[:1]]), windows)


def test_windows_without_any_ride_are_refused(tables):
    rides, windows = tables
    with pytest.raises(ModelError, match="no window belongs to any of the rides"):
        join_tables(rides.iloc[:0], windows)


def test_joining_changes_neither_table(tables):
    before = [table.copy(deep=True) for table in tables]
    join_tables(*tables)
    for table, was in zip(tables, before, strict=True):
        pd.testing.assert_frame_equal(table, was)
