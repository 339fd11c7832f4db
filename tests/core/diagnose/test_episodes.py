"""Test the search for episodes: hours of a few dates in which the power is off by one amount."""

import numpy as np
import pandas as pd
import pytest

from socast.core.diagnose.candidates import build_candidates
from socast.core.diagnose.episodes import find_episodes
from socast.core.diagnose.projection import BaseProjection
from socast.core.fit.ride_blocks import get_numbers
from tests.support.synthetic_windows import gather_with_model, make_tables, make_windows

pytestmark = pytest.mark.long


def find(table, unknown=0.0, **more):
    """Return the episodes of a fleet with energy of an unknown cause, and the projection beside them."""
    windows, model = gather_with_model(make_tables(table, unknown=unknown, **more))
    return find_episodes(BaseProjection(windows, model), build_candidates(windows, model))


def list_dates(table, *places):
    """Return dates of driving by their place in time."""
    days = sorted(set(table["date"]))
    return [days[place] for place in places]


def add_power(table, dates, hours=(14, 17), kw=6.0, cars=None):
    """Return the energy of a power in the windows of some dates and hours, in all cars or some. [kWh]"""
    hour = table["start_s"] % 86_400.0 / 3600.0
    inside = table["date"].isin(dates) & (hour >= hours[0]) & (hour < hours[1])
    if cars:
        inside &= table["vehicle_id"].isin(cars)
    return (inside * kw * table["duration_s"] / 3600.0).to_numpy()


@pytest.mark.parametrize("kw", [6.0, 1.5, -3.0])
def test_power_in_some_hours_of_three_dates_is_an_episode(kw):
    table = make_windows()
    dates = list_dates(table, 2, 9, 15)
    (found,), _ = find(table, add_power(table, dates, kw=kw), of_ride=0.002, of_day=0.02)
    assert list(found.dates) == dates
    assert found.hours == (14, 15)  # no car drives later
    assert not found.whole
    assert found.low < kw < found.high
    assert abs(found.power - kw) < 0.2 * abs(kw)
    assert found.car is None
    assert len(found.cars) == found.driving == 4
    assert len(found.rides) == 12
    assert found.share > 0.3
    assert found.chance < 1e-6
    assert found.rows.sum() == 12 * 8


def test_power_on_a_whole_date_is_an_episode_of_all_hours():
    table = make_windows()
    (found,), _ = find(table, add_power(table, list_dates(table, 7), hours=(0, 24), kw=2.0))
    assert list(found.dates) == list_dates(table, 7)
    assert found.whole


def test_power_in_one_car_is_a_matter_of_that_car():
    table = make_windows()
    added = add_power(table, list_dates(table, 3, 4, 12), hours=(0, 24), cars=["taxi-2"])
    (found, *_), _ = find(table, added)
    assert found.car == "taxi-2"
    assert found.cars == ("taxi-2",)
    assert {ride.split("#")[0] for ride in found.rides} == {"taxi-2"}


@pytest.mark.parametrize("seed", range(4))
def test_chance_is_no_episode(seed):
    table = make_windows()
    found, base = find(table, seed=seed, of_ride=0.01, of_day=0.1)
    assert not found
    assert base.rank == find(table, seed=seed, of_ride=0.01, of_day=0.1)[1].rank


@pytest.mark.parametrize("name", ["snow", "wet_road", "headwind", "cold_rolling"])
def test_effect_of_library_is_no_episode(name):
    assert not find(make_windows(), shares={name: 0.06})[0]


def test_same_hours_of_all_dates_are_no_episode():
    table = make_windows()
    assert not find(table, add_power(table, set(table["date"]), kw=2.0))[0]


def test_single_ride_is_no_episode():
    table = make_windows()
    added = add_power(table, list_dates(table, 5), cars=["taxi-1"], kw=9.0)
    assert np.count_nonzero(added) == 8
    assert not find(table, added)[0]


def test_evening_after_midnight_utc_belongs_to_one_day():
    """Hours are counted from the hour with the least driving; dates are those on which the hours begin."""
    start = make_windows()["start_s"] + 11.0 * 3600.0  # the rides begin at 19, 22 and 1 h UTC
    table = make_windows().assign(start_s=start, date=pd.to_datetime(start, unit="s").dt.strftime("%Y-%m-%d"))
    before = list_dates(table, 4, 10)
    hour = start % 86_400.0 / 3600.0
    shift = pd.to_datetime(start - 6.0 * 3600.0, unit="s").dt.strftime("%Y-%m-%d")
    inside = shift.isin(before) & ((hour >= 22) | (hour < 2))
    (found,), _ = find(table, (inside * 5.0 / 60.0).to_numpy())
    assert found.hours == (22, 2)
    assert list(found.dates) == before
    assert (found.rows == inside.to_numpy()).all()


def test_further_steps_leave_the_power_of_an_episode_out():
    table = make_windows()
    added = add_power(table, list_dates(table, 2, 9, 15))
    (found,), base = find(table, added)
    energy = base.convert_to_energy(base.residual)
    hours = get_numbers(base.windows.table, "duration_s") / 3600.0
    assert abs(energy[found.rows].sum() / hours[found.rows].sum()) < 0.3
    column = base.project_out(found.column)
    assert (column**2).sum() < 1e-6 * (base.apply_weights(found.column) ** 2).sum()


def test_two_episodes_are_told_apart():
    table = make_windows()
    added = add_power(table, list_dates(table, 2, 9)) + add_power(table, list_dates(table, 13), hours=(8, 9), kw=-5.0)
    found, _ = find(table, added)
    assert sorted(round(each.power) for each in found) == [-5, 6]
    assert all(each.low < each.power < each.high for each in found)


def test_fewer_than_six_dates_show_no_episode():
    table = make_windows(days=5)
    assert not find(table, add_power(table, list_dates(table, 2)))[0]
