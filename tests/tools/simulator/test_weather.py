"""Test that the weather has seasons and persistence."""

from datetime import UTC, datetime

import numpy as np

from socast.tools.simulator.weather import compute_sun_height, make_sky


def test_weather_has_seasons_and_persistence():
    sky = make_sky(datetime(2018, 1, 1, tzinfo=UTC).timestamp(), 365, 3)
    month = np.array([datetime.fromtimestamp(t, UTC).month for t in sky.time])
    assert -16 < sky.temperature[month == 1].mean() < -4
    assert 17 < sky.temperature[month == 7].mean() < 25
    days = sky.temperature[: len(sky.temperature) // 24 * 24].reshape(-1, 24).mean(axis=1)
    normal = np.convolve(np.pad(days, 15, mode="edge"), np.ones(31) / 31, mode="valid")
    anomaly = days - normal
    assert 0.3 < np.corrcoef(anomaly[1:], anomaly[:-1])[0, 1] < 0.9
    wind = sky.wind_east
    assert np.corrcoef(wind[1:], wind[:-1])[0, 1] > 0.85
    wet = sky.precipitation > 0
    assert wet[1:][wet[:-1]].mean() > 3 * wet.mean()
    assert 600 < sky.precipitation.sum() < 1600
    assert sky.snow[month == 7].max() < 0.01 < sky.snow[month == 1].mean()
    assert sky.solar[compute_sun_height(sky.time) == 0].max() == 0
