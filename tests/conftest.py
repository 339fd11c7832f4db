"""Settings and fixtures of every test."""

import numpy as np
import pytest
from hypothesis import settings

settings.register_profile("quick", max_examples=15, deadline=None, derandomize=True)
settings.load_profile("quick")


@pytest.fixture
def rng() -> np.random.Generator:
    """Return a generator of random numbers that is the same for every test."""
    return np.random.default_rng(7)
