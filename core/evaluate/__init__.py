"""Evaluate models and forecasts: the paper's protocol, comparisons with measurement, and state-of-charge forecasts."""
