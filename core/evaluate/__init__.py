"""Judging models: the paper's protocol, its figures, and what it leaves open."""
