"""Bridges from other ecosystems: signals one by one become rows of telemetry."""
