"""Fit models to tables of rides; `core.models` holds the fitted models and predicts with them."""
