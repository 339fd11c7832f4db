"""Test the wind that meets a car: its sign, a side wind, and windows without a course."""

import numpy as np
import pandas as pd
import pytest

from socast.core.evaluate.compare.ride_wind import compute_window_headwind


@pytest.mark.parametrize(
    ("north", "east", "wind_from", "expected"),
    [(0.01, 0.0, 0.0, 10.0), (-0.01, 0.0, 0.0, -10.0), (0.0, 0.01, 90.0, 10.0), (0.0, 0.01, 0.0, 0.0),
     (0.0, -0.01, 90.0, -10.0), (1e-5, 0.0, 0.0, np.nan), (0.01, 0.0, np.nan, np.nan)],
)  # fmt: skip
def test_headwind_follows_course(north, east, wind_from, expected):
    window = pd.DataFrame(
        {
            "wind_speed_kmh": [10.0],
            "wind_from_deg": [wind_from],
            "latitude_start_deg": [45.0],
            "longitude_start_deg": [-73.0],
            "latitude_end_deg": [45.0 + north],
            "longitude_end_deg": [-73.0 + east],
        }
    )
    assert compute_window_headwind(window)[0] == pytest.approx(expected, abs=1e-9, nan_ok=True)
