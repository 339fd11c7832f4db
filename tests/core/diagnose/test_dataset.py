"""Test the windows to diagnose: metered windows of rides fit for training, with the properties of their ride."""

import msgspec
import numpy as np
import pandas as pd
import pytest

from core.diagnose.dataset import (
    LEAST_DAYS,
    LEAST_RIDES,
    RIDE_COLUMNS,
    fit_to_windows,
    gather_windows,
    join_tables,
)
from core.errors import ModelError
from core.fit.measurement_noise import is_metered
from tests.support.synthetic_windows import make_tables, make_windows

CARS, DAYS, RIDES, WINDOWS = 3, 6, 3, 8


@pytest.fixture
def tables():
    return make_tables(make_windows(CARS, DAYS, RIDES, WINDOWS))


@pytest.fixture(scope="module")
def model():
    return fit_to_windows("road_load", *make_tables(make_windows(CARS, DAYS, RIDES, WINDOWS)))


def of(rides, *keys):
    return rides["ride_key"].isin(keys)


def test_joined_windows_are_ordered_and_have_ride_columns(tables):
    rides, windows = tables
    shuffled = windows.sample(frac=1.0, random_state=3)
    result = join_tables(rides.sample(frac=1.0, random_state=4), shuffled)
    assert len(result) == CARS * DAYS * RIDES * WINDOWS
    assert list(result.index) == list(range(len(result)))
    pd.testing.assert_frame_equal(result, result.sort_values(["vehicle_id", "start_s"], ignore_index=True))
    of_ride = rides.set_index("ride_key").loc[result["ride_key"]]
    for name in RIDE_COLUMNS:
        assert result[name].tolist() == of_ride[name].tolist(), name


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
    of_car = rides[rides["vehicle_id"] == "taxi-1"]
    assert theirs["ride_key"].tolist() == of_car["ride_key"].tolist()
    np.testing.assert_array_equal(theirs["energy_kwh"], of_car["energy_soc_kwh"])
    np.testing.assert_array_equal(theirs["effect_rolling"], of_car["effect_rolling"])
    assert not is_metered(theirs).any()
    assert is_metered(result[result["vehicle_id"] != "taxi-1"]).all()
    assert len(result) == len(windows) - by_charge.sum() + len(of_car)


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


def test_joining_changes_neither_table(tables):
    before = [table.copy(deep=True) for table in tables]
    join_tables(*tables)
    for table, was in zip(tables, before, strict=True):
        pd.testing.assert_frame_equal(table, was)


class TestGather:
    def test_codes_and_sums_match_table(self, tables, model):
        result = gather_windows(*tables, model)
        table = result.table
        assert len(result.rides) == CARS * DAYS * RIDES
        keys = result.rides["ride_key"].to_numpy()
        assert keys[result.ride].tolist() == table["ride_key"].tolist()
        for code, name in ((result.vehicle, table["vehicle_id"]), (result.date, table["date"])):
            assert (
                pd.DataFrame({"code": code, "name": name}).drop_duplicates().nunique().tolist() == [code.max() + 1] * 2
            )
        assert result.day.max() + 1 == CARS * DAYS
        assert len(set(zip(result.vehicle, result.date, result.day, strict=True))) == CARS * DAYS
        np.testing.assert_allclose(result.by_ride(result.measured), result.rides["energy_kwh"], rtol=1e-12)
        assert result.day_of_ride[result.ride].tolist() == result.day.tolist()
        np.testing.assert_array_equal(result.predicted, model.predict(table))
        assert result.left_out == {}

    def test_reasons_for_which_rides_are_left_out_are_counted(self, tables, model):
        rides, windows = tables
        rides.loc[of(rides, "taxi-0#0", "taxi-0#1"), ["fit_for_training", "unfit_reason"]] = False, "too_short"
        rides.loc[of(rides, "taxi-2#2"), "energy_kwh"] = np.nan
        windows.loc[of(windows, "taxi-1#3"), "effect_climbing"] = np.nan
        rides.loc[of(rides, "taxi-1#3"), "effect_climbing"] = np.nan
        result = gather_windows(rides, windows, model)
        assert result.left_out == {"too_short": 2, "no_measured_energy": 1, "not predicted": 1}
        assert len(result.rides) == len(rides) - 4
        assert np.isfinite(result.predicted).all()
        assert result.ride.max() + 1 == len(result.rides)

    def test_too_few_rides_are_refused_with_why_others_are_left_out(self, tables, model):
        rides, windows = tables
        few = rides["ride_key"].isin(rides["ride_key"].iloc[: LEAST_RIDES - 1])
        rides.loc[~few, ["fit_for_training", "unfit_reason"]] = False, "too_short"
        with pytest.raises(
            ModelError, match=rf"^{LEAST_RIDES - 1} rides .*\({(~few).sum()} too short left out\)"
        ) as refusal:
            gather_windows(rides, windows, model)
        assert f"it takes {LEAST_RIDES}: give more rides" in str(refusal.value)
        assert "\n" not in str(refusal.value)

    def test_no_ride_with_measured_energy_is_refused(self, tables, model):
        rides, windows = tables
        nothing = {"energy_kwh": np.nan, "energy_vi_kwh": np.nan}
        with pytest.raises(ModelError, match=rf"^0 rides .*\({len(rides)} no measured energy left out\)"):
            gather_windows(rides.assign(**nothing), windows.assign(**nothing), model)

    def test_an_empty_table_is_refused(self, tables, model):
        rides, windows = tables
        with pytest.raises(ModelError, match=r"^0 rides with measured energy to diagnose, and it takes"):
            gather_windows(rides.iloc[:0], windows.iloc[:0], model)

    def test_rides_of_too_few_days_are_refused(self, model):
        rides, windows = make_tables(make_windows(cars=1, days=LEAST_DAYS - 1, rides=5))
        with pytest.raises(
            ModelError, match=f"25 rides are of {LEAST_DAYS - 1} vehicle-days, and it takes {LEAST_DAYS}"
        ):
            gather_windows(rides, windows, model)
        rides, windows = make_tables(make_windows(cars=1, days=LEAST_DAYS, rides=5))
        assert gather_windows(rides, windows, model).day.max() + 1 == LEAST_DAYS

    def test_a_model_of_other_vehicles_is_refused(self, tables, model):
        other_kind = msgspec.structs.replace(model, fits={"tesla-model-s": next(iter(model.fits.values()))})
        with pytest.raises(
            ModelError, match=r"is of tesla-model-s, and these rides are of kia-soul-ev-2015: give a model"
        ):
            gather_windows(*tables, other_kind)


class TestFitted:
    def test_fit_to_windows_distinguishes_acceleration_and_braking(self):
        tables = make_tables(make_windows(), noise=0.001)
        result = fit_to_windows("road_load", *tables)
        names = [term.name for term in result.terms]
        fit = result.fits["kia-soul-ev-2015"]
        coefficients = dict(zip(names, fit.coefficients, strict=True))
        assert coefficients["inertia_positive"] == pytest.approx(1.15, abs=0.05)
        assert coefficients["inertia_negative"] == pytest.approx(0.85, abs=0.05)
        assert coefficients["rolling"] == pytest.approx(1.05, abs=0.05)

    @pytest.mark.parametrize("name", ["pooled_hybrid", "boosted_hybrid"])
    def test_recipe_without_linear_terms_is_refused(self, tables, name):
        with pytest.raises(ModelError, match=rf"recipe {name} cannot be fitted to windows: choose road_load"):
            fit_to_windows(name, *tables)
