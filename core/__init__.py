"""From messages to forecasts: no I/O, no clock, no threads."""
