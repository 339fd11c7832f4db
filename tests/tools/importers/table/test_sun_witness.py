"""Test that an irradiance shows a wrong time zone, and that clouds do not."""

from zoneinfo import ZoneInfo

import numpy as np
import pytest

from socast.core.signals.sun import sine_of_elevation
from socast.tools.importers.table.weather_file import SunWitness

PLACE = (43.9, 125.3)
DAY = 1_681_862_400.0 + 60.0 * np.arange(1440)
"""The minutes of 19 April 2023, UTC. [Unix s]"""
WORK = (DAY % 86400.0 > 0.0) & (DAY % 86400.0 < 9 * 3600.0)
"""From 8 to 17 h in China."""


def judge(times, hours, seed=0):
    """Return the check of irradiances under broken clouds, with a clock that is some hours late."""
    place = np.radians(np.full(len(times), PLACE[0])), np.radians(np.full(len(times), PLACE[1]))
    clouds = np.random.default_rng(seed).uniform(0.6, 1.0, len(times))
    irradiance = 1000.0 * np.maximum(sine_of_elevation(times, *place), 0.0) * clouds
    witness = SunWitness()
    witness.add(times + 3600.0 * hours, *(np.full(len(times), each) for each in PLACE), irradiance)
    return witness.check(ZoneInfo("UTC"))


def test_local_times_read_as_utc_are_told_with_the_right_zone():
    check = judge(DAY[WORK], 8.0)
    assert check.passed is False
    assert check.remedy.startswith("set zone = '+08:00' in [time]")
    assert "with times 8 h earlier" in check.found


@pytest.mark.parametrize("seed", range(3))
def test_right_clock_passes_under_clouds(seed):
    assert judge(DAY[WORK], 0.0, seed).passed
    assert judge(DAY, 0.0, seed).passed


def test_a_few_minutes_are_not_judged():
    assert judge(DAY[WORK][:30], 8.0).passed is None
