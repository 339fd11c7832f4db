"""Benchmark diagnosis: hide effects in simulated data sets, and count how often diagnosis names them."""
