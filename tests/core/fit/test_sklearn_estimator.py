"""Test that recipes are scikit-learn estimators."""

import numpy as np
import pandas as pd
import pytest
from sklearn.base import clone
from sklearn.exceptions import NotFittedError
from sklearn.model_selection import KFold, cross_val_score
from sklearn.utils import estimator_checks

from socast.core.errors import ModelError
from socast.core.fit.sklearn_estimator import RecipeRegressor
from tests.support.planted_rides import noisy, physical_energy, rides


def test_recipe_regressor_is_a_scikit_learn_estimator():
    measured = noisy(rides(600, models=("kia-soul-ev-2015",)), np.zeros(600))
    energy = noisy(measured, physical_energy(measured))["energy_kwh"]
    estimator = RecipeRegressor("fitted_physical")
    assert clone(estimator).get_params() == {"recipe": "fitted_physical", "windows": None, "covariance": False}
    with pytest.raises(NotFittedError):
        estimator.predict(measured)
    assert estimator.fit(measured, energy) is estimator
    assert estimator.predict(measured).tobytes() == estimator.model_.predict_energy(measured).tobytes()
    assert estimator.score(measured, energy) > 0.9
    scores = cross_val_score(estimator, measured.drop(columns="energy_kwh"), energy, cv=KFold(3, shuffle=True))
    assert (scores > 0.9).all()
    with pytest.raises(ModelError, match="recipe 'hybird' is unknown: known are basic_physical"):
        RecipeRegressor("hybird").fit(measured, energy)
    with pytest.raises(ModelError, match="ndarray has no columns by name"):
        estimator.predict(measured.select_dtypes("number").to_numpy())


def test_fit_of_an_estimator_changes_neither_table_nor_energy():
    ride_table = rides(300)
    energy = pd.Series(physical_energy(ride_table))
    before = ride_table.copy(deep=True), energy.copy(deep=True)
    RecipeRegressor("hybrid").fit(ride_table, energy)
    pd.testing.assert_frame_equal(ride_table, before[0])
    pd.testing.assert_series_equal(energy, before[1])


@pytest.mark.parametrize(
    "check",
    [
        estimator_checks.check_parameters_default_constructible,
        estimator_checks.check_get_params_invariance,
        estimator_checks.check_set_params,
        estimator_checks.check_no_attributes_set_in_init,
        estimator_checks.check_estimator_cloneable,
        estimator_checks.check_estimator_repr,
        estimator_checks.check_valid_tag_types,
        estimator_checks.check_mixin_order,
    ],
    ids=lambda check: check.__name__,
)
def test_estimator_passes_the_checks_of_scikit_learn_without_data(check):
    """The other checks give plain arrays, whose columns have no names; the tags state that X is none."""
    check("RecipeRegressor", RecipeRegressor())
