"""Test the two-sided elevation against filterpy, planted hills, and every gap that the fixes of a ride may have."""

import numpy as np
import pytest

from socast.core.cleaning.elevation_filter import LENGTH, RideSteps
from socast.core.cleaning.elevation_smoother import (
    CORRELATION_TIME,
    ROUGHNESS,
    find_noise,
    smooth_elevation,
    smooth_ride,
    smooth_rides,
)
from socast.tools.verify.differences import measure_differences
from socast.tools.verify.elevation_steps import get_estimates
from socast.tools.verify.elevation_witness import smooth_with_filterpy
from socast.tools.verify.records import GOAL
from tests.support.telemetry import PERIOD, cleaned, drive, joined, picked

WHITE = 1e-9
"""Correlation time of an error that is white. [s]"""


def ride(n=300, seed=1, sd=2.0, keep=0.37, height=60.0):
    """Return a drive over hills 3 km long, with fixes whose errors are correlated, and the true elevation."""
    columns = drive(n, seed=seed)
    truth = height + 30.0 * np.sin(columns["metres"] * 2 * np.pi / 3000.0)
    rng = np.random.default_rng(seed)
    error = np.zeros(n)
    for i, draw in enumerate(rng.normal(size=n)):
        error[i] = draw if i == 0 else keep * error[i - 1] + np.sqrt(1 - keep**2) * draw
    return columns | {"elevation_m": np.round(truth + sd * error, 1)}, truth


def make_steps(distance, time, fix):
    """Return the steps of a ride without a map."""
    return RideSteps(distance, time, fix, *np.full((2, len(fix)), np.nan))


def get_steps(clean):
    """Return the steps of cleaned rows of one ride."""
    return RideSteps(clean.distance, clean.dt, clean.elevation_fix, clean.ground, clean.ground_variance)


def compute_rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


# Against filterpy


@pytest.mark.parametrize(("seed", "missing"), [(1, 0.0), (2, 0.3), (3, 0.8)])
@pytest.mark.parametrize("correlation_time", [WHITE, 4.0, 20.0])
def test_smoother_equals_filterpy(seed, missing, correlation_time):
    rng = np.random.default_rng(seed)
    n = 60
    distance = np.where(rng.random(n) < 0.3, 0.0, rng.gamma(1.0, 40.0, n))
    distance[[0, 30]] = 0.0, 1300.0
    time = rng.choice([3.0, 6.0], n)
    fix = 50.0 + np.cumsum(0.02 * distance) + rng.normal(0.0, 2.0, n)
    fix[1:][rng.random(n - 1) < missing] = np.nan
    noise = (1e-5, 6.0, correlation_time)  # no fix is beyond the gate
    smoothed = smooth_ride(make_steps(distance, time, fix), noise)
    exact = smooth_with_filterpy(make_steps(distance, time, fix), noise)
    assert max(measure_differences(*get_estimates(smoothed), *exact)) < GOAL


# Maps


