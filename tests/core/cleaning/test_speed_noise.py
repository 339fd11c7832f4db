"""Test the noise of a reported speed and its spikes: averages where they are needed, and none where they are not."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.cleaning.kernel import Cleaner
from socast.core.cleaning.quality import Quality
from socast.core.columns import KMH
from socast.core.settings import Settings
from tests.support.telemetry import cleaned, count, decoded, telemetry

SEEDS = st.integers(0, 10_000)
PERIODS = st.sampled_from([1.0, 2.0, 3.0, 5.0])


def draw_drive(seed, period, minutes=40):
    """Return speeds of a drive between stops, with accelerations that change as those of drivers do. [m/s]"""
    rng = np.random.default_rng(seed)
    parts = [np.zeros(20)]
    while sum(map(len, parts)) < 60 * minutes:
        cruise, hold = rng.uniform(8.0, 30.0), int(rng.uniform(20, 200))
        up, down = cruise / rng.uniform(0.8, 2.0), cruise / rng.uniform(0.8, 2.0)
        wander = 0.06 * cruise * np.sin(2 * np.pi * np.arange(hold) / rng.uniform(20.0, 60.0)) * np.hanning(hold)
        rise, fall = np.hanning(2 * int(up) + 1)[: int(up)], np.hanning(2 * int(down) + 1)[int(down) + 1 :]
        parts += [cruise * rise, cruise + wander, cruise * fall, np.zeros(int(rng.uniform(3, 30)))]
    speed = np.concatenate(parts)
    at = np.arange(0.0, len(speed) - 1, period)
    return np.interp(at, np.arange(len(speed)), speed)


def noisy(speed, seed, kmh):
    """Return speeds with white noise, cut at zero. [m/s]"""
    return np.maximum(0.0, speed + np.random.default_rng(seed + 1).normal(0.0, kmh * KMH, len(speed)))


def clean_speeds(speed, period, **settings):
    """Return the cleaned rows of a car that sends nothing but its speed."""
    columns = {
        "time_s": 1.5e9 + period * np.arange(len(speed)),
        "seq": np.arange(len(speed)),
        "ride_id": ["r"] * len(speed),
    }
    return cleaned(columns | {"speed_kmh": speed / KMH}, Settings(period=period, **settings))


def work(clean):
    """Return the energy of speeding up per mass. [m^2/s^2]"""
    return np.maximum(0.0, clean.acceleration * clean.speed * clean.travel).sum()


def true_work(speed):
    return np.maximum(0.0, 0.5 * np.diff(speed**2)).sum()


def length(speed, period):
    return period * 0.5 * (speed[1:] + speed[:-1]).sum()


@given(SEEDS, PERIODS)
def test_a_clean_speed_is_not_averaged(seed, period):
    speed = draw_drive(seed, period)
    clean = clean_speeds(speed, period)
    assert count(clean, Quality.SPEED_NOISY | Quality.SPEED_SPIKE) == 0
    assert work(clean) == pytest.approx(true_work(speed), rel=0.01)
    assert clean.distance.sum() == pytest.approx(length(speed, period), rel=0.001)


@given(SEEDS, PERIODS)
def test_a_speed_in_whole_kilometres_per_hour_is_hardly_averaged(seed, period):
    speed = draw_drive(seed, period)
    clean = clean_speeds(np.round(speed / KMH) * KMH, period)
    assert work(clean) == pytest.approx(true_work(speed), rel=0.03)


@given(SEEDS, st.sampled_from([1.0, 2.0]))
def test_noise_hardly_changes_the_energy_of_speeding_up(seed, kmh):
    speed = draw_drive(seed, 1.0)
    sent = noisy(speed, seed, kmh)
    clean = clean_speeds(sent, 1.0)
    added = true_work(sent) / true_work(speed) - 1.0
    assert added > 0.4
    assert abs(work(clean) / true_work(speed) - 1.0) < 0.33 * added  # 0.12 in the mean, 0.29 at most of 600 drives
    assert clean.distance.sum() == pytest.approx(length(speed, 1.0), rel=0.01)
    assert count(clean, Quality.SPEED_NOISY) > 0.7 * len(speed)


@pytest.mark.parametrize(
    ("period", "kmh", "sent", "left"), [(1.0, 1.0, 1.95, 1.08), (3.0, 1.0, 1.22, 1.1), (3.0, 2.0, 1.57, 1.1)]
)
def test_little_noise_is_left_in_the_mean_of_many_drives(period, kmh, sent, left):
    drives = [draw_drive(seed, period, minutes=60) for seed in range(12)]
    sums = np.zeros(3)
    for seed, speed in enumerate(drives):
        rough = noisy(speed, seed, kmh)
        sums += true_work(speed), true_work(rough), work(clean_speeds(rough, period))
    assert sums[1:] / sums[0] == pytest.approx([sent, left], abs=0.06)


def test_more_noise_is_averaged_over_more_samples():
    speed, spread = np.full(2000, 20.0), []
    for kmh in (0.0, 0.5, 1.0, 2.0):
        clean = clean_speeds(noisy(speed, 5, kmh), 1.0)
        spread.append(np.abs(np.diff(clean.speed[500:])).mean() / max(kmh, 0.1))
    assert spread[0] == 0.0
    assert max(spread[1:]) < 0.1  # of neighbours that are not averaged: 0.22


def test_a_length_that_is_set_is_the_same_for_every_car():
    speed = noisy(draw_drive(3, 1.0), 3, 1.0)
    plain = clean_speeds(speed, 1.0, window=1)
    assert count(plain, Quality.SPEED_NOISY) == 0
    assert plain.speed[1:] == pytest.approx(0.5 * (speed[1:] + speed[:-1]))


def test_inertia_of_a_noisy_drive_adds_up_to_the_difference_of_its_ends():
    speed = noisy(draw_drive(4, 1.0), 4, 2.0)
    clean = clean_speeds(speed, 1.0)
    gained = (clean.acceleration * clean.speed * clean.travel).sum()
    last = 2.0 * clean.speed[-1] - clean.speed[-2]
    assert gained == pytest.approx(0.0, abs=0.5 * max(last, 3.0) ** 2)


@given(SEEDS, st.lists(st.integers(1, 1500), max_size=5))
def test_any_division_of_a_noisy_drive_with_spikes_gives_the_same_rows(seed, cuts):
    speed = noisy(draw_drive(seed, 1.0, minutes=20), seed, 1.0)
    speed[np.random.default_rng(seed).integers(30, len(speed) - 5, 8)] += 60.0 * KMH
    columns = {"time_s": 1.5e9 + np.arange(len(speed)), "seq": np.arange(len(speed)), "speed_kmh": speed / KMH}
    batch = decoded(telemetry(columns))
    whole = Cleaner(Settings(period=1.0)).clean(batch, 1)
    cleaner, edges = Cleaner(Settings(period=1.0)), sorted({0, batch.size, *(min(cut, batch.size) for cut in cuts)})
    parts = [cleaner.clean(batch.rows(start, stop), 1) for start, stop in pairwise(edges)]
    for name in ("speed", "acceleration", "distance", "quality"):
        assert np.array_equal(np.concatenate([getattr(part, name) for part in parts]), getattr(whole, name))


def put_spikes(speed, seed, samples, to_zero=False, n=5):
    """Return speeds with spikes of some samples while the car drives fast, and where they are."""
    out, fast = speed.copy(), np.flatnonzero(np.minimum(speed[:-4], speed[4:]) > 12.0)
    places = np.random.default_rng(seed).permutation(fast[fast > 20])[:n]
    places = places[np.diff(np.sort(places), prepend=-100) > 10]
    for place in places:
        out[place : place + samples] = 0.0 if to_zero else speed[place : place + samples] + 60.0 * KMH
    return np.minimum(out, 129.0 * KMH), len(places)


@given(SEEDS, st.sampled_from([1.0, 3.0]), st.sampled_from([1, 2]))
def test_spikes_of_60_kmh_add_no_energy(seed, period, samples):
    speed = np.minimum(draw_drive(seed, period), 68.0 * KMH)
    sent, _ = put_spikes(speed, seed, samples)
    clean = clean_speeds(sent, period)
    assert work(clean) == pytest.approx(true_work(speed), rel=0.05)
    assert clean.distance.sum() == pytest.approx(length(speed, period), rel=0.01)


@given(SEEDS, st.sampled_from([1.0, 3.0]))
def test_a_sample_of_zero_while_driving_is_no_stop(seed, period):
    speed = draw_drive(seed, period)
    sent, n = put_spikes(speed, seed, 1, to_zero=True)
    clean = clean_speeds(sent, period)
    assert work(clean) == pytest.approx(true_work(speed), rel=0.05)
    assert clean.stop.sum() <= clean_speeds(speed, period).stop.sum() + n * (period > 1.0)
    assert clean.distance.sum() == pytest.approx(length(speed, period), rel=0.01)


def test_every_spike_on_a_level_stretch_is_counted():
    speed = np.full(400, 15.0)
    speed[50:400:50] += 60.0 * KMH
    clean = clean_speeds(speed, 3.0)
    assert np.flatnonzero(clean.quality & Quality.SPEED_SPIKE).tolist() == list(range(51, 400, 50))
    assert clean.speed[2:] == pytest.approx(15.0)
    assert clean.distance[1:] == pytest.approx(45.0)


@pytest.mark.parametrize("period", [1.0, 3.0, 10.0])
@pytest.mark.parametrize("deceleration", [8.8, 5.0])
def test_hard_braking_to_a_stop_passes(period, deceleration):
    time = np.arange(0.0, 300.0, period)
    speed = np.clip(35.0 - deceleration * np.maximum(0.0, time - 151.0), 0.0, None)
    clean = clean_speeds(speed, period)
    assert count(clean, Quality.SPEED_SPIKE) == 0
    assert clean.stopped[-1] == 1.0
    assert clean.stop.sum() == 1.0
    assert clean.distance.sum() == pytest.approx(length(speed, period), abs=1e-6)
    last = np.flatnonzero(speed == 0.0)[0] + 2
    assert not clean.speed[last + 1 :].any() or clean.speed[last + 3 :].max() == 0.0


@pytest.mark.parametrize("period", [1.0, 3.0])
def test_a_hard_launch_passes(period):
    time = np.arange(0.0, 120.0, period)
    speed = np.clip(9.0 * np.maximum(0.0, time - 60.5), 0.0, 33.0)
    clean = clean_speeds(speed, period)
    assert count(clean, Quality.SPEED_SPIKE) == 0
    assert clean.distance.sum() == pytest.approx(length(speed, period), rel=0.01)
    assert work(clean) == pytest.approx(true_work(speed), rel=0.01)


def test_fixes_show_a_spike_of_a_slow_logger():
    speed = np.full(200, 20.0)
    speed[40:200:40] += 45.0 * KMH  # within 10 s, which cars can drive
    metres = 200.0 * np.arange(200)
    columns = {"time_s": 1.5e9 + 10.0 * np.arange(200), "seq": np.arange(200), "speed_kmh": speed / KMH}
    settings = Settings(period=10.0)
    place = {"latitude_deg": 45.5 + np.degrees(metres / 6_371_000.0), "longitude_deg": np.full(200, -73.6)}
    clean = cleaned(columns | place, settings)
    assert count(clean, Quality.SPEED_SPIKE) == 4
    assert clean.distance.sum() == pytest.approx(metres[-1], rel=0.001)
    assert count(cleaned(columns, settings), Quality.SPEED_SPIKE) == 0


def test_hard_braking_that_the_next_sample_confirms_keeps_its_acceleration():
    speed = np.full(60, 16.0)
    speed[30:] = 5.0, 8.0, *[8.0] * 28
    clean = clean_speeds(speed, 3.0)
    assert clean.acceleration_spread[30] == 0.0
    assert clean.acceleration_spread[31] == pytest.approx((16.0 - 5.0) / 3.0 + (8.0 - 5.0) / 3.0)
    change = clean.acceleration * clean.speed * clean.travel
    assert change.sum() == pytest.approx(0.5 * (8.0**2 - 16.0**2))
    assert clean.distance.sum() == pytest.approx(length(speed, 3.0))


@pytest.mark.parametrize("powered", [True, False])
def test_hard_launch_that_the_battery_delivers_is_not_held_back(powered):
    speed = np.zeros(60)
    speed[30:] = 1.0, 11.0, *[14.0] * 28
    columns = {"time_s": 1.5e9 + 3.0 * np.arange(60), "seq": np.arange(60), "speed_kmh": speed / KMH}
    power = np.where((speed > 0.0) & (speed < 14.0), 60e3, 2e3) if powered else np.full(60, 2e3)
    columns |= {"battery_voltage_v": np.full(60, 360.0), "battery_current_a": power / 360.0}
    clean = cleaned(columns)
    assert (clean.acceleration[31] > 3.0) == powered


@pytest.mark.parametrize("kmh", [0.0, 1.0])
def test_driver_who_changes_the_pedal_often_makes_no_noise(kmh):
    """The second differences of the speed alternate with each of the next two, those of noise with the next one."""
    white = np.random.default_rng(11).normal(0.0, 0.25, 6000)
    curve = np.convolve(white, [1.0, -0.35, -0.2])[:6000]
    wander = np.cumsum(np.cumsum(curve))
    for width in (41, 41):
        wander -= np.convolve(wander, np.full(width, 1.0 / width), mode="same")
    clean = clean_speeds(noisy(np.maximum(5.0, 20.0 + wander), 11, kmh), 1.0)
    share = count(clean, Quality.SPEED_NOISY) / 6000
    assert share < 0.02 if kmh == 0.0 else share > 0.5
