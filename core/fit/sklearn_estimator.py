"""Wrap a recipe as a scikit-learn estimator, for cross-validation, searches and the selection of terms."""

from typing import Self

import numpy as np
import pandas as pd
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.utils import Tags
from sklearn.utils.validation import check_is_fitted

from socast.core.batch import Floats
from socast.core.errors import ModelError
from socast.core.fit.recipes import FIRST_RECIPE, fit_recipe
from socast.core.fit.ride_blocks import ENERGY
from socast.core.models import LinearModel


class RecipeRegressor(RegressorMixin, BaseEstimator):  # type: ignore[misc]  # scikit-learn has no types
    """Fit a recipe to a ride table, and predict the energy of rides.

    Parameters
    ----------
    recipe : str
        Name of a recipe in `socast.core.fit.recipes.RECIPES`.
    covariance : bool
        Whether to estimate the covariance of the coefficients too.
    windows : DataFrame, optional
        Window table with the windows of at least the rides to fit to, for a recipe that is fitted to windows. The
        column `ride_key` of X selects its windows.

    Attributes
    ----------
    model_ : LinearModel
        Fitted model.

    Examples
    --------
    >>> RecipeRegressor("hybrid").get_params()
    {'covariance': False, 'recipe': 'hybrid', 'windows': None}
    """

    model_: LinearModel

    def __init__(
        self, recipe: str = FIRST_RECIPE, *, covariance: bool = False, windows: pd.DataFrame | None = None
    ) -> None:
        self.recipe = recipe
        self.covariance = covariance
        self.windows = windows

    def __sklearn_tags__(self) -> Tags:
        """Return the tags: X is a DataFrame, whose columns have names and meanings, and no plain array."""
        tags: Tags = super().__sklearn_tags__()
        tags.input_tags.two_d_array = False
        return tags

    def fit(self, X: pd.DataFrame, y: Floats | pd.Series) -> Self:  # noqa: N803 - scikit-learn's name
        """Fit the recipe to rides, except those that X marks as unfit for training and those of unknown energy.

        Parameters
        ----------
        X : (n, columns) DataFrame
            Ride table with at least the columns that the recipe needs.
        y : (n,) float
            Measured energy. Where the windows of a ride are metered, their own energies are fitted to. [kWh]

        Returns
        -------
        RecipeRegressor
            This estimator.

        Raises
        ------
        ModelError
            If the recipe is unknown, if X is no DataFrame, or if the recipe cannot be fitted to the rides.
        """
        table = _table(X).assign(**{ENERGY: np.asarray(y, dtype=np.float64)})
        self.model_ = fit_recipe(self.recipe, table, self.windows, covariance=self.covariance)
        self.n_features_in_ = X.shape[1]
        self.feature_names_in_ = np.array(X.columns, dtype=object)
        return self

    def predict(self, X: pd.DataFrame) -> Floats:  # noqa: N803 - scikit-learn's name
        """Return the energy of rides.

        Parameters
        ----------
        X : (n, columns) DataFrame
            Ride table with at least the columns that the recipe needs.

        Returns
        -------
        (n,) float
            Energy. [kWh]

        Raises
        ------
        ModelError
            If X is no DataFrame.
        """
        check_is_fitted(self, "model_")
        return self.model_.predict_energy(_table(X))


def _table(table: pd.DataFrame) -> pd.DataFrame:
    """Return the ride table; raise ModelError if it is no DataFrame."""
    if not isinstance(table, pd.DataFrame):
        raise ModelError(f"a {type(table).__name__} has no columns by name: give rides as a DataFrame")
    return table
