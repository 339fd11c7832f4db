"""Reproduce the paper's evaluation of consumption models."""
