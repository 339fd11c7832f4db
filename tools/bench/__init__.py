"""Measure ratios of speed for `make bench`; each ratio compares two things that are measured in turn in one run."""
