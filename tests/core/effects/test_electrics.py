"""Test the effects of the 12 V system."""

import pytest

from tests.support.one_row import power


def test_standby_has_constant_power():
    assert power("standby", dt=3) == 1


@pytest.mark.parametrize("darkness", [0, 0.4, 1])
def test_power_of_night_lights_is_proportional_to_darkness(darkness):
    assert 150 * power("night_lights", darkness=darkness) == pytest.approx(150 * darkness)
