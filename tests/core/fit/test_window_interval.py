"""Test that errors of held-out rides are those of fits without them."""

import numpy as np
import pytest

from socast.core.fit.measured_rows import join_tables
from socast.core.fit.nested_effects import compute_coefficients, eliminate, integrate_car_factor
from socast.core.fit.recipes import get_recipe
from socast.core.fit.window_fit import _HeldOut, add_window_interval, fit_rows
from socast.core.fit.window_solver import RideProducts
from tests.support.synthetic_windows import make_tables, make_windows

KIND = "kia-soul-ev-2015"


@pytest.fixture(scope="module")
def fitted():
    rides, windows = make_tables(make_windows(3, 8, 3, 6), noise=0.003)
    recipe = get_recipe("road_load_constant")
    model, groups = fit_rows(recipe.name, recipe.terms, join_tables(rides, windows))
    return model, groups, rides


def test_error_without_a_day_is_that_of_sums_without_the_day(fitted):
    model, groups, rides = fitted
    held = _HeldOut(model, groups, KIND, rides)
    group = groups[KIND]
    products, day = group.products, 4
    kept = products.day != day
    days = np.unique(products.day[kept], return_inverse=True)[1]
    part = RideProducts(products.sums[kept], products.rows[kept], days, np.delete(products.car, day))
    elimination = eliminate(part, group.spreads)
    total = integrate_car_factor(elimination.cars, group.spreads.car).sums.sum(axis=0)
    mean = compute_coefficients(group.prior, total).mean
    own = held.day == day
    expected = held.energy[own] - held.columns[own] @ mean - held.offset[own]
    np.testing.assert_allclose(held.without_day()[own], expected, rtol=1e-6, atol=1e-9)


def test_held_out_errors_are_larger_than_in_sample_errors(fitted):
    model, groups, rides = fitted
    held = _HeldOut(model, groups, KIND, rides)
    inside = np.abs(rides["energy_kwh"] - model.predict_energy(rides)).mean()
    assert inside < np.abs(held.without_day()).mean() < 1.2 * inside


def test_rides_that_lack_a_column_of_the_scale_get_no_interval(fitted):
    model, groups, rides = fitted
    assert add_window_interval(model, groups, rides.drop(columns="effect_accessories")).interval is None
    described = add_window_interval(model, groups, rides)
    assert described.history[0]["mae_in_sample_kwh"][KIND] > 0.0
