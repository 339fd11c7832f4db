"""Simulate a fleet, its city, its weather and its faulty loggers, with richer physics than any model fitted to it."""

from socast.tools.simulator.fleet import simulate
from socast.tools.simulator.settings import NO_FAULTS, PLAIN_PHENOMENA, Faults, Hidden, Phenomena, Simulation
from socast.tools.simulator.truth import Truth

__all__ = ["NO_FAULTS", "PLAIN_PHENOMENA", "Faults", "Hidden", "Phenomena", "Simulation", "Truth", "simulate"]
