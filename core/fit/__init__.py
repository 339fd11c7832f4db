"""Fit models to tables of rides; `socast.core.models` holds the fitted models and predicts with them."""
