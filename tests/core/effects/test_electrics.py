"""Test the effects of the 12 V system."""

import pytest

from tests.support.one_row import power


def test_standby_has_constant_power():
    assert power("standby", dt=3) == 1


@pytest.mark.parametrize(("sun_sine", "darkness"), [(0.5, 0), (0.0, 0), (-0.0418, 0.4), (-0.1045, 1), (-0.5, 1)])
def test_power_of_night_lights_is_proportional_to_darkness(sun_sine, darkness):
    assert 150 * power("night_lights", sun_sine=sun_sine) == pytest.approx(150 * darkness)
