"""Test the lookup of elevation on maps."""

import numpy as np
import pytest

from socast.core.cleaning.elevation_map import ElevationMap, ElevationPlaces, ElevationRaster, MapLookup, name_tile
from tests.support.telemetry import decoded, drive, telemetry

STEP = 1e-5


def plane(sd=1.0, unknown=(), start=0.0):
    """Return a grid of ten by ten nodes whose elevation is 10 m a row and 1 m a column."""
    row, column = np.mgrid[0:10, 0:10]
    elevation = 10.0 * row + column
    for node in unknown:
        elevation[node] = -32768
    return ElevationRaster(start, start, STEP, STEP, elevation, -32768, sd)


def places(elevation=10.0, sd=1.0, size=3):
    row, column = (each.ravel() for each in np.mgrid[0:size, 0:size])
    ones = np.ones(size * size)
    return ElevationPlaces(STEP, STEP, row, column, elevation * row + column, sd * ones, ones)


@pytest.mark.parametrize("layer", [plane(), places(size=10)], ids=["raster", "places"])
def test_interpolation_is_exact_on_a_plane(layer):
    y, x = np.random.default_rng(0).uniform(0.0, 8.9, (2, 50))
    ground = layer.find_ground(y * STEP, x * STEP)
    np.testing.assert_allclose(ground.elevation, 10.0 * y + x, atol=1e-9)
    np.testing.assert_allclose(ground.variance, 1.0)


@pytest.mark.parametrize("layer", [plane(unknown=[(2, 2)]), plane()], ids=["void", "outside"])
def test_place_with_an_unknown_node_or_outside_is_unknown(layer):
    at = {"void": 1.5, "outside": 20.0}["void" if layer.elevation[2, 2] < 0 else "outside"]
    ground = layer.find_ground(np.array([at, 5.0, np.nan]) * STEP, np.array([at, 5.0, 5.0]) * STEP)
    assert np.isnan(ground.elevation).tolist() == [True, False, True]
    assert np.isnan(ground.variance).tolist() == [True, False, True]


def test_half_a_step_beyond_a_raster_has_the_elevation_of_its_edge():
    ground = plane().find_ground(np.array([-0.4, 9.4, -0.6]) * STEP, np.array([5.0, 5.0, 5.0]) * STEP)
    np.testing.assert_allclose(ground.elevation, [5.0, 95.0, np.nan])


def test_places_without_nodes_know_nothing():
    none = np.empty(0, np.int64)
    empty = ElevationPlaces(STEP, STEP, none, none, none, none, none)
    assert np.isnan(empty.find_ground(np.zeros(2), np.zeros(2)).elevation).all()


def test_places_need_no_order():
    nodes = places()
    shuffled = ElevationPlaces(
        STEP, STEP, *(getattr(nodes, name)[::-1] for name in ("row", "column", "elevation", "sd", "fixes"))
    )
    assert shuffled.digest() == nodes.digest()


def test_layers_are_combined_by_inverse_variance():
    both = ElevationMap([plane(sd=1.0), plane(sd=2.0)._replace(elevation=plane().elevation + 5.0)])
    ground = both.find_ground(np.array([STEP]), np.array([0.0]))
    assert ground.elevation == pytest.approx([10.0 + 5.0 / 5.0])
    assert ground.variance == pytest.approx([1.0 / (1.0 + 0.25)])


def test_second_layer_serves_where_the_first_knows_nothing():
    both = ElevationMap([plane(), plane(sd=3.0, start=1.0)])
    ground = both.find_ground(np.array([STEP, 1.0 + STEP]), np.array([0.0, 1.0]))
    np.testing.assert_allclose(ground.elevation, [10.0, 10.0])
    np.testing.assert_allclose(ground.variance, [1.0, 9.0])


def test_identity_follows_the_content():
    assert ElevationMap([plane()]).identity == ElevationMap([plane()]).identity
    others = [[plane(sd=2.0)], [plane(unknown=[(0, 0)])], [places()], [plane(), places()]]
    assert len({ElevationMap(layers).identity for layers in [[plane()], *others]}) == 5


def test_fixes_outside_are_counted_by_tile_and_invalid_fixes_are_not():
    columns = drive(
        6, latitude_deg=[45.5, 45.5, 0.0, np.nan, -0.5, 200.0], longitude_deg=[-73.6, 10.0, 0.0, 1.0, 0.5, 1.0]
    )
    lookup = MapLookup(ElevationMap([plane(start=np.radians(45.5))]))
    lookup.find_ground(decoded(telemetry(columns)))
    tiles = {"N45W074": 1, "N45E010": 1, "S01E000": 1}
    assert lookup.count_fixes() == {
        "elevation_map": {"fixes": 3, "outside": 3, "outside_by_tile": dict(sorted(tiles.items()))}
    }
    other = MapLookup(ElevationMap([plane(start=np.radians(45.5))]))
    assert other.load(lookup.dump()) is False
    assert other.count_fixes() == lookup.count_fixes()


def test_lookup_without_a_map_finds_and_counts_nothing():
    lookup = MapLookup(None)
    assert lookup.find_ground(decoded(telemetry(drive(3)))) is None
    assert lookup.count_fixes() == {}
    assert lookup.load(MapLookup(ElevationMap([plane()])).dump()) is True


def test_tiles_are_named_by_their_south_western_corner():
    assert [name_tile(45, -74), name_tile(-1, 0), name_tile(0, 179)] == ["N45W074", "S01E000", "N00E179"]
