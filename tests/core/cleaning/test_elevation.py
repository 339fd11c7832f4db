"""Test how the fixes of a car and a map make its elevation and climb."""

import numpy as np
import pytest

from socast.core.batch import Lanes
from socast.core.cleaning.elevation_map import ElevationMap, ElevationRaster
from socast.core.cleaning.elevation_smoother import smooth_elevation
from socast.core.cleaning.kernel import Cleaner
from socast.core.cleaning.quality import Quality
from socast.core.pipeline import Pipeline
from socast.core.settings import Settings
from tests.support.ground import hills, hilly_drive
from tests.support.telemetry import PLACE, count, decoded, drive, joined, ran, telemetry, without


def map_of_hills(sd=0.2, reach=12_000.0):
    """Return a map of the hills about the place where drives begin, with nodes 40 m apart."""
    step = 40.0 / 6_371_008.8
    nodes = int(reach / 40.0)
    south, west = np.radians(PLACE[0]) - step * nodes, np.radians(PLACE[1]) - step * nodes
    latitude, longitude = south + step * np.arange(2 * nodes), west + step * np.arange(2 * nodes)
    elevation = hills(latitude[:, None], longitude[None, :])
    return ElevationMap([ElevationRaster(south, west, step, step, elevation, np.nan, sd)])


def clean(columns, elevation_map=None):
    return Cleaner(Settings(), elevation_map).clean(decoded(telemetry(without(columns, "truth"))), 1)


def climb_error(columns, elevation_map):
    """Return the standard deviation of the error of the climb since the start. [m]"""
    result = clean(columns, elevation_map)
    return float(np.std(np.cumsum(result.climb) - columns["truth"]))


def test_map_reduces_the_climb_error():
    columns = hilly_drive()
    assert climb_error(columns, map_of_hills()) < 0.3 * climb_error(columns, None)


def test_car_that_sends_no_elevation_climbs_by_the_map():
    columns = without(hilly_drive(), "elevation_m")
    assert clean(columns).climb.tolist() == [0.0] * 300
    assert climb_error(columns, map_of_hills()) < 0.6


def test_constant_offset_of_the_logger_makes_no_climb():
    inside, beyond = clean(hilly_drive(), map_of_hills()), clean(hilly_drive(offset=35.0), map_of_hills())
    np.testing.assert_allclose(np.cumsum(beyond.climb), np.cumsum(inside.climb), atol=0.1)


def test_car_that_leaves_the_map_keeps_the_datum_of_the_map():
    columns = hilly_drive(offset=35.0)
    result = clean(columns, map_of_hills(reach=2000.0))
    assert abs(result.climb).max() < 8.0
    assert np.abs(result.elevation - columns["truth"]).max() < 12.0


def map_from_row(columns, row, sd=0.2):
    """Return the map of the hills without its part south of where a drive is at a row, and its edge's latitude."""
    layer = map_of_hills(sd).layers[0]
    south = np.radians(columns["latitude_deg"][row])
    below = int(np.ceil((south - layer.south) / layer.step_latitude))
    south = layer.south + below * layer.step_latitude
    return ElevationMap([layer._replace(south=south, elevation=layer.elevation[below:])])


@pytest.mark.parametrize("offset", [35.0, -80.0, 0.0])
def test_first_contact_with_a_map_within_a_ride_is_no_climb(offset):
    columns = hilly_drive(offset=offset)
    result, alone = clean(columns, map_from_row(columns, 120)), clean(columns)
    assert np.abs(result.climb).max() < 8.0
    np.testing.assert_array_equal(result.climb[:115], alone.climb[:115])
    np.testing.assert_allclose(result.climb[115:].sum(), columns["truth"][-1] - columns["truth"][115], atol=8.0)
    assert np.abs(result.elevation - columns["truth"])[125:].max() < 8.0


