"""Transports and the one loop that joins them to core."""
