"""Test that routes follow streets, and that the ground is smooth."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.tools.simulator.world import (
    EXPRESSWAYS,
    compute_elevation,
    draw_destination,
    find_crossing,
    is_in_tunnel,
    make_route,
    to_wgs84,
)


@given(st.integers(0, 10_000), st.floats(400, 25_000))
def test_routes_follow_streets(seed, distance):
    rng = np.random.default_rng(seed)
    start = find_crossing(float(rng.uniform(-9000, 9000)), float(rng.uniform(-6000, 6000)))
    goal = draw_destination(*start, distance, rng)
    way = make_route(start, goal, rng)
    assert goal != start
    for line in EXPRESSWAYS:
        assert abs(goal[1 - line.axis] - line.at) > 100
        turns = np.abs((way.v, way.u)[line.axis] - line.at) < 5
        turns &= np.append(False, way.turn)
        assert not is_in_tunnel(way.u, way.v, np.full(len(way.u), line.axis * np.pi / 2))[turns].any()
    assert (way.u[0], way.v[0]) == start
    assert (way.u[-1], way.v[-1]) == goal
    assert (np.minimum(np.abs(np.diff(way.u)), np.abs(np.diff(way.v))) < 1e-9).all()
    assert (np.diff(way.along) > 0).all()
    assert len(way.limit) == len(way.turn) == len(way.along) - 1


def test_ground_is_smooth_with_a_hill_in_the_centre():
    x = np.arange(-9000.0, 9000.0, 10.0)
    for y in (-4000.0, 0.0, 2500.0):
        slope = np.diff(compute_elevation(x, np.full_like(x, y))) / 10.0
        assert np.abs(slope).max() < 0.12
        assert np.abs(np.diff(slope)).max() < 0.01
    middle = compute_elevation(np.zeros(1), np.zeros(1))[0]
    assert middle > 150 + compute_elevation(np.array([6000.0]), np.array([4000.0]))[0]
    latitude, longitude = to_wgs84(np.zeros(1), np.zeros(1))
    assert (latitude[0], longitude[0]) == pytest.approx((45.5, -73.6), abs=0.02)


def test_tunnels_lie_on_expressways():
    assert sum(len(line.tunnels) for line in EXPRESSWAYS) >= 3
    assert all(900 <= 1.2 * (end - begin) < 2000 for line in EXPRESSWAYS for begin, end in line.tunnels)
