"""Test the recipes that are fitted to windows, and their estimator."""

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.model_selection import GroupKFold, cross_val_predict

from core.fit.recipes import RECIPES, get_recipe
from core.fit.sklearn_estimator import RecipeRegressor
from core.fit.window_recipe import RecipeWithWindows, WindowRecipe
from tests.support.synthetic_windows import make_tables, make_windows


@pytest.fixture(scope="module")
def tables():
    return make_tables(make_windows(2, 6, 3, 6), noise=0.002)


def test_recipes_beyond_the_paper_of_physical_terms_are_fitted_to_windows():
    names = [name for name, recipe in RECIPES.items() if isinstance(recipe, WindowRecipe)]
    assert names == ["road_load", "road_load_constant"]


def test_bound_recipe_keeps_only_the_columns_that_it_reads(tables):
    recipe = get_recipe("road_load_constant")
    bound = RecipeWithWindows(recipe, tables[1])
    assert set(bound.windows) <= set(recipe.columns)
    assert (bound.name, bound.title, bound.terms) == (recipe.name, recipe.title, recipe.terms)


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
