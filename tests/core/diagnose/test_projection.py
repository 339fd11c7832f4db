"""Test projection: it equals refitting the model, and it accounts for correlation within rides."""

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.diagnose.projection import BaseProjection, orthonormalise
from socast.core.fit.row_noise import gather_distortions
from socast.core.models.features import ACCESSORIES_COLUMN, Columns
from tests.support.synthetic_windows import build_tables, gather_with_model, make_tables, make_windows, project_base

NOISE = 0.004
RECIPES = ("road_load", "road_load_constant")


@pytest.fixture(scope="module", params=RECIPES)
def base(request):
    return project_base(make_tables(make_windows(), of_day=0.02, of_ride=0.002), request.param)


@pytest.fixture(scope="module")
def plain():
    """Return the projection for a model without accessory curve, in which cars share no column."""
    return project_base(make_tables(make_windows(), of_day=0.02, of_ride=0.002), "road_load_constant")


def candidate(base, name="cold_rolling"):
    return base.windows.table[[f"effect_{name}"]].to_numpy()


def of_cars(base, columns):
    """Return each column split by car, zero for other cars."""
    return np.column_stack([columns * (base.windows.vehicle == v)[:, np.newaxis] for v in range(len(base.cars))])


def untaken(base, columns):
    """Return the share of each column's size that is off the model."""
    return (base.project_out(columns) ** 2).sum(axis=0) / (base.apply_weights(columns) ** 2).sum(axis=0)


@pytest.mark.parametrize(("cars", "recipe"), [(1, "road_load"), (1, "road_load_constant"), (3, "road_load_constant")])
@pytest.mark.parametrize("name", ["cold_rolling", "headwind", "night_lights"])
def test_projection_equals_refit(cars, recipe, name):
    """By Frisch, Waugh and Lovell, the coefficient and the residual are those of the whole fit."""
    base = project_base(make_tables(make_windows(cars=cars), {name: 0.05}, of_ride=0.003), recipe)
    assert base.ride_correlation != 0.0
    column = candidate(base, name)
    off = base.project_out(column)[:, 0]
    coefficient = off @ base.residual / (off @ off)
    whole = np.column_stack(
        [base.apply_weights(of_cars(base, base.get_unweighted_columns())), base.apply_weights(column)]
    )
    size = np.sqrt((whole**2).sum(axis=0))
    whole = whole[:, size > 0.0] / size[size > 0.0]
    energy = base.apply_weights(base.windows.measured[:, np.newaxis])[:, 0]
    fitted, *_ = np.linalg.lstsq(whole, energy, rcond=1e-6)
    assert coefficient == pytest.approx(fitted[-1] / size[-1], rel=1e-5)
    np.testing.assert_allclose(base.residual - off * coefficient, energy - whole @ fitted, atol=1e-6)


def test_columns_of_model_are_projected_to_zero(base):
    table, model_columns = base.windows.table, ["effect_climbing", "effect_inertia_positive", "effect_inertia_negative"]
    columns = table[[*model_columns, "effect_rolling", "effect_aero_drag", "effect_braking", "duration_s"]].to_numpy()
    assert untaken(base, of_cars(base, columns)).max() < 1e-9
    assert (
        np.abs(base.project_out(base.get_unweighted_columns())).max()
        < 1e-6 * np.abs(base.apply_weights(base.get_unweighted_columns())).max()
    )
    orthogonal = base.apply_weights(of_cars(base, columns)).T @ base.residual
    scale = np.sqrt((base.apply_weights(of_cars(base, columns)) ** 2).sum(axis=0) * (base.residual @ base.residual))
    assert np.abs(orthogonal / scale).max() < 1e-6


def test_effect_outside_model_remains(base):
    for name in ("headwind", "cold_rolling", "wet_road", "night_lights"):
        assert untaken(base, candidate(base, name))[0] > 0.1, name


@pytest.mark.parametrize("recipe", RECIPES)
def test_errors_of_measured_motion_are_projected_out(recipe):
    """An error for each stop, of braking between samples, or of power that lags is credited to no effect."""
    table, rng = make_windows(), np.random.default_rng(7)
    drawn = {
        name: rng.gamma(2.0, 50.0, len(table)) for name in ("unresolved_braking_kwh", "power_start_w", "power_end_w")
    }
    base = project_base(make_tables(table.assign(**drawn)), recipe)
    errors = of_cars(base, np.column_stack([base.windows.table["stops"], gather_distortions(base.windows.table)]))
    assert untaken(base, errors).max() < 1e-9


def test_tables_without_the_columns_of_motion_are_diagnosed():
    tables = make_tables(make_windows())
    rides, windows = (table.drop(columns="stops") for table in tables)
    assert project_base((rides, windows)).rank == project_base(tables).rank - 4  # a column less for each car


def test_accessory_curve_explains_any_smooth_function_of_temperature():
    tables = make_tables(make_windows())
    hours = tables[1]["duration_s"].to_numpy() / 3600.0
    ambient = tables[1]["ambient_c"].to_numpy()
    smooth = hours[:, np.newaxis] * np.column_stack([ambient, ambient**2, np.tanh((ambient - 5.0) / 8.0)])
    curved, constant = (project_base(tables, recipe) for recipe in RECIPES)
    assert untaken(curved, smooth).max() < 0.01
    assert untaken(constant, smooth).min() > 0.1
    assert untaken(curved, hours[:, np.newaxis] * np.sin(40.0 * ambient)[:, np.newaxis])[0] > 0.5


