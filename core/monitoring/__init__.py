"""Compare the models in service on the same rides."""
