"""A disguise hides names, places and dates, and keeps season, weekday and sun."""

from random import Random

import numpy as np
import pytest

from socast.core.signals.sun import sine_of_elevation
from socast.tools.anonymise.disguise import FARTHEST_DEG, WEEK_S, keeps_days, list_shifts, make_disguise

CENTRE = 45.5, -73.6
BEGIN = 1_516_100_000.0
SEEDS = range(40)


def make(seed, centre=CENTRE, busy=(True,) * 24):
    return make_disguise(Random(seed), BEGIN, BEGIN + 86400.0, centre, busy)


def test_names_differ_by_salt_and_kind_and_stay_within_a_recording():
    disguise = make(1)
    assert disguise.rename("car", "taxi-1") == disguise.rename("car", "taxi-1")
    assert disguise.rename("car", "taxi-1") != disguise.rename("ride", "taxi-1").replace("ride", "car")
    assert disguise.rename("car", "taxi-1") != make(2).rename("car", "taxi-1")
    assert "taxi" not in disguise.rename("car", "taxi-1")


@pytest.mark.parametrize("seed", SEEDS)
def test_sun_stays_as_it_was(seed):
    disguise = make(seed)
    times = BEGIN + 900.0 * np.arange(96)
    latitude, longitude = disguise.places.move(*CENTRE)
    before = sine_of_elevation(times, *(np.full(96, np.radians(each)) for each in CENTRE))
    moved = np.array([disguise.shift(each) for each in times.tolist()])
    after = sine_of_elevation(moved, np.full(96, np.radians(latitude)), np.full(96, np.radians(longitude)))
    assert np.abs(np.degrees(np.arcsin(after) - np.arcsin(before))).max() < 0.5


@pytest.mark.parametrize("seed", SEEDS)
def test_area_moves_along_its_parallel_and_away_from_its_place(seed):
    disguise = make(seed)
    latitude, longitude = disguise.places.move(*CENTRE)
    assert abs(latitude - CENTRE[0]) <= 1e-6
    assert abs((longitude - CENTRE[1] + 180.0) % 360.0 - 180.0) >= 15.0 - 1e-6
    assert abs(longitude) <= FARTHEST_DEG


def test_places_times_and_turns_are_all_different():
    found = {(each.shift_s, each.places.turn_deg, each.salt) for each in map(make, SEEDS)}
    assert len(found) == len(SEEDS)
    assert len({each.shift_s for each in map(make, SEEDS)}) > 25


def test_shifts_are_whole_weeks_about_whole_years_within_credible_dates():
    shifts = list_shifts(BEGIN, BEGIN)
    assert len(shifts) > 5
    for weeks in shifts:
        moved = BEGIN + weeks * WEEK_S
        assert 631_152_000 <= moved <= 2_840_140_800
        assert abs((7 * weeks + 182.6) % 365.2422 - 182.6) <= 0.55
    assert list_shifts(0.0, 4e9)  # no shift keeps it within them


def test_times_shift_alike_and_clocks_that_were_never_set_stay():
    disguise = make(3)
    assert disguise.shift(BEGIN + 0.25) - disguise.shift(BEGIN) == 0.25
    for never_set in (12.5, 315_964_900.0, 946_684_800.0):
        assert disguise.shift(never_set) == never_set
    assert disguise.shift(900_000_000.0) == 900_000_000.0 + disguise.shift_s


def test_wind_turns_with_the_headings_and_a_wrong_direction_stays():
    disguise = make(4)
    turn = disguise.places.turn_deg
    assert disguise.turn(350.0) == pytest.approx((350.0 + turn) % 360.0, abs=1e-6)
    assert disguise.turn(-1.0) == -1.0


def test_recording_without_positions_has_a_disguise():
    assert make(5, None).places.move(10.0, 20.0) != (10.0, 20.0)


@pytest.mark.parametrize("seed", SEEDS)
def test_no_sample_comes_to_another_day_where_cars_rest_at_some_time(seed):
    busy = [10 <= hour < 20 for hour in range(24)]
    shift_s = make(seed, busy=busy).shift_s
    times = [day * 86400 + hour * 3600 + 60 for day in range(3) for hour in range(24) if busy[hour]]
    days = [(time + shift_s) // 86400 for time in times]
    assert [day - days[0] for day in days] == [time // 86400 for time in times]
    assert not keeps_days(shift_s // 3600 % 24, [True] * 24)


def test_times_shift_together_to_the_bits_to_which_each_shifts_alone():
    rng, disguise = np.random.default_rng(3), make(1)
    odd = [0.0, 946_684_800.0, 946_684_799.0, 315_964_900.5, -5.0, 1e15, -1e300, 1e300]
    times = np.concatenate([odd, BEGIN + rng.uniform(0.0, 1e7, 1000), rng.uniform(-1e10, 1e10, 1000)])
    assert disguise.shift_all(times).tolist() == [disguise.shift(each) for each in times.tolist()]
    assert np.isnan(disguise.shift_all(np.array([np.nan]))).all()
