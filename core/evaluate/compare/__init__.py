"""Compare models, and data sets, on measured rides."""
