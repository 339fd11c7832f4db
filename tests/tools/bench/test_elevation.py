"""Test the truth, the coarse map and the page of the measure of elevation."""

from datetime import UTC, datetime

import numpy as np
import pytest

from socast.stream.elevation_tiles import TILE_SD
from socast.tools.bench import elevation
from socast.tools.simulator.world import compute_elevation, to_wgs84


@pytest.fixture(scope="module")
def day():
    return elevation.simulate_days(3, datetime(2018, 3, 19, tzinfo=UTC), 1)


def test_true_climb_of_a_ride_is_that_of_its_gains_and_losses(day):
    messages, truth = day
    rides, windows = elevation.tabulate(messages, None, two_sided=True)
    climb, gained = truth.find_climbs(rides)
    assert (gained >= np.maximum(climb, 0.0) - 1e-9).all()
    summed = sum(ride["gained_m"] for ride in truth.rides)
    assert gained.sum() == pytest.approx(summed, rel=0.15)
    figures = elevation.measure_climb(rides, windows, truth)
    assert 0.5 < figures["climb_m"] < 3.0
    assert figures["gained"] == pytest.approx(1.0, abs=0.1)


def test_smoothing_reduces_the_error_of_the_climb(day):
    messages, truth = day
    causal, smoothed = (
        elevation.measure_climb(*elevation.tabulate(messages, None, two_sided=way), truth)["climb_m"]
        for way in (False, True)
    )
    assert smoothed < 0.8 * causal


def test_tile_has_the_ground_with_offset_and_stated_error():
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-8_000.0, 8_000.0, (2, 4000))
    latitude, longitude = np.radians(to_wgs84(x, y))
    ground = elevation.make_tile(3).find_ground(latitude, longitude)
    error = ground.elevation - compute_elevation(x, y)
    assert error.mean() == pytest.approx(elevation.TILE_OFFSET, abs=0.3)
    assert 0.5 * TILE_SD < error.std() < TILE_SD
    assert np.sqrt(ground.variance) == pytest.approx(TILE_SD)


def test_page_compares_each_kind_with_causal_elevation_without_a_map():
    figures = {"climb_m": 2.0, "climb_all_m": 3.0, "gained": 0.99, "mae_kwh": 0.1}
    fleet = {f"{name}, {way}": dict(figures) for name in elevation.MAPS for way in elevation.WAYS}
    fleet["learned map, smoothed"]["climb_m"] = 0.5
    fleet["soc_mae_pct"] = {"no map": 1.5, "learned map": 1.25}
    page = "\n".join(elevation.make_lines({7: fleet}))
    assert "| learned map, smoothed | 0.50 | -75 % | 3.00 | -1.0 % | 0.1000 |" in page
    assert "| learned map | 1.25 |" in page
