"""Test the elevation of the sun against closed forms and an almanac."""

from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.signals.sun import sine_of_elevation


def elevation(times, latitude, longitude):
    """Return the elevation of the sun. [deg]"""
    times = np.atleast_1d(np.asarray(times, float))
    place = np.full(len(times), np.radians(latitude)), np.full(len(times), np.radians(longitude))
    return np.degrees(np.arcsin(np.clip(sine_of_elevation(times, *place), -1, 1)))


def at(*when):
    return datetime(*when, tzinfo=UTC).timestamp()


@pytest.mark.parametrize(
    ("day", "declination"),
    [((2024, 6, 20), 23.44), ((2024, 12, 21), -23.44), ((2024, 3, 20), 0.0), ((2024, 9, 22), 0.2)],
)
@pytest.mark.parametrize("latitude", [-35.0, 0.0, 45.5, 60.0])
def test_noon_elevation_follows_from_latitude_and_declination(day, declination, latitude):
    day_long = at(*day) + np.arange(0, 86_400, 60.0)
    assert elevation(day_long, latitude, 0.0).max() == pytest.approx(90 - abs(latitude - declination), abs=0.25)


@pytest.mark.parametrize(("day", "declination"), [((2024, 6, 20), 23.44), ((2024, 12, 21), -23.44)])
def test_length_of_day_follows_from_the_hour_angle(day, declination):
    """The hour angle H follows from cos H = -tan φ tan δ, and daylight lasts 2 H / 15 hours."""
    day_long = at(*day) + np.arange(0, 86_400, 60.0)
    up = np.mean(elevation(day_long, 45.5, 0.0) > 0) * 24
    angle = np.degrees(np.arccos(-np.tan(np.radians(45.5)) * np.tan(np.radians(declination))))
    assert up == pytest.approx(2 * angle / 15, abs=0.05)


def test_noon_moves_with_longitude_and_the_equation_of_time():
    """The sun is 14 minutes late on 11 February, and 16 minutes early on 3 November."""
    for when, late in (((2024, 2, 11), 14.2), ((2024, 11, 3), -16.4)):
        minutes = np.arange(600, 840, 0.25)
        noon = minutes[np.argmax(elevation(at(*when) + 60 * minutes, 45.5, 0.0))]
        assert noon - 720 == pytest.approx(late, abs=0.5)
        east = minutes[np.argmax(elevation(at(*when) + 60 * minutes, 45.5, 15.0))]
        assert noon - east == pytest.approx(60, abs=0.5)


def test_sunrise_and_sunset_in_montreal_in_january_agree_with_the_almanac():
    """At sunset, the upper rim of the sun, lifted by refraction, is at the horizon: its centre is at -0.83 degrees."""
    assert elevation(at(2024, 1, 15, 21, 38), 45.5, -73.6)[0] == pytest.approx(-0.83, abs=0.4)
    assert elevation(at(2024, 1, 15, 12, 31), 45.5, -73.6)[0] == pytest.approx(-0.83, abs=0.4)


@given(st.floats(0, 4e9), st.floats(-90, 90), st.floats(-180, 180))
def test_result_is_a_sine_and_opposite_at_the_antipode(time, latitude, longitude):
    here = sine_of_elevation(np.array([time]), np.radians([latitude]), np.radians([longitude]))[0]
    there = sine_of_elevation(np.array([time]), np.radians([-latitude]), np.radians([longitude + 180]))[0]
    assert abs(here) <= 1 + 1e-12
    assert there == pytest.approx(-here, abs=1e-9)


def test_unknown_position_gives_nan():
    assert np.isnan(sine_of_elevation(np.array([1e9]), np.array([np.nan]), np.array([0.0])))[0]