def test_accessory_curve_of_model_is_projected_to_zero():
    result, model = gather_with_model(make_tables(make_windows()))
    fit = next(iter(model.fits.values()))
    base = BaseProjection(result, model)
    curve = Columns(result.table, fit.fills, fit.curve)[ACCESSORIES_COLUMN]
    assert untaken(base, curve[:, np.newaxis])[0] < 1e-9


def test_projection_is_idempotent_and_linear(base):
    columns = np.random.default_rng(3).normal(size=(len(base.residual), 3))
    once = base.project_out(columns)
    again = base.project_out(np.column_stack([base.convert_to_energy(each) for each in once.T]))
    np.testing.assert_allclose(again, once, atol=1e-9 * np.abs(once).max())
    np.testing.assert_allclose(
        base.project_out(columns @ [[1.0], [2.0], [-3.0]])[:, 0], once @ [1.0, 2.0, -3.0], atol=1e-8
    )


def test_weighting_is_invertible(base):
    values = np.random.default_rng(4).normal(size=(len(base.residual), 1))
    np.testing.assert_allclose(base.convert_to_energy(base.apply_weights(values)[:, 0]), values[:, 0], atol=1e-9)


@pytest.mark.parametrize("of_ride", [0.0, 0.001, 0.002, 0.004])
def test_planted_ride_correlation_is_recovered(of_ride):
    base = project_base(make_tables(make_windows(), noise=NOISE, of_ride=of_ride))
    assert base.ride_correlation == pytest.approx(of_ride**2 / (of_ride**2 + NOISE**2), abs=0.05)


def test_compensating_windows_have_negative_correlation():
    tables = make_tables(make_windows(), noise=0.0)
    ride = pd.factorize(tables[1]["ride_key"])[0]
    size = float(np.bincount(ride)[0])
    error = np.random.default_rng(5).normal(0.0, NOISE, len(ride))
    error -= 0.8 * (np.bincount(ride, error) / size)[ride]
    planted = (1.0 - (0.8 * (2.0 - 0.8))) * NOISE**2 / size - NOISE**2 / size  # covariance of two windows of a ride
    energy = tables[1]["energy_kwh"].to_numpy() + error
    windows = tables[1].drop(columns="ride_key").assign(ride_key=tables[1]["ride_key"], date=tables[0]["date"].iloc[0])
    windows["date"] = tables[0].set_index("ride_key")["date"].loc[windows["ride_key"]].to_numpy()
    base = project_base(build_tables(windows, energy))
    assert base.ride_correlation == pytest.approx(planted / NOISE**2, abs=0.03)
    assert base.ride_correlation < -0.05


@pytest.mark.parametrize("of_ride", [0.002, 0.004])
def test_weighted_errors_are_independent(of_ride):
    base = project_base(make_tables(make_windows(), noise=NOISE, of_ride=of_ride))
    rides, left = base.windows.ride, base.residual / np.std(base.residual)
    pairs = np.bincount(rides, left) ** 2 - np.bincount(rides, left**2)
    count = np.bincount(rides)
    assert abs(pairs.sum() / (count * (count - 1)).sum()) < 0.03


def test_weighted_errors_have_unit_variance():
    base = project_base(make_tables(make_windows(), noise=NOISE))
    assert np.mean(base.residual**2) == pytest.approx(1.0, abs=0.1)


def test_outlier_window_has_less_weight():
    tables = make_tables(make_windows(), noise=NOISE)
    before = project_base(tables)
    for name in ("energy_kwh", "energy_vi_kwh"):
        tables[1].loc[100, name] += 0.5
    after = project_base(tables)
    at = np.flatnonzero((after.windows.table["start_s"] == tables[1].loc[100, "start_s"]).to_numpy())
    mine = at[after.windows.table["vehicle_id"].to_numpy()[at] == tables[1].loc[100, "vehicle_id"]][0]
    assert after.weight[mine] < 0.02 * np.median(after.weight)
    others = np.arange(len(after.weight)) != mine
    assert np.median(np.abs(after.weight[others] / before.weight[others] - 1.0)) < 0.1
    assert np.median(np.abs(after.residual[others] - before.residual[others])) < 0.1


def test_cars_with_few_windows_share_coefficients():
    rides, windows = make_tables(make_windows())
    few = ("taxi-2", "taxi-3")
    kept = rides["ride_key"].isin([f"{car}#{n}" for car in few for n in range(3)]) | ~rides["vehicle_id"].isin(few)
    base = project_base((rides[kept], windows))
    rolling = of_cars(base, candidate(base, "rolling"))
    left = untaken(base, rolling)
    assert left[:2].max() < 1e-9
    assert left[2:].min() > 0.01
    assert untaken(base, rolling[:, [2]] + rolling[:, [3]])[0] < 1e-9
    assert base.rank < project_base((rides, windows)).rank


@given(st.integers(0, 2**32), st.integers(1, 6), st.integers(0, 4))
def test_orthonormal_basis_spans_its_columns(seed, per_car, copies):
    rng = np.random.default_rng(seed)
    columns = rng.normal(size=(40, per_car)) * 10.0 ** rng.uniform(-6.0, 6.0, per_car)
    basis = orthonormalise(np.column_stack([columns, columns[:, :1] * np.arange(copies)]))
    assert basis.shape == (40, per_car)
    np.testing.assert_allclose(basis.T @ basis, np.eye(per_car), atol=1e-9)
    size = np.sqrt((columns**2).sum(axis=0))
    np.testing.assert_allclose((basis @ (basis.T @ columns)) / size, columns / size, atol=1e-5)


def test_zero_columns_have_empty_basis():
    assert orthonormalise(np.zeros((7, 3))).shape == (7, 0)
    assert orthonormalise(np.empty((7, 0))).shape == (7, 0)
