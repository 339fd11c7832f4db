"""Fitting: from tables of rides to model files. Nothing here predicts; `core.models` does."""
