"""Ratios of speed, each between two things measured in turn in one run: `make bench`."""
