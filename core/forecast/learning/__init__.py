"""Learn from past rides, shifts and forecasts what later forecasts use."""
