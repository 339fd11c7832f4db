"""Learn from past shifts what forecasts rest on."""
