"""Test the windows to diagnose: metered windows of rides fit for training, with the properties of their ride."""

import msgspec
import numpy as np
import pandas as pd
import pytest

from socast.core.diagnose.dataset import (
    LEAST_DAYS,
    LEAST_RIDES,
    gather_windows,
)
from socast.core.errors import ModelError
from socast.core.fit.recipes import fit_to_windows
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
        np.testing.assert_array_equal(result.predicted, model.predict_energy(table))
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
        with pytest.raises(ModelError, match=r"^there are no rides to diagnose"):
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
