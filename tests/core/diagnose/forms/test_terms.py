"""Test that the limits of terms lie within the values of their variables."""

import numpy as np
import pytest

from socast.core.diagnose.forms.terms import choose_limits


@pytest.mark.parametrize("values", [[0.0, 0.0, 0.0], [1.0, 2.0], [0.0, 0.0, 0.0, 5.0]])
def test_limits_lie_within_values(values):
    x = np.array(values)
    assert all(x.min() < at < x.max() for at in choose_limits(x, "1"))