def test_first_contact_without_a_fix_or_with_a_wrong_one_is_no_climb():
    columns = hilly_drive(offset=35.0)
    on_map = map_from_row(columns, 120)
    for value in (np.nan, columns["elevation_m"][120] + 300.0):
        spoiled = columns | {"elevation_m": columns["elevation_m"].copy()}
        spoiled["elevation_m"][118:123] = value
        result = clean(spoiled, on_map)
        before = 117 if np.isnan(value) else 125  # a wrong fix outside a map is followed
        assert np.abs(result.climb[before:]).max() < 8.0
        assert np.abs(result.elevation - columns["truth"])[135:].max() < 8.0


def test_noise_of_a_survey_is_reduced_by_the_fixes():
    layer = map_of_hills(sd=3.0).layers[0]
    noise = np.random.default_rng(1).normal(0.0, 3.0, layer.elevation.shape)
    survey = ElevationMap([layer._replace(elevation=layer.elevation + noise)])
    columns = hilly_drive()
    assert climb_error(columns, survey) < climb_error(columns, None)
    assert climb_error(columns, survey) < climb_error(without(columns, "elevation_m"), survey)


def test_gross_error_of_a_fix_makes_no_climb_on_the_map():
    columns = hilly_drive()
    columns["elevation_m"][100:103] += 80.0
    expected, result = clean(hilly_drive(), map_of_hills()), clean(columns, map_of_hills())
    np.testing.assert_allclose(result.climb, expected.climb, atol=0.15)


def test_another_offset_is_accepted_after_a_few_fixes():
    columns = hilly_drive(n=600)
    columns["elevation_m"][100:] += 40.0
    result = clean(columns, map_of_hills(reach=5000.0))  # 5 km is passed at row 139
    assert np.abs(result.elevation - columns["truth"])[100:].max() < 12.0


def test_map_is_not_used_at_a_fix_that_is_held_back():
    columns = hilly_drive()
    columns["latitude_deg"][100] += 0.02  # 2.2 km
    expected, result = clean(hilly_drive(), map_of_hills()), clean(columns, map_of_hills())
    assert np.abs(result.elevation - expected.elevation).max() < 3.0


