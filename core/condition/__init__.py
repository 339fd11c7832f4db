"""Condition of cars: where the energy goes, how each car is doing, and whether a repair helped."""
