"""Test that odometer and fixes outvote a speed that is stuck or in another unit, and never a right one."""

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from socast.core.cleaning.quality import Quality
from socast.core.columns import EARTH_RADIUS
from socast.core.settings import Settings
from tests.support.telemetry import cleaned, count, drive, leaf, ran, telemetry, without

N = 500
WITNESSES = pytest.mark.parametrize("witnesses", ["both", "fixes", "odometer"])


def witnessed(witnesses="both", seed=1, step=0.1, noise=0.0, n=N, **columns):
    """Return a drive with its odometer, or without it, or without fixes."""
    made = drive(n, seed=seed, **columns)
    made["odometer_km"] = np.floor((made["metres"] / 1000.0 + 12_345.6) / step) * step
    scatter = np.degrees(np.random.default_rng(seed).normal(0, noise, (2, n)) / EARTH_RADIUS)
    made["latitude_deg"], made["longitude_deg"] = made["latitude_deg"] + scatter[0], made["longitude_deg"] + scatter[1]
    dropped = {"both": (), "fixes": ("odometer_km",), "odometer": ("latitude_deg", "longitude_deg")}[witnesses]
    return without(made, *dropped)


@WITNESSES
@pytest.mark.parametrize("seed", range(4))
def test_distance_is_right_where_the_speed_is_stuck_at_zero(witnesses, seed):
    columns = witnessed(witnesses, seed)
    columns["speed_kmh"][200:300] = 0.0
    clean = cleaned(columns)
    assert clean.distance.sum() == pytest.approx(columns["metres"][-1], rel=0.03)
    assert count(clean, Quality.SPEED_CONTRADICTED) > 30
    assert count(cleaned(witnessed(witnesses, seed)), Quality.SPEED_CONTRADICTED) == 0


@pytest.mark.parametrize("witnesses", ["both", "fixes"])
@pytest.mark.parametrize("factor", [1.609344, 1 / 1.609344])
def test_speed_in_miles_per_hour_is_multiplied_once_two_witnesses_show_it(witnesses, factor):
    columns = witnessed(witnesses, n=1100)
    columns["speed_kmh"] = columns["speed_kmh"] / factor
    pipeline, _ = ran([leaf(), *telemetry(columns)])
    ride = pipeline.take_rides().iloc[0]
    faults = pipeline.quality()["logger_faults"]
    assert faults == {f"speed_times_{factor:.4g}": {"a": 1}}
    if factor > 1.0:  # what was shown too much cannot be taken back
        assert ride["distance_km"] == pytest.approx(columns["metres"][-1] / 1000.0, rel=0.03)
    else:
        assert ride["unfit_reason"] == "speed_contradicted" or ride["distance_km"] < 1.03 * columns["metres"][-1] / 1e3


def test_odometer_alone_cannot_tell_whose_unit_is_wrong():
    columns = witnessed("odometer", n=1100)
    columns["odometer_km"] = columns["odometer_km"] / 1.609344
    pipeline, _ = ran([leaf(), *telemetry(columns)])
    assert pipeline.take_rides()["unfit_reason"].iloc[0] == "speed_contradicted"
    assert not pipeline.quality()["logger_faults"]


def test_fixes_support_a_speed_that_an_odometer_in_miles_contradicts():
    columns = witnessed("both", n=1100)
    columns["odometer_km"] = columns["odometer_km"] / 1.609344
    pipeline, _ = ran([leaf(), *telemetry(columns)])
    ride = pipeline.take_rides().iloc[0]
    assert ride["unfit_reason"] != "speed_contradicted"
    assert ride["distance_km"] == pytest.approx(columns["metres"][-1] / 1000.0, rel=0.01)


@pytest.mark.parametrize("witnesses", ["both", "fixes", "odometer"])
def test_ride_is_unfit_where_the_speed_is_stuck_at_a_value_while_the_car_stands(witnesses):
    speed = np.r_[np.full(150, 14.0), np.zeros(300), np.full(150, 14.0)]
    columns = witnessed(witnesses, n=600, speed=speed, noise=3.0)
    columns["speed_kmh"][150:450] = 50.4
    pipeline, _ = ran([leaf(), *telemetry(columns)])
    assert pipeline.take_rides()["unfit_reason"].iloc[0] == "speed_contradicted"