def test_without_a_map_nothing_changes_and_a_map_elsewhere_changes_nothing():
    columns = hilly_drive()
    elsewhere = ElevationMap([map_of_hills().layers[0]._replace(south=0.2)])
    for one, other in zip(clean(columns), clean(columns, elsewhere), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("cuts", [range(0, 400, 7), (123,), range(400)], ids=["sevens", "two", "single"])
def test_any_chunking_gives_the_same_rides_with_a_map(cuts):
    columns = without(joined(hilly_drive(n=200, offset=9.0), hilly_drive(n=200, seed=2)), "truth")
    columns["time_s"] = columns["time_s"][0] + 3.0 * np.arange(400)
    columns["seq"] = np.arange(400)
    messages = telemetry(columns)
    whole, expected = ran(messages, elevation_map=map_of_hills(2500.0))
    parts, out = ran(messages, cuts, elevation_map=map_of_hills(2500.0))
    assert out == expected
    assert parts.take_windows().equals(whole.take_windows())
    assert parts.quality() == whole.quality()


def test_restart_with_the_same_map_changes_no_result():
    messages = telemetry(without(hilly_drive(offset=9.0), "truth"))
    whole, expected = ran(messages, elevation_map=map_of_hills())
    first, second = Pipeline(elevation_map=map_of_hills()), Pipeline(elevation_map=map_of_hills())
    out = first.push(messages[:150])
    second.restore(first.snapshot())
    assert not second.totals.cleaner.has_new_map
    assert [*out, *second.push(messages[150:]), *second.finish()] == expected
    assert second.take_rides().equals(whole.take_rides())


def test_restart_with_another_map_makes_no_climb():
    messages = telemetry(without(hilly_drive(offset=35.0), "truth"))
    first, second = Pipeline(), Pipeline(elevation_map=map_of_hills())
    first.push(messages[:150])
    second.restore(first.snapshot())
    assert second.totals.cleaner.has_new_map
    state = second.totals.cleaner.state
    assert np.isnan(state["elevation"]).all()
    assert np.isnan(state["offset_variance"]).all()
    second.push(messages[150:])
    second.finish()
    (ride,) = second.take_rides().to_dict("records")
    whole, _ = ran(messages, elevation_map=map_of_hills())
    assert ride["gained_m"] == pytest.approx(whole.take_rides()["gained_m"].item(), abs=15.0)


def test_lanes_have_offsets_of_their_own():
    cleaner, lanes = Cleaner(Settings(), map_of_hills()), Lanes(["a", "b"])
    one, other = (telemetry(without(hilly_drive(offset=off), "truth"), car) for car, off in (("a", 0.0), ("b", 20.0)))
    batch = decoded([message for pair in zip(one, other, strict=True) for message in pair])
    cleaner.clean(batch, len(lanes))
    np.testing.assert_allclose(cleaner.state["elevation_offset"][:2], [0.0, 20.0], atol=1.5)


def cliff(slope, length=650.0, in_tunnel=True):
    """Return a level drive whose elevation rises by a slope over a stretch, which may be a tunnel."""
    columns = drive(400, speed=10.0)
    run = np.clip(columns["metres"] - 3000.0, 0.0, length)
    columns["elevation_m"] = 500.0 + slope * run
    if in_tunnel:
        inside = (run > 0.0) & (run < length)
        for name in ("latitude_deg", "longitude_deg", "elevation_m"):
            columns[name] = np.where(inside, np.nan, columns[name])
    return columns | {"truth": columns["metres"]}


@pytest.mark.parametrize("in_tunnel", [True, False], ids=["tunnel", "fixes"])
@pytest.mark.parametrize("slope", [0.45, -0.45, 2.0])
def test_slope_that_no_road_has_is_no_climb(slope, in_tunnel):
    result = clean(cliff(slope, in_tunnel=in_tunnel))
    for rows in (result, smooth_elevation(result)):
        assert np.abs(rows.climb).sum() < 35.0
        assert rows.elevation[-1] == pytest.approx(500.0 + 650.0 * slope, abs=1.0)
    assert count(result, Quality.SLOPE_REJECTED) >= 5


@pytest.mark.parametrize("in_tunnel", [True, False], ids=["tunnel", "fixes"])
@pytest.mark.parametrize("slope", [0.08, -0.15, 0.25])
def test_steep_road_keeps_its_climb(slope, in_tunnel):
    result = clean(cliff(slope, in_tunnel=in_tunnel))
    for rows in (result, smooth_elevation(result)):
        assert rows.climb.sum() == pytest.approx(650.0 * slope, rel=0.04)
    assert count(result, Quality.SLOPE_REJECTED) == 0


@pytest.mark.parametrize(("slope", "climb"), [(0.07, 63.0), (-0.07, -63.0)])
def test_elevation_that_a_receiver_held_over_a_hill_is_a_climb(slope, climb):
    columns = drive(400, speed=10.0)
    run = np.clip(columns["metres"] - 3000.0, 0.0, 900.0)
    hills = 10.0 * np.sin(columns["metres"] / 300.0)
    columns["elevation_m"] = 500.0 + hills + np.where(run < 900.0, 0.0, slope * run)
    inside = (run > 0.0) & (run < 900.0)
    columns["elevation_m"][inside] = columns["elevation_m"][np.flatnonzero(inside)[0]]
    result = clean(columns)
    for rows in (result, smooth_elevation(result)):
        assert rows.climb.sum() == pytest.approx(climb + hills[-1] - hills[0], abs=6.0)


def test_level_after_a_night_is_taken_at_once():
    columns = drive(400, speed=10.0, elevation_m=500.0)
    columns["time_s"][200:] += 39_000.0
    columns["seq"][200:] += 13_000
    columns["elevation_m"][200:] = 463.0
    result = clean(columns)
    assert count(result, Quality.SLOPE_REJECTED) == 0
    assert result.elevation[201:] == pytest.approx(463.0, abs=0.1)
    assert np.abs(result.climb).sum() == 0.0
