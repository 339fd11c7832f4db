"""Put a known effect into a recording of real cars, and score what the diagnosis makes of it."""
