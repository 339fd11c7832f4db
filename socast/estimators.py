"""Offer recipes as estimators of scikit-learn, which takes a second to import."""

from socast.core.fit.sklearn_estimator import RecipeRegressor

__all__ = ["RecipeRegressor"]
