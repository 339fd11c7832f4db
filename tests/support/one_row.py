"""Effects at one point, for values worked out by hand."""

import numpy as np

from socast.core.effects import get


def power(name: str, **columns: float) -> float:
    """Return the power of an effect, or of its variant, for one row, in W a unit of the coefficient."""
    return float(get(name).power({n: np.array([float(value)]) for n, value in columns.items()})[0])
