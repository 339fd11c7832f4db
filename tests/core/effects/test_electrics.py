"""The 12 V side."""

import pytest

from tests.support.one_row import power


def test_standby_is_always_on():
    assert power("standby", dt=3) == 1


@pytest.mark.parametrize("darkness", [0, 0.4, 1])
def test_lights_burn_by_the_dark(darkness):
    assert 150 * power("night_lights", darkness=darkness) == pytest.approx(150 * darkness)
