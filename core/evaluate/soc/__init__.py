"""Evaluate forecasts of the state of charge."""
