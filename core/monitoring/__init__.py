"""Compare models in service on the same rides."""