def map_steps(n=400, coarse=4, ground_sd=3.0, sd=3.0, seed=1):
    """Return the steps of a ride on a map with nodes `coarse` rows apart, whose errors are independent, and the truth.

    The slope of the road is a random walk that returns to level over `LENGTH`.
    """
    rng = np.random.default_rng(seed)
    distance = np.full(n, 25.0)
    slope = np.zeros(n)
    for i in range(1, n):
        slope[i] = slope[i - 1] * np.exp(-25.0 / LENGTH) + np.sqrt(1e-5 * 25.0) * rng.normal()
    truth = 60.0 + np.cumsum(25.0 * slope)
    nodes = rng.normal(0.0, ground_sd, n // coarse + 2)
    error = np.interp(np.arange(n) / coarse, np.arange(len(nodes)), nodes)
    fix = truth + rng.normal(0.0, sd, n) + 12.0
    return RideSteps(distance, np.full(n, PERIOD), fix, truth + error, np.full(n, ground_sd**2)), truth


def smooth_whole(steps):
    """Return the smoothed climbs of a ride."""
    heights, climbs = np.zeros((2, len(steps.fix)))
    smooth_rides(np.stack(steps), np.array([0, len(steps.fix)]), heights, climbs)
    return climbs


def compute_climb_error(steps, truth):
    """Return the error of the climb over ten rows. [m]"""
    starts = np.arange(10, len(truth), 10)
    return compute_rms(np.add.reduceat(smooth_whole(steps) - np.diff(truth, prepend=truth[0]), starts)[:-1])


@pytest.mark.parametrize(("ground_sd", "most"), [(3.0, 1.0), (0.3, 0.5)])
def test_map_reduces_the_error_of_the_climb_by_its_uncertainty(ground_sd, most):
    ratios = []
    for seed in range(12):
        steps, truth = map_steps(ground_sd=ground_sd, seed=seed)
        alone = steps._replace(ground=np.full(len(truth), np.nan))
        ratios.append(compute_climb_error(steps, truth) / compute_climb_error(alone, truth))
    assert np.mean(ratios) < most


def test_uncertain_map_has_no_weight_and_a_certain_one_decides():
    steps, truth = map_steps(ground_sd=3.0)
    alone = smooth_whole(steps._replace(ground=np.full(len(truth), np.nan)))
    far = smooth_whole(steps._replace(ground_variance=np.full(len(truth), 1e6)))
    np.testing.assert_allclose(far, alone, atol=0.3)
    exact = steps._replace(ground=truth, ground_variance=np.full(len(truth), 1e-4))
    assert compute_rms(smooth_whole(exact)[5:] - np.diff(truth)[4:]) < 0.3


def test_edge_of_a_map_with_an_offset_is_no_climb():
    steps, truth = map_steps(ground_sd=0.5)
    for known in (slice(0, 200), slice(200, None), slice(150, 250)):
        ground = np.full(len(truth), np.nan)
        ground[known] = steps.ground[known] - 40.0
        climbs = smooth_whole(steps._replace(ground=ground))
        assert np.abs(np.cumsum(climbs - np.diff(truth, prepend=truth[0]))).max() < 12.0


def test_car_without_fixes_climbs_by_the_map():
    steps, truth = map_steps(ground_sd=0.5)
    climbs = smooth_whole(steps._replace(fix=np.full(len(truth), np.nan)))
    assert compute_rms(np.cumsum(climbs[1:]) - (truth[1:] - truth[0])) < 1.0


def test_change_of_reference_on_a_map_is_ignored():
    steps, truth = map_steps(ground_sd=0.5)
    steps.fix[250:] += 60.0
    climbs = smooth_whole(steps)
    assert np.abs(climbs - np.diff(truth, prepend=truth[0]))[1:].max() < 1.0


# Noise


def test_noise_of_the_fixes_is_recovered():
    estimates = []
    for seed in range(8):
        clean = cleaned(ride(600, seed)[0])
        noise = find_noise(get_steps(clean))
        estimates.append(noise[1:])
    sd, correlation_time = np.median(estimates, axis=0)
    assert sd == pytest.approx(2.0, rel=0.3)
    assert correlation_time == pytest.approx(PERIOD, rel=1.0)


def test_rough_terrain_has_a_larger_roughness_than_level_ground():
    def roughness(columns):
        clean = cleaned(columns)
        return find_noise(get_steps(clean))[0]

    hills, truth = ride(600)
    level = hills | {"elevation_m": hills["elevation_m"] - truth + 60.0}
    assert roughness(hills) > 3.0 * roughness(level)


def test_ride_with_few_fixes_has_the_usual_noise():
    fix = np.full(20, np.nan)
    fix[[3, 15]] = 40.0, 41.0
    noise = find_noise(make_steps(np.full(20, 30.0), np.full(20, PERIOD), fix))
    assert noise[0] == pytest.approx(ROUGHNESS, rel=10.0)
    assert noise[2] == pytest.approx(CORRELATION_TIME, rel=2.0)


# Whole rides


def test_climb_is_nearer_the_truth_than_the_causal_one():
    ratios = []
    for seed in range(6):
        columns, truth = ride(400, seed)
        clean = smooth_elevation(cleaned(columns))
        windows = np.arange(0, 400, 20)
        errors = [
            np.add.reduceat(climb - np.diff(truth, prepend=truth[0]), windows)
            for climb in (clean.climb, clean.causal_climb)
        ]
        ratios.append(compute_rms(errors[0]) / compute_rms(errors[1]))
    assert np.mean(ratios) < 0.6


def test_gained_height_is_that_of_the_hills():
    gained, true = 0.0, 0.0
    for seed in range(10):
        columns, truth = ride(600, 50 + seed)
        gained += np.maximum(smooth_elevation(cleaned(columns)).climb, 0.0).sum()
        true += np.maximum(np.diff(truth), 0.0).sum()
    assert gained == pytest.approx(true, rel=0.05)


def test_elevation_changes_by_the_climb_in_every_step():
    clean = smooth_elevation(cleaned(ride()[0]))
    np.testing.assert_allclose(np.diff(clean.elevation), clean.climb[1:], atol=1e-9)


def test_standing_car_climbs_nothing_and_averages_its_fixes():
    rng = np.random.default_rng(2)
    columns = drive(400, speed=np.where((np.arange(400) > 150) & (np.arange(400) < 250), 0.0, 10.0))
    columns["elevation_m"] = 50.0 + rng.normal(0.0, 3.0, 400)
    clean = smooth_elevation(cleaned(columns))
    stands = clean.distance == 0.0
    assert stands.sum() > 90
    assert np.all(clean.climb[stands] == 0.0)
    assert clean.elevation[200] == pytest.approx(columns["elevation_m"][155:245].mean(), abs=0.5)


def test_height_is_interpolated_where_fixes_are_missing():
    columns, truth = ride(400, sd=0.5)
    columns["elevation_m"][150:165] = np.nan
    clean = smooth_elevation(cleaned(columns))
    assert np.abs(clean.elevation - truth)[150:165].max() < 3.0


def test_tunnel_is_climbed_although_its_fixes_are_frozen():
    columns, _ = ride(300, seed=3, sd=1.0)
    columns["speed_kmh"][100:130] = 60.0
    columns["metres"] = np.concatenate([[0.0], np.cumsum(np.diff(columns["metres"]))])
    for name in ("latitude_deg", "longitude_deg", "elevation_m"):
        columns[name][100:130] = columns[name][99]
    clean = smooth_elevation(cleaned(columns))
    assert np.isnan(clean.elevation_fix[101:130]).all()
    assert np.abs(clean.climb).sum() > 0.0
    assert np.abs(np.diff(clean.elevation[100:130])).max() < 5.0


def test_ends_of_a_ride_without_fixes_stay_near_the_nearest_fix():
    columns, _ = ride(400, sd=1.0)
    columns["elevation_m"][:30] = columns["elevation_m"][-100:] = np.nan
    clean = smooth_elevation(cleaned(columns))
    assert np.isfinite(clean.climb).all()
    assert np.abs(clean.elevation[-100:] - clean.elevation[-101]).max() < LENGTH * 0.05


def test_car_without_elevation_keeps_its_columns():
    clean = cleaned(drive(100))
    smoothed = smooth_elevation(clean)
    assert np.all(smoothed.climb == 0.0)
    assert np.isnan(smoothed.elevation).all()


def test_wrong_fixes_make_no_hills():
    columns, truth = ride(400, sd=1.0)
    columns["elevation_m"][[0, 120, 121, 300]] += 400.0
    clean = smooth_elevation(cleaned(columns))
    assert compute_rms(clean.elevation - truth) < 2.0


def jump(height=100.0, at=200, seed=4):
    """Return a drive over level ground, the reference of whose fixes changes at a row."""
    columns = drive(400, speed=10.0)
    level = np.where(np.arange(400) < at, 50.0, 50.0 + height)
    return columns | {"elevation_m": level + np.random.default_rng(seed).normal(0, 1.0, 400)}


@pytest.mark.parametrize("height", [100.0, -60.0])
def test_change_of_reference_is_followed_and_is_no_climb(height):
    clean = smooth_elevation(cleaned(jump(height)))
    np.testing.assert_allclose(clean.elevation[:200], 50.0, atol=2.5)
    np.testing.assert_allclose(clean.elevation[200:], 50.0 + height, atol=2.5)
    assert np.abs(clean.climb).max() < 1.0


def test_segments_before_and_after_a_change_of_reference_are_smoothed_apart():
    clean = cleaned(jump())
    noise = (1e-6, 1.0, 1.0)
    steps = get_steps(clean)
    whole = smooth_ride(steps, noise)
    for part in (slice(0, 200), slice(200, None)):
        alone = smooth_ride(RideSteps(*(each[part] for each in steps)), noise)
        for name in ("height", "slope", "var_height"):
            np.testing.assert_array_equal(whole[part][name], alone[name])


def test_wrong_fixes_at_the_start_begin_no_segment():
    columns, truth = ride(300, sd=1.0)
    columns["elevation_m"][:3] += 400.0
    clean = smooth_elevation(cleaned(columns))
    assert np.abs(clean.elevation - truth)[:10].max() < 3.0


def test_sudden_change_of_slope_keeps_the_climb():
    columns = drive(300, speed=10.0)
    columns["elevation_m"] = 50.0 + 0.12 * np.maximum(columns["metres"] - 3000.0, 0.0)
    clean = smooth_elevation(cleaned(columns))
    assert clean.climb.sum() == pytest.approx(columns["elevation_m"][-1] - 50.0, abs=0.5)
    np.testing.assert_allclose(np.diff(clean.elevation), clean.climb[1:], atol=1e-9)


def test_steep_road_in_a_tunnel_keeps_its_climb():
    columns = drive(300, speed=15.0)
    columns["elevation_m"] = 50.0 + 0.1 * np.clip(columns["metres"] - 4500.0, 0.0, 900.0)
    columns["elevation_m"] += np.random.default_rng(3).normal(0.0, 0.3, 300)
    for name in ("latitude_deg", "longitude_deg", "elevation_m"):
        columns[name][100:120] = columns[name][99]
    clean = smooth_elevation(cleaned(columns))
    assert clean.climb.sum() == pytest.approx(90.0, abs=2.0)


def test_first_climb_follows_a_slope_that_returns_to_level():
    steps = np.full((5, 60), np.nan)
    steps[0], steps[1] = 30.0, PERIOD
    steps[0, 0] = 2.0 * LENGTH  # a bridged tunnel before the first row
    steps[2] = 50.0 + 0.04 * np.cumsum(np.full(60, 30.0))
    heights, climbs = np.zeros((2, 60))
    smooth_rides(steps, np.array([0, 60]), heights, climbs)
    slope = (heights[1] - heights[0]) / 30.0
    assert climbs[0] == pytest.approx(slope * LENGTH * (1.0 - np.exp(-2.0)), rel=0.1)


def test_rides_are_smoothed_apart_and_idle_rows_are_left():
    first, second = ride(150, 1)[0], ride(150, 2)[0]
    second["elevation_m"] = second["elevation_m"] + 300.0
    columns = joined(first, second)
    columns["time_s"], columns["seq"] = columns["time_s"][0] + PERIOD * np.arange(300), np.arange(300)
    columns["ride_id"] = np.array(["A"] * 140 + [None] * 10 + ["B"] * 150, dtype=object)
    clean = cleaned(columns)
    both = smooth_elevation(clean)
    idle = clean.ride < 0
    np.testing.assert_array_equal(both.climb[idle], clean.climb[idle])
    alone = smooth_elevation(clean._replace(**{n: v[~idle] for n, v in clean._asdict().items()}))
    np.testing.assert_array_equal(both.climb[~idle], alone.climb)
    assert np.abs(both.climb).max() < 20.0


def test_inputs_are_left_as_they_are():
    clean = cleaned(ride(100)[0])
    before = clean.climb.copy(), clean.elevation.copy()
    smooth_elevation(clean)
    np.testing.assert_array_equal(clean.climb, before[0])
    np.testing.assert_array_equal(clean.elevation, before[1])


def test_late_sample_within_a_tunnel_makes_its_frozen_fix_no_new_one():
    columns = drive(60, speed=10.0, elevation_m=40.0)
    columns["elevation_m"] += 0.1 * np.arange(60)
    for name in ("latitude_deg", "longitude_deg", "elevation_m"):
        columns[name][30:40] = columns[name][29]
    order = np.r_[0:35, 20, 35:60]
    clean = cleaned(picked(columns, order))
    assert np.isnan(clean.elevation_fix[30:41]).all()
    assert np.isfinite(clean.elevation_fix[41])


def test_repeated_fix_of_a_standing_car_counts_once():
    columns = picked(drive(50, speed=0.0, elevation_m=40.0), slice(None))
    assert np.isfinite(cleaned(columns).elevation_fix).sum() == 1


@pytest.mark.parametrize("stands", [False, True], ids=["moving", "standing"])
@pytest.mark.parametrize("slope", [0.05, 0.1, -0.1, 0.2])
def test_tunnel_up_a_hill_between_level_roads_keeps_its_climb(slope, stands):
    speed = np.full(500, 10.0)
    speed[239:260] = 0.0 if stands else 10.0
    columns = drive(500, speed=speed)
    run = np.clip(columns["metres"] - 6000.0, 0.0, 1200.0)
    columns["elevation_m"] = np.where((run > 0.0) & (run < 1200.0), np.nan, 500.0 + np.round(slope * run))
    clean = smooth_elevation(cleaned(columns))
    assert clean.climb.sum() == pytest.approx(1200.0 * slope, rel=0.05)
    np.testing.assert_allclose(clean.elevation[:195], 500.0, atol=3.0)
