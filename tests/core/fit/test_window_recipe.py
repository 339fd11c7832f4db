"""Test the recipes that are fitted to windows, and their estimator."""

from dataclasses import replace

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.model_selection import GroupKFold, cross_val_predict

from socast.core.errors import ModelError
from socast.core.fit.recipes import RECIPES, WINDOW_RECIPES, get_recipe
from socast.core.fit.row_noise import DISTORTIONS
from socast.core.fit.sklearn_estimator import RecipeRegressor
from socast.core.fit.window_recipe import WindowRecipe
from tests.support.synthetic_windows import make_tables, make_windows


@pytest.fixture(scope="module")
def tables():
    return make_tables(make_windows(2, 6, 3, 6), noise=0.002)


def test_recipes_beyond_the_paper_of_physical_terms_are_fitted_to_windows():
    names = tuple(name for name, recipe in RECIPES.items() if isinstance(recipe, WindowRecipe))
    assert names == WINDOW_RECIPES == ("road_load", "road_load_constant", "road_load_full", "road_load_full_constant")


@pytest.mark.parametrize("name", ["road_load", "road_load_constant"])
def test_full_recipe_has_denser_air_cold_tyres_and_losses_by_torque_besides(name):
    plain, full = ({term.name for term in get_recipe(each).terms} for each in (name, name.replace("load", "load_full")))
    assert plain - full == {"aero_drag"}
    assert full - plain == {"aero_drag_wind", "cold_rolling", "drivetrain_loss_torque"}


def test_full_recipe_fits_with_its_own_distortions(tables):
    rides, windows = tables
    rng = np.random.default_rng(5)
    windows = windows.assign(unresolved_braking_kwh=rng.uniform(0.0, 0.01, len(windows)))
    recipe = get_recipe("road_load_full_constant")
    usual = replace(recipe, distortions=DISTORTIONS)
    assert recipe.distortions["unresolved_braking_share"] < DISTORTIONS["unresolved_braking_share"]
    assert list(recipe.distortions) == list(DISTORTIONS)
    assert recipe.fit(rides, windows).fits != usual.fit(rides, windows).fits


def test_bound_recipe_keeps_only_the_columns_that_it_reads(tables):
    recipe = get_recipe("road_load_constant")
    bound = recipe.bind(tables[1])
    assert set(bound.windows) <= set(recipe.columns)
    assert (bound.name, bound.title, bound.terms) == (recipe.name, recipe.title, recipe.terms)


def test_bound_recipe_fits_what_the_recipe_fits(tables):
    rides, windows = tables
    rng = np.random.default_rng(5)
    drawn = {name: rng.uniform(0.0, 2e4, len(windows)) for name in ("power_start_w", "power_end_w")}
    windows = windows.assign(**drawn, unresolved_braking_kwh=rng.uniform(0.0, 0.01, len(windows)))
    recipe = get_recipe("road_load_constant")
    whole, plain = recipe.fit(rides, windows), recipe.fit(rides, tables[1])
    bound = recipe.bind(windows).fit(rides)
    assert bound.fits == whole.fits
    assert bound.version == whole.version
    assert plain.fits != whole.fits
    assert plain.training.fingerprint != whole.training.fingerprint


def test_tables_without_the_estimate_of_unresolved_braking_are_refused(tables):
    rides, windows = (table.drop(columns="unresolved_braking_kwh") for table in tables)
    with pytest.raises(ModelError, match="column 'unresolved_braking_kwh' is missing: make the tables again"):
        get_recipe("road_load").fit(rides, windows)


def test_estimator_fits_windows_of_its_rides(tables):
    rides, windows = tables
    estimator = clone(RecipeRegressor("road_load", windows=windows))
    energy = rides["energy_kwh"]
    predicted = cross_val_predict(estimator, rides, energy, groups=rides["date"], cv=GroupKFold(3))
    assert np.abs(predicted - energy).mean() < 0.06 * energy.mean()


def test_estimator_without_windows_fits_rides(tables):
    rides, _ = tables
    model = RecipeRegressor("road_load_constant").fit(rides, rides["energy_kwh"]).model_
    assert model.history[0]["rows"] == "rides"
