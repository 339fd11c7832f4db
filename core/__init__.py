"""From messages to forecasts: no I/O, no clock, no threads."""

from socast.core.compiled_cache import place_cache

place_cache()
