"""Test when a vehicle-day of the running error ends."""

import math

import pytest

from socast.core.models import EXTENDED_PHYSICAL
from socast.core.monitoring.running_error import ModelMonitor


def test_vehicle_day_ends_at_an_unpredicted_ride_of_the_next_day():
    monitor = ModelMonitor(EXTENDED_PHYSICAL, 0.95)
    monitor.add_ride(3, 10.0, None, 0.1, 0.3, 1.0)
    monitor.add_ride(3, 11.0, None, math.nan, 0.3, 1.0)
    gain = monitor.get_errors("first/1", 0.0).overall.gain
    assert (gain.rides, gain.vehicle_days, gain.mean_kwh) == (1, 1, pytest.approx(0.2))
