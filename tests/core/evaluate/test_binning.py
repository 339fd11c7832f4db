"""Test that each ride is in one bin of each property, and that local hours are solar hours."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from socast.core.evaluate.binning import bin_rides, compute_local_hour
from tests.support.planted_rides import planted


def test_each_ride_is_in_one_bin_of_each_known_property():
    rides = planted(200)
    rides.loc[3, "average_speed_kmh"] = np.nan
    result = bin_rides(rides)
    assert "driver" not in result
    assert "time of day" not in result  # these rides have no place
    for name, (codes, labels) in result.items():
        assert codes.max() < len(labels)
        assert (codes >= 0).sum() == 200 - (name == "speed")
    ambient = rides["ambient_c"].to_numpy()
    codes, labels = result["temperature"]
    low, high = np.array([[float(x) for x in labels[c].split(" to ")] for c in codes]).T
    assert np.all((low <= ambient) & (ambient < high))


@given(st.floats(1.4e9, 1.9e9), st.floats(-180.0, 180.0))
def test_local_hour_equals_solar_hour_within_half_an_hour(start, longitude):
    hour = compute_local_hour(np.array([start]), np.array([longitude]))[0]
    solar = (start / 3600.0 + longitude / 15.0) % 24.0
    assert 0.0 <= hour < 24.0
    assert abs((hour - solar + 12.0) % 24.0 - 12.0) <= 0.5 + 1e-6
