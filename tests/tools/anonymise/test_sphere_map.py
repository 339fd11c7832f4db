"""A map of the sphere keeps distances, and turns headings alike."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.tools.anonymise.disguise import INVALID, find_centre, make_sphere_map, to_vector

LATITUDES, LONGITUDES = st.floats(-89.0, 89.0), st.floats(-180.0, 180.0)
PLACES = st.tuples(LATITUDES, LONGITUDES)


def measure_angle(one, other):
    """Return the angle between two places at the centre of the Earth. [rad]"""
    return float(np.linalg.norm(to_vector(*one) - to_vector(*other)))


def measure_heading(one, other):
    """Return the heading from a place to one close by. [deg]"""
    north = np.radians(other[0] - one[0])
    east = np.radians(other[1] - one[1]) * np.cos(np.radians(one[0]))
    return float(np.degrees(np.arctan2(east, north))) % 360.0


@given(centre=PLACES, to=PLACES, turn=st.floats(0.0, 360.0), one=PLACES, other=PLACES)
def test_distances_stay(centre, to, turn, one, other):
    places = make_sphere_map(centre, to, turn)
    assert measure_angle(places.move(*one), places.move(*other)) == pytest.approx(measure_angle(one, other), abs=1e-10)


@given(turn=st.floats(0.0, 360.0), heading=st.floats(0.0, 360.0))
def test_centre_moves_to_its_place_and_headings_there_turn(turn, heading):
    centre, to = (45.5, -73.6), (46.1, 31.7)
    places = make_sphere_map(centre, to, turn)
    assert places.move(*centre) == pytest.approx(to)
    north, east = 0.001 * np.cos(np.radians(heading)), 0.001 * np.sin(np.radians(heading))
    moved = places.move(45.5 + north, -73.6 + east / np.cos(np.radians(45.5)))
    assert (measure_heading(to, moved) - heading - turn + 180.0) % 360.0 == pytest.approx(180.0, abs=0.01)


ODD = st.sampled_from([0.0, -0.0, 91.0, -181.0, 1e300, float("inf"), float("nan")])


@given(places=st.lists(st.tuples(LATITUDES | ODD, LONGITUDES | ODD), min_size=1, max_size=20))
def test_positions_move_together_to_the_bits_to_which_each_moves_alone(places):
    sphere_map = make_sphere_map((45.5, -73.6), (45.0, 20.0), 77.0)
    together = sphere_map.move_all(*np.array(places).T)
    assert np.array_equal(together, np.array([sphere_map.move(*place) for place in places]).T)


@pytest.mark.parametrize(
    ("position", "moved"),
    [((91.0, -73.6), (INVALID, 0.0)), ((45.5, 181.0), (0.0, INVALID)), ((float("nan"), 5.0), (INVALID, 0.0))],
)
def test_position_that_is_not_on_earth_stays_off_it_and_tells_nothing(position, moved):
    assert make_sphere_map((45.5, -73.6), (45.0, 20.0), 77.0).move(*position) == moved


def test_position_of_receivers_without_a_fix_stays():
    assert make_sphere_map((45.5, -73.6), (45.0, 20.0), 77.0).move(0.0, 0.0) == (0.0, 0.0)


def test_centre_is_found_beside_wild_positions_and_across_the_date_line():
    latitude = np.array([45.0] * 9 + [0.001])
    assert find_centre(latitude, np.array([179.9] * 5 + [-179.9] * 4 + [0.0])) == pytest.approx((45.0, 180.0), abs=0.2)
