"""Compare the compiled Kalman filters with filterpy's, on the recordings of a user."""
