"""Test that fits to windows recover planted coefficients, stay possible with few rides, and know their uncertainty."""

import numpy as np
import pandas as pd
import pytest

from socast.core import effects
from socast.core.errors import ModelError
from socast.core.fit.priors import build_prior, find_limits
from socast.core.fit.recipes import ROAD_LOAD_TERMS, fit_to_windows, get_recipe
from socast.core.models import ANY, LinearModel
from socast.core.models.features import Columns
from socast.core.models.plausibility import describe_limited, list_implausible
from tests.support.synthetic_windows import BASE, make_tables, make_windows

KIND = "kia-soul-ev-2015"


def get_coefficients(model: LinearModel, key: str = KIND) -> dict[str, float]:
    return dict(zip([term.name for term in model.terms], model.fits[key].coefficients, strict=True))


def get_errors(model: LinearModel, key: str = KIND) -> dict[str, float]:
    sd = np.sqrt(np.diag(model.fits[key].covariance))
    return dict(zip([term.name for term in model.terms], sd.tolist(), strict=True))


@pytest.fixture(scope="module")
def tables() -> tuple[pd.DataFrame, pd.DataFrame]:
    return make_tables(make_windows(4, 10, 3, 8), noise=0.002)


@pytest.fixture(scope="module")
def model(tables) -> LinearModel:
    return fit_to_windows("road_load", *tables)


def test_windows_distinguish_acceleration_and_braking(model):
    found, sd = get_coefficients(model), get_errors(model)
    for name in ("rolling", "climbing", "aero_drag", "inertia_positive", "inertia_negative", "braking"):
        assert found[name] == pytest.approx(BASE[name], abs=max(4.0 * sd[name], 0.02)), name
        assert sd[name] < 0.08, name


def test_coefficients_of_a_few_rides_are_possible_and_near_the_prior(tables):
    rides, windows = tables
    few = fit_to_windows("road_load", rides.iloc[:3], windows)
    assert list_implausible(few) == {}
    table = Columns(windows)
    prior, (low, high) = build_prior(ROAD_LOAD_TERMS, table, len(windows)), find_limits(ROAD_LOAD_TERMS, table)
    for i, term in enumerate(ROAD_LOAD_TERMS):
        value = get_coefficients(few)[term.name]
        assert low[i] <= value <= high[i]
        assert abs(value - prior.mean[i]) < 4.0 * np.sqrt(prior.covariance[i, i])
    assert few.training.rides == 3


def test_more_rides_make_coefficients_more_certain(tables, model):
    rides, windows = tables
    few, many = get_errors(fit_to_windows("road_load", rides.iloc[:6], windows)), get_errors(model)
    assert all(many[name] < few[name] for name in many)


def test_rides_without_windows_have_the_same_prior_and_larger_errors(tables, model):
    rides, _ = tables
    by_rides = get_recipe("road_load").fit(rides)
    assert list_implausible(by_rides) == {}
    assert by_rides.history[0]["rows"] == "rides"
    assert model.history[0]["rows"] == "windows"
    assert get_errors(by_rides)["inertia_positive"] > 1.5 * get_errors(model)["inertia_positive"]


def test_windows_of_other_rides_change_nothing(tables):
    rides, windows = tables
    train = rides.iloc[:40]
    spoilt = windows.assign(
        energy_vi_kwh=np.where(windows["ride_key"].isin(train["ride_key"]), windows["energy_vi_kwh"], 99.0)
    )
    recipe = get_recipe("road_load")
    expected = recipe.fit(train, windows, covariance=False)
    assert recipe.bind(spoilt).fit(train, covariance=False).fits == expected.fits


def test_order_of_rows_changes_nothing_but_rounding(tables, model):
    rides, windows = tables
    shuffled = fit_to_windows(
        "road_load", rides.sample(frac=1.0, random_state=1), windows.sample(frac=1.0, random_state=2)
    )
    np.testing.assert_allclose(shuffled.fits[KIND].coefficients, model.fits[KIND].coefficients, rtol=1e-4)


def test_cars_share_the_coefficients_of_their_vehicle_model(tables, model):
    rides, windows = tables
    assert model.cars == {}
    assert get_errors(model)["rolling"] > get_errors(model)["climbing"] / 3.0
    one = fit_to_windows("road_load", rides[rides["vehicle_id"] == "taxi-1"], windows)
    assert one.fits[ANY] == one.fits[KIND]


def test_interval_covers_rides(tables, model):
    rides, _ = tables
    low, high = model.predict_interval(rides)
    assert 0.8 < np.mean((low <= rides["energy_kwh"]) & (rides["energy_kwh"] <= high)) <= 1.0


def test_coefficient_at_the_end_of_its_range_stays_there(tables):
    rides, windows = (table.copy() for table in tables)
    for table in (rides, windows):
        for name in ("energy_kwh", "energy_vi_kwh"):
            table[name] = table[name] + 1.8 * table["effect_inertia_negative"]
    found = fit_to_windows("road_load", rides, windows, covariance=False)
    assert get_coefficients(found)["inertia_negative"] == pytest.approx(effects.get("inertia_negative").high, abs=1e-6)
    assert "inertia_negative" in found.fits[KIND].limited
    assert "rolling" not in found.fits[KIND].limited
    assert describe_limited(found)[-1].endswith("inertia_negative stopped at the limit of the plausible range")
    assert list_implausible(found) == {}


@pytest.mark.parametrize("name", ["pooled_hybrid", "fitted_physical"])
def test_recipe_of_rides_is_refused(tables, name):
    with pytest.raises(ModelError, match=rf"recipe {name} cannot be fitted to windows: choose road_load"):
        fit_to_windows(name, *tables)


@pytest.mark.parametrize("count", [1, 2])
def test_first_ride_gives_a_model_near_its_prior_with_an_interval(tables, count):
    rides, windows = tables
    model = fit_to_windows("road_load", rides.iloc[:count], windows)
    assert model.fits[ANY].rides == count
    assert list_implausible(model) == {}
    assert model.interval.rides == count
    lower, upper = model.predict_interval(rides, 0.9)
    assert 0.8 < np.mean((lower <= rides["energy_kwh"]) & (rides["energy_kwh"] <= upper)) <= 1.0


def test_vehicle_model_with_two_rides_beside_others_has_no_fit_of_its_own(tables):
    rides, windows = tables
    rides = rides.assign(vehicle_model=np.where(rides.index < 2, "new", rides["vehicle_model"]))
    kinds = windows["ride_key"].map(rides.set_index("ride_key")["vehicle_model"])
    model = fit_to_windows("road_load", rides, windows.assign(vehicle_model=kinds))
    assert "new" not in model.fits
    assert ANY in model.fits


def test_too_few_rides_and_missing_columns_are_refused(tables):
    rides, windows = tables
    with pytest.raises(ModelError, match="recipe road_load: 0 rides to fit to, and it needs 1: give more rides"):
        fit_to_windows("road_load", rides.iloc[:0], windows.iloc[:0])
    unfit = rides.assign(fit_for_training=False, unfit_reason="too_little_distance").iloc[:24]
    with pytest.raises(ModelError, match=r"24 rides, all unfit \(24 too little distance\).* if no speed"):
        fit_to_windows("road_load", unfit, windows)
    with pytest.raises(ModelError, match="recipe road_load: column 'effect_braking' is missing: make the tables again"):
        fit_to_windows("road_load", rides, windows.drop(columns="effect_braking"))
