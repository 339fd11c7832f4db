"""Test that the softened accessory power is the mean of the power by the curve, and its derivatives."""

import numpy as np
import pytest

from socast.core.columns import ZERO_CELSIUS
from socast.core.fit.accessory_curve import (
    SOFTENED,
    build_curve,
    compute_softened_power,
    differentiate_softened_power,
    flatten_curve,
)
from socast.core.vehicles import ACCESSORIES

AMBIENT = np.array([-25.0, -20.2, -20.0, -5.0, 11.7, 12.0, 12.4, 15.0, 21.3, 25.0, 34.9, 40.0])


def test_softened_power_is_the_mean_over_temperatures():
    around = np.linspace(-SOFTENED, SOFTENED, 2001)
    mean = [np.trapezoid(ACCESSORIES.power(t + ZERO_CELSIUS + around), around) / (2.0 * SOFTENED) for t in AMBIENT]
    np.testing.assert_allclose(compute_softened_power(ACCESSORIES, AMBIENT), mean, rtol=1e-6)


@pytest.mark.parametrize("number", range(7))
def test_derivatives_are_those_of_the_power(number):
    numbers, step = flatten_curve(ACCESSORIES), np.where(np.arange(7) == number, 1e-3, 0.0)
    up, down = (differentiate_softened_power(build_curve(numbers + sign * step), AMBIENT) for sign in (1.0, -1.0))
    here = differentiate_softened_power(ACCESSORIES, AMBIENT)
    np.testing.assert_allclose(here.power, compute_softened_power(ACCESSORIES, AMBIENT), rtol=1e-12)
    np.testing.assert_allclose(here.first[:, number], (up.power - down.power) / 2e-3, atol=1e-4)
    np.testing.assert_allclose(here.second[:, number], (up.first - down.first) / 2e-3, atol=2e-4)
