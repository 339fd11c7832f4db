"""Forecast the state of charge of each car: filter, statistics of rides and shifts, plans and outlook."""