@settings(max_examples=25, phases=[Phase.explicit, Phase.reuse, Phase.generate])
@given(
    seed=st.integers(0, 2**32 - 1),
    witnesses=st.sampled_from(["both", "fixes", "odometer"]),
    noise=st.sampled_from([0.0, 3.0, 8.0]),
    step=st.sampled_from([0.05, 0.1, 1.0]),
    scale=st.floats(0.98, 1.02),
)
def test_right_speed_is_never_outvoted(seed, witnesses, noise, step, scale):
    columns = witnessed(witnesses, seed, step, noise)
    columns["speed_kmh"] = columns["speed_kmh"] * scale
    clean = cleaned(columns)
    assert count(clean, Quality.SPEED_CONTRADICTED) == 0
    assert clean.distance.sum() == pytest.approx(scale * columns["metres"][-1], rel=0.01)


def test_car_that_parks_is_not_driven_by_fixes_that_scatter():
    columns = witnessed("both", speed=np.r_[np.full(200, 10.0), np.zeros(300)], noise=25.0)
    clean = cleaned(columns)
    assert clean.distance.sum() == pytest.approx(columns["metres"][-1], rel=0.02)


@pytest.mark.parametrize("period", [1.0, 3.0, 10.0])
def test_receiver_that_holds_its_fixes_does_not_contradict_the_speed(period):
    """It holds each fix for 12 to 20 s, and reports the place where the car was when it took it."""
    time = np.arange(0.0, 6000.0, period)
    taken = np.cumsum(np.random.default_rng(5).uniform(12.0, 20.0, 600))
    fix = 15.0 * taken[np.maximum(0, np.searchsorted(taken, time, side="right") - 1)]
    made = drive(len(time), speed=15.0)
    made |= {"time_s": made["time_s"][0] + time, "latitude_deg": 45.5 + np.degrees(fix / EARTH_RADIUS)}
    pipeline, _ = ran([leaf(), *telemetry(made)], settings=Settings(period=period))
    ride = pipeline.take_rides().iloc[0]
    assert ride["unfit_reason"] != "speed_contradicted"
    assert ride["distance_km"] == pytest.approx(15.0 * time[-1] / 1000.0, rel=0.002)
    assert ride["quality_speed_contradicted"] == 0


@pytest.mark.parametrize("period", [3.0, 10.0])
def test_section_has_the_distance_between_its_own_fixes(period):
    made = drive(600, seed=3)
    made["time_s"] = made["time_s"][0] + period * np.arange(600)
    speed = made["speed_kmh"] / 3.6
    metres = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * period)])
    made["latitude_deg"] = made["latitude_deg"][0] + np.degrees(metres / EARTH_RADIUS)
    clean = cleaned(made, Settings(period=period))
    closes = clean.path > 0.0
    assert closes.sum() > 20
    assert clean.path_run[closes] == pytest.approx(clean.path[closes], abs=1.0)


def test_first_fixes_after_a_night_may_be_of_another_place():
    made = drive(300, seed=4, speed=12.0)
    for column, change in (("time_s", 39_000.0), ("seq", 13_000)):
        made[column][150:] += change
    made["latitude_deg"][150:153] -= np.degrees(350.0 / EARTH_RADIUS)
    clean = cleaned(made)
    assert clean.disputed.sum() == 0.0
    assert clean.path.sum() == pytest.approx(clean.path_run.sum(), rel=0.03)


@pytest.mark.parametrize("length", [6, 8, 10])
def test_receiver_that_sends_a_speed_of_zero_in_a_tunnel_does_not_change_its_unit(length):
    columns = witnessed("both", step=0.01, speed=np.full(N, 20.0))
    tunnel = slice(40, 40 + length)
    columns["speed_kmh"][tunnel] = 0.0
    for name in ("latitude_deg", "longitude_deg"):
        columns[name][tunnel] = columns[name][tunnel.start]
    pipeline, _ = ran([leaf(), *telemetry(columns)])
    assert not pipeline.quality()["logger_faults"]
    assert pipeline.take_rides()["quality_speed_contradicted"].sum() == 0
