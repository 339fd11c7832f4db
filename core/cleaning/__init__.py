"""Clean the stream: repair times, reject impossible speeds, smooth, and cut rides."""
