"""Total power over windows and rides, and make the tables."""
