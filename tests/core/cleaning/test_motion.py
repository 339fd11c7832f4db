"""Test speed, distance and elevation: tunnels, spikes, holes, hills, and cars that lack a sensor."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.cleaning.quality import Quality
from socast.core.columns import EARTH_RADIUS, KMH
from socast.core.settings import Settings
from tests.support.telemetry import PERIOD, PLACE, cleaned, count, drive, joined, picked, without

N = 400
LIMIT = Settings().speed_limit
POSITION = ("latitude_deg", "longitude_deg")


def highway(n=N):
    """Return a drive that accelerates to 90 km/h and keeps that speed."""
    return drive(n, speed=np.minimum(25.0, 2.0 * np.arange(n)))


def copied(columns):
    return {name: values.copy() for name, values in columns.items()}


def moved_to(columns, rows, metres):
    columns["latitude_deg"][rows] = PLACE[0] + np.degrees(metres / EARTH_RADIUS)


def tunnelled(columns, length, hold, jump_kmh=1500.0, own_speed=False):
    """Return a drive whose fixes freeze or fail from row 200 on and then jump; its speed comes from GPS."""
    out = copied(columns)
    inside = slice(200, 200 + length)
    for name in POSITION:
        out[name][inside] = out[name][199] if hold else np.nan
    if not own_speed:
        out["speed_kmh"][inside] = 0.0
        out["speed_kmh"][200 + length] = jump_kmh
    return out


@pytest.mark.parametrize("base", [drive(N, seed=3), highway()], ids=["town", "highway"])
@pytest.mark.parametrize("length", [5, 20, 60])
@pytest.mark.parametrize("hold", [True, False], ids=["frozen", "missing"])
@pytest.mark.parametrize("jump_kmh", [900.0, 2000.0])
def test_tunnel_keeps_its_distance_and_affects_no_later_speed(base, length, hold, jump_kmh):
    clean = cleaned(tunnelled(base, length, hold, jump_kmh))
    assert clean.distance.sum() == pytest.approx(base["metres"][-1], rel=0.02)
    assert clean.speed.max() <= 100 * KMH
    assert np.abs(clean.acceleration).max() < 6.0
    assert count(clean, Quality.SPEED_REJECTED) == 1
    assert count(clean, Quality.BRIDGED) == 1
    assert count(clean, Quality.POSITION_JUMP) == 1
    assert count(clean, Quality.POSITION_FROZEN if hold else Quality.POSITION_MISSING) >= (1 if hold else length)
    bridge = np.flatnonzero(clean.quality & Quality.BRIDGED)
    assert clean.speed[bridge] * clean.travel[bridge] == pytest.approx(clean.distance[bridge])


@pytest.mark.parametrize("samples", [1, 2, 3])
def test_tunnel_of_a_few_seconds_is_bridged(samples):
    """The position crosses the tunnel in 3 to 9 s; its speed and the GPS speed are far above the limit."""
    base = highway()
    out = tunnelled(base, 20, hold=True)
    metres = np.interp(np.arange(samples + 1), [0, samples], base["metres"][[199, 220]])
    rows = slice(220 - samples, 221)
    moved_to(out, rows, metres)
    out["speed_kmh"][220 - samples + 1 : 221] = np.diff(metres)[0] / PERIOD / KMH
    clean = cleaned(out)
    assert clean.distance.sum() == pytest.approx(base["metres"][-1], rel=0.005)
    assert clean.speed.max() <= LIMIT
    assert count(clean, Quality.SPEED_REJECTED) == samples


@pytest.mark.parametrize("hold", [True, False], ids=["frozen", "missing"])
def test_tunnel_with_wheel_speed_counts_its_distance_once(hold):
    base = highway()
    clean = cleaned(tunnelled(base, 40, hold, own_speed=True))
    assert clean.distance.sum() == pytest.approx(base["metres"][-1], rel=1e-6)
    assert count(clean, Quality.BRIDGED) == 0
    assert count(clean, Quality.POSITION_JUMP) == 1


@pytest.mark.parametrize("length", [5, 20, 40])
@pytest.mark.parametrize("hold", [True, False], ids=["frozen", "missing"])
@pytest.mark.parametrize("base", [drive(N, seed=3), highway()], ids=["town", "highway"])
def test_tunnel_without_any_speed_keeps_its_distance(base, length, hold):
    clean = cleaned(without(tunnelled(base, length, hold), "speed_kmh"))
    assert clean.distance.sum() == pytest.approx(base["metres"][-1], rel=0.01)
    assert clean.speed.max() <= 100 * KMH


@pytest.mark.parametrize("speed", [True, False], ids=["speed", "fixes"])
def test_spikes_of_the_position_add_no_distance(speed, rng):
    base = drive(N, seed=3)
    spikes = rng.choice(np.arange(5, N), 12, replace=False)
    out = copied(base)
    out["latitude_deg"][spikes] += rng.choice([-0.02, 0.05, 3.0], 12)
    clean = cleaned(out if speed else without(out, "speed_kmh"))
    assert clean.distance.sum() == pytest.approx(base["metres"][-1], rel=0.01)
    assert np.all(clean.quality[spikes] & Quality.POSITION_JUMP)
    assert clean.speed.max() <= 60 * KMH


@pytest.mark.parametrize("speed", [True, False], ids=["speed", "fixes"])
def test_fixes_at_zero_latitude_and_longitude_are_missing(speed, rng):
    base = drive(N, seed=3)
    null = np.r_[0, rng.choice(np.arange(5, N), 10, replace=False)]
    out = copied(base)
    for name in POSITION:
        out[name][null] = 0.0
    clean = cleaned(out if speed else without(out, "speed_kmh"))
    assert np.all(clean.quality[null] & Quality.POSITION_MISSING)
    assert count(clean, Quality.POSITION_MISSING) == len(null)
    assert clean.distance.sum() == pytest.approx(base["metres"][-1], rel=0.01)
    assert np.nanmax(np.abs(np.degrees(clean.latitude) - PLACE[0])) < 1


def test_wrong_first_fix_is_discarded():
    base = drive(N, seed=3)
    out = copied(base)
    out["latitude_deg"][0] += 1.0
    for columns in (out, without(out, "speed_kmh")):
        clean = cleaned(columns)
        assert clean.distance.sum() == pytest.approx(base["metres"][-1], rel=0.01)
        assert np.degrees(clean.latitude[-1]) == pytest.approx(base["latitude_deg"][-1])


@pytest.mark.parametrize("noise", [0.0, 2.0, 5.0])
def test_speed_of_a_car_without_speed_sensor_follows_its_fixes(noise, rng):
    base = drive(800, seed=3)
    out = without(base, "speed_kmh")
    for name in POSITION:
        out[name] = out[name] + np.degrees(rng.normal(0, noise, 800) / EARTH_RADIUS)
    clean = cleaned(out)
    assert clean.distance.sum() == pytest.approx(base["metres"][-1], rel=0.03)
    assert clean.speed @ clean.travel == pytest.approx(base["metres"][-1], rel=0.05)
    true = base["speed_kmh"] * KMH
    assert np.corrcoef(clean.speed[6:], 0.5 * (true[5:-1] + true[4:-2]))[0, 1] > 0.8  # delayed by a sample
    assert count(clean, Quality.SPEED_MISSING | Quality.BRIDGED) == 0


@pytest.mark.parametrize("speed", [True, False], ids=["speed", "fixes"])
def test_stationary_car_has_no_distance(speed, rng):
    out = drive(1200, speed=0.0)
    for name in POSITION:
        out[name] = out[name] + np.degrees(rng.normal(0, 3.0, 1200) / EARTH_RADIUS)
    out["elevation_m"] = 50.0 + np.cumsum(rng.normal(0, 1.0, 1200))
    clean = cleaned(out if speed else without(out, "speed_kmh"))
    assert clean.distance.sum() < (1e-9 if speed else 100.0)
    assert clean.speed.max() < (1e-9 if speed else 2 * KMH)
    if speed:
        assert np.all(clean.climb == 0)
    assert np.all(clean.ride == 0)  # its logger names a ride
    nameless = cleaned(without(out, "ride_id"))
    assert np.all(nameless.ride == -1)


def test_odometer_alone_measures_distance_and_work():
    base = drive(N, seed=3)
    out = without(base, "speed_kmh", *POSITION) | {"odometer_km": np.round(1000 + base["metres"] / 1000, 1)}
    clean = cleaned(out)
    assert clean.distance.sum() == pytest.approx(base["metres"][-1], abs=200)
    assert clean.speed @ clean.travel == pytest.approx(clean.distance.sum())
    assert clean.speed.max() <= 80 * KMH


@pytest.mark.parametrize("witness", ["odometer", "fix", "both"])
@pytest.mark.parametrize("length", [4, 30])
def test_distance_of_a_hole_is_added_once(witness, length):
    base = highway()
    out = copied(base) | {"odometer_km": np.round(5000 + base["metres"] / 1000, 1)}
    if witness == "odometer":
        out = without(out, *POSITION)
    if witness == "fix":
        out = without(out, "odometer_km")
    keep = np.ones(N, bool)
    keep[200 : 200 + length] = False
    clean = cleaned(picked(out, keep))
    assert clean.distance.sum() == pytest.approx(base["metres"][-1], abs=110)
    assert count(clean, Quality.GAP) == 1
    assert count(clean, Quality.BRIDGED) == 1


def test_hole_without_odometer_or_fix_is_interpolated_up_to_the_end_of_the_ride():
    base = highway()
    keep = np.ones(N, bool)
    keep[200:215] = False
    clean = cleaned(picked(without(base, *POSITION), keep))
    assert clean.distance.sum() == pytest.approx(base["metres"][-1])
    keep[100:350] = False  # the ride ends in the hole, and the first sample after it needs another that agrees
    clean = cleaned(picked(without(base, *POSITION), keep))
    assert base["metres"][-1] - clean.distance.sum() == pytest.approx(252 * PERIOD * 25.0)


def test_permanently_missing_speed_stops_adding_distance():
    base = highway()
    out = without(base, *POSITION)
    out["speed_kmh"][200:] = np.nan
    clean = cleaned(out)
    assert clean.distance[200:].sum() == pytest.approx(20 * PERIOD * 25.0)
    assert clean.speed @ clean.travel == pytest.approx(clean.distance.sum(), rel=0.01)
    assert count(clean, Quality.SPEED_MISSING) == N - 200


def test_missing_speed_is_replaced_by_that_of_the_fixes():
    base = drive(N, seed=3)
    out = copied(base)
    out["speed_kmh"][100:300] = np.nan
    clean = cleaned(out)
    assert clean.distance.sum() == pytest.approx(base["metres"][-1], rel=0.01)
    assert count(clean, Quality.SPEED_MISSING) == 200


def test_speed_above_the_limit_is_rejected_and_its_distance_kept():
    base = drive(N, speed=np.minimum(40.0, 2.0 * np.arange(N)))  # a true speed of 144 km/h
    clean = cleaned(base)
    above = base["speed_kmh"] * KMH > LIMIT
    assert np.array_equal((clean.quality & Quality.SPEED_REJECTED) != 0, above)
    assert clean.speed.max() <= LIMIT
    assert clean.distance.sum() == pytest.approx(base["metres"][-1], rel=1e-3)
    allowed = cleaned(base, Settings(speed_limit=150 * KMH))
    assert count(allowed, Quality.SPEED_REJECTED) == 0
    assert allowed.speed.max() == pytest.approx(40.0)


def test_duplicates_and_late_samples_add_nothing(rng):
    base = drive(N, seed=3)
    order = np.repeat(np.arange(N), np.where(rng.random(N) < 0.2, 2, 1))
    order = np.insert(order, 300, [100, 101])  # samples that come far too late
    clean = cleaned(picked(base, order))
    repeated = np.r_[False, order[1:] == order[:-1]]
    assert np.array_equal((clean.quality & Quality.DUPLICATE) != 0, repeated)
    assert count(clean, Quality.LATE) == 2
    unused = (clean.quality & (Quality.DUPLICATE | Quality.LATE)) != 0
    for column in (clean.dt, clean.travel, clean.distance, clean.climb, clean.energy, clean.metered):
        assert np.all(column[unused] == 0)
    assert clean.distance.sum() == pytest.approx(base["metres"][-1])
    assert clean.dt.sum() == pytest.approx(PERIOD * (N - 1))


def test_two_cars_with_one_identity_are_flagged_and_add_no_distance_between():
    base = drive(N, seed=3)
    other = base | {
        "latitude_deg": base["latitude_deg"] + 1.0,
        "time_s": base["time_s"] + 1.5,
        "seq": base["seq"] + 9000,
    }
    order = np.argsort(np.r_[np.arange(N), np.arange(N) + 0.5])
    clean = cleaned(picked(joined(base, other), order))
    assert clean.distance.sum() < 1.2 * base["metres"][-1]
    assert clean.speed.max() <= LIMIT
    assert count(clean, Quality.SEQUENCE) > N
    assert count(clean, Quality.POSITION_JUMP) > N / 2


@pytest.mark.parametrize("window", [1, 2, 3, 5, 8])
def test_moving_average_covers_the_last_samples(window):
    base = drive(60, seed=3)
    clean = cleaned(without(base, *POSITION), Settings(window=window))
    v = base["speed_kmh"] * KMH
    smooth = np.array([v[max(0, i - window + 1) : i + 1].mean() for i in range(60)])
    assert clean.speed[1:] == pytest.approx(0.5 * (smooth[1:] + smooth[:-1]))
    assert clean.acceleration[1:] == pytest.approx(np.diff(smooth) / PERIOD, abs=1e-9)


@pytest.mark.parametrize("window", [1, 3])
def test_spread_of_the_acceleration_follows_its_change(window):
    base = drive(60, seed=3)
    clean = cleaned(without(base, *POSITION), Settings(window=window))
    assert clean.acceleration_spread[2:] == pytest.approx(np.sqrt(0.2) * np.abs(np.diff(clean.acceleration[1:])))


@pytest.mark.parametrize("rows", [slice(100, 101), slice(100, 130)])
def test_spread_of_the_acceleration_is_zero_beside_a_hole(rows):
    base = drive(N, seed=3)
    base["speed_kmh"][rows] = np.nan
    clean = cleaned(without(base, *POSITION))
    assert not clean.acceleration_spread[rows.start : rows.stop + 2].any()
    after = clean.acceleration[rows.stop + 1 :]
    assert clean.acceleration_spread[rows.stop + 2 :] == pytest.approx(np.sqrt(0.2) * np.abs(np.diff(after)))


def test_wide_motion_is_that_of_two_steps():
    base = drive(60, seed=3)
    clean = cleaned(without(base, *POSITION))
    speed = base["speed_kmh"] * KMH
    mean = 0.5 * (clean.speed[2:] + clean.speed[1:-1])
    assert clean.wide_speed[2:] == pytest.approx(mean)
    gained = 0.5 * (speed[2:] ** 2 - speed[:-2] ** 2)
    assert clean.wide_acceleration[2:] * mean * 2 * PERIOD == pytest.approx(gained)


def test_wide_motion_is_weighted_by_the_time_of_the_steps():
    base = drive(60, seed=3)
    base["time_s"] = base["time_s"] + np.where(np.arange(60) == 30, 1.0, 0.0)
    clean = cleaned(without(base, *POSITION))
    ends, before = slice(29, 33), slice(28, 32)
    times = clean.travel[ends] + clean.travel[before]
    run = clean.speed * clean.travel
    assert len(set(clean.travel[ends].round(6))) > 1
    assert clean.wide_speed[ends] == pytest.approx((run[ends] + run[before]) / times)


@pytest.mark.parametrize("rows", [slice(100, 101), slice(100, 130)])
def test_wide_motion_does_not_reach_into_a_hole(rows):
    base = drive(N, seed=3)
    base["speed_kmh"][rows] = np.nan
    clean = cleaned(without(base, *POSITION))
    beside = slice(rows.start, rows.stop + 2)
    assert clean.wide_speed[beside] == pytest.approx(clean.speed[beside])
    assert clean.wide_acceleration[beside] == pytest.approx(clean.acceleration[beside])
    assert clean.wide_speed[rows.stop + 2] == pytest.approx(clean.speed[rows.stop + 1 : rows.stop + 3].mean())


def test_first_sample_of_a_moving_car_is_no_change():
    base = without(drive(20, speed=20.0), *POSITION)
    base["speed_kmh"] = 72.0 + 7.2 * (np.arange(20) % 2)
    clean = cleaned(base, Settings(window=1))
    assert clean.speed[2:] == pytest.approx(21.0)


def test_speed_beside_an_implausible_change_is_averaged():
    base = without(highway(), *POSITION)
    base["speed_kmh"][100:104] = 0.0
    clean, plain = cleaned(base), np.asarray(base["speed_kmh"]) * KMH
    assert np.abs(clean.acceleration).max() <= 6.0
    beside = np.r_[2:99, 110 : len(plain)]
    assert clean.speed[beside] == pytest.approx(0.5 * (plain[beside] + plain[beside - 1]))


@pytest.mark.parametrize("fault", ["none", "tunnel", "gap", "nan", "no speed"])
def test_inertia_adds_up_to_the_kinetic_energy(fault):
    base = drive(N, seed=3)
    base["speed_kmh"][-20:] = 36.0  # ends in motion
    out = copied(base)
    if fault == "tunnel":
        out = tunnelled(base, 20, hold=True)
    if fault == "gap":
        out = picked(base, np.r_[0:150, 190:N])
    if fault == "nan":
        out["speed_kmh"][100:130] = np.nan
    if fault == "no speed":
        out = without(base, "speed_kmh")
        moved_to(out, slice(0, N), np.cumsum(base["speed_kmh"] * KMH) * PERIOD)
    clean = cleaned(out)
    work = np.sum(clean.acceleration * clean.speed * clean.travel)
    assert work == pytest.approx(0.5 * 10.0**2, abs=0.5)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("stops", [True, False])
def test_flat_road_with_noise_has_no_hills(seed, stops):
    rng = np.random.default_rng(seed)
    n = 900
    base = drive(n, seed=seed, speed=None if stops else 8.0)
    assert base["metres"][-1] > 18_000
    clean = cleaned(base | {"elevation_m": 100 + rng.normal(0, 1.0, n)})
    assert np.abs(clean.climb).sum() < 10.0
    raw = np.abs(np.diff(100 + rng.normal(0, 1.0, n))).sum()
    assert raw > 900  # the sum over raw samples


@pytest.mark.parametrize("height", [20.0, 50.0, 200.0])
@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_hill_keeps_its_height_except_for_the_slack(height, noise, rng):
    base = drive(900, seed=1)
    share = base["metres"] / base["metres"][-1]
    clean = cleaned(base | {"elevation_m": 50 + height * np.sin(np.pi * share) ** 2 + rng.normal(0, noise, 900)})
    gained, lost = np.maximum(clean.climb, 0).sum(), -np.minimum(clean.climb, 0).sum()
    assert height - 2.5 < gained < height + 4 * noise + 0.1
    assert height - 3.5 < lost < height + 4 * noise + 0.1


def test_short_hills_keep_the_documented_share_of_their_height():
    base = drive(2000, speed=10.0)
    length = Settings().elevation_length
    for wavelength in (1000.0, 7000.0):
        clean = cleaned(base | {"elevation_m": 100 + 40 * np.sin(2 * np.pi * base["metres"] / wavelength)})
        turns = base["metres"][-1] / wavelength
        kept = 80 / np.hypot(1, 2 * np.pi * length / wavelength) - 2 * Settings().elevation_slack
        assert np.maximum(clean.climb, 0).sum() / turns == pytest.approx(kept, rel=0.07)


def test_missing_elevation_adds_no_climb_and_loses_no_hill():
    base = drive(900, seed=1)
    hill = 50 + 100 * base["metres"] / base["metres"][-1]
    hill[300:500] = np.nan
    clean = cleaned(base | {"elevation_m": hill})
    assert np.all(clean.climb[300:500] == 0)
    assert clean.climb.sum() == pytest.approx(100, abs=4)


@pytest.mark.parametrize("bearing", [0.0, 60.0, 135.0, 270.0])
def test_heading_is_the_direction_of_travel(bearing):
    base = drive(100, speed=10.0)
    angle = np.radians(bearing)
    base["latitude_deg"] = PLACE[0] + np.degrees(base["metres"] * np.cos(angle) / EARTH_RADIUS)
    east = base["metres"] * np.sin(angle) / EARTH_RADIUS / np.cos(np.radians(base["latitude_deg"]))
    base["longitude_deg"] = PLACE[1] + np.degrees(east)
    clean = cleaned(base)
    assert np.degrees(clean.heading[-1]) % 360 == pytest.approx(bearing, abs=0.2)
    assert np.abs(clean.turn_rate[5:]).max() < 1e-3


def test_crossing_the_date_line_is_no_jump():
    base = drive(100, speed=10.0)
    base["latitude_deg"] = np.zeros(100) + 1.0
    base["longitude_deg"] = (180 - 0.01 + np.degrees(base["metres"] / EARTH_RADIUS) + 180) % 360 - 180
    assert base["longitude_deg"].min() < 0 < base["longitude_deg"].max()
    clean = cleaned(without(base, "speed_kmh"))
    assert count(clean, Quality.POSITION_JUMP) == 0
    assert clean.distance.sum() == pytest.approx(base["metres"][-1], rel=5e-3)
    assert np.degrees(clean.heading[-1]) == pytest.approx(90, abs=0.5)


@given(seed=st.integers(0, 2**32 - 1))
def test_results_are_finite_and_within_limits_for_any_input(seed):
    rng = np.random.default_rng(seed)
    n = 150
    out = drive(n, seed=seed % 100) | {
        "odometer_km": np.cumsum(rng.choice([0, 0.1, 0.1, -5, 900], n, p=[0.5, 0.2, 0.2, 0.05, 0.05]))
    }
    for name in ("latitude_deg", "longitude_deg", "speed_kmh"):
        wild = rng.random(n) < 0.3
        out[name][wild] = rng.choice([0.0, 45.5, -73.6, 89.9, 1500.0, np.nan, -3.0], wild.sum())
    out["time_s"] = out["time_s"] + np.where(rng.random(n) < 0.2, rng.normal(0, 60, n), 0)
    clean = cleaned(picked(out, rng.permutation(n) if seed % 2 else np.arange(n)))
    for column in (clean.dt, clean.travel, clean.distance, clean.speed):
        assert np.all(np.isfinite(column))
        assert np.all(column >= 0)
    assert clean.speed.max() <= LIMIT + 1e-9
    assert np.all(np.isfinite(clean.acceleration))
