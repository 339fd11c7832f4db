"""Provide means over the test rides of repeated splits."""

import numpy as np

from socast.core.stats.splits import split_by_ride


def repeated(values, seed, repeats=10):
    """Return the means over the test rides of each split of the protocol."""
    return np.array([values[s.test].mean(axis=0) for s in split_by_ride([("a", 0)] * len(values), seed, repeats)])
