"""Test that the day changes with most of the active cars, whatever some clocks say and however often they send."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.columns import SECONDS_PER_DAY as DAY
from socast.core.forecast.day_rollover import RECENT_SAMPLES, WINDOW_SAMPLES, DayRollover

YEAR = 365.0 * DAY
ROLLOVER = -1024.0 * 7.0 * DAY
"""Error of a clock that takes GPS weeks for those of the epoch before. [s]"""
MIDNIGHT = 19_000.0 * DAY
NOON = MIDNIGHT - 0.5 * DAY


def sent(car=0, days=3.0, period=600.0, wrong=0.0, size=1, since=0.0):
    """Return the samples of a car from noon on, in lists of `size`: (n, 3) arrival, car and stamp."""
    time = NOON + since + car % 97 / 97.0 * period + period * np.arange(int((days * DAY - since) / period))
    last = np.minimum(np.arange(len(time)) // size * size + size - 1, len(time) - 1)
    return np.column_stack([time[last], np.full(len(time), float(car)), time + wrong])


def stream(*cars):
    """Return the arrival times, lanes and stamps of several cars' samples, in the order of arrival."""
    time, lane, stamp = np.concatenate(cars)[np.argsort(np.concatenate(cars)[:, 0], kind="stable")].T
    return time, lane.astype(np.int64), stamp


def find_rollover_rows(lane, stamp, cuts=(), rollover=None):
    """Return the rows before which the day changes, for samples in several batches."""
    rollover, before, rows = rollover or DayRollover(), 0, []
    for lanes, part in zip(np.split(lane, sorted(cuts)), np.split(stamp, sorted(cuts)), strict=True):
        rows += [before + row for row, _ in rollover.find_rollovers(lanes, part)]
        before += len(part)
    return rows


def after_midnight(*cars):
    """Return the delay of each rollover after midnight, without the first, which begins the stream. [s]"""
    time, lane, stamp = stream(*cars)
    at = time[find_rollover_rows(lane, stamp)]
    assert at[0] < NOON + 8000.0
    assert np.floor(at[1:] / DAY).tolist() == [19_000.0, 19_001.0, 19_002.0]
    return at[1:] % DAY


def test_single_car_rolls_over_at_its_second_sample_of_the_day():
    time, lane, stamp = stream(sent())
    rows = find_rollover_rows(lane, stamp)
    assert rows[0] == 1
    assert [np.flatnonzero(time >= MIDNIGHT + DAY * day)[1] for day in range(3)] == rows[1:]


def test_large_fleet_rolls_over_once_a_day_when_most_cars_are_in_it():
    assert after_midnight(*(sent(car, period=7200.0) for car in range(10_000))).max() < 2.1 * 7200.0


@pytest.mark.parametrize("awake", [1, 3, 30])
def test_few_active_cars_at_midnight_decide_the_rollover(awake):
    resting = [sent(car, days=0.4, period=60.0) for car in range(awake, 2000)]
    late = after_midnight(*resting, *(sent(car, days=3.0, period=10.0) for car in range(awake)))
    assert late.max() <= 10.0 * max(RECENT_SAMPLES / awake, 2.0)


@pytest.mark.parametrize("wrong", [YEAR, 30.0 * YEAR, 3.0 * DAY, -3.0 * DAY, -YEAR])
@pytest.mark.parametrize("fellows", [1, 2, 9])
@pytest.mark.parametrize(("size", "often"), [(1, 1), (2, 1), (500, 1), (1, 10), (7, 10)])
def test_one_wrong_clock_moves_no_rollover_however_often_it_sends(wrong, fellows, size, often):
    others = [sent(car, period=60.0) for car in range(fellows)]
    wild = sent(fellows, period=60.0 / often, wrong=wrong, size=size, since=1800.0)
    assert after_midnight(*others, wild).max() <= 180.0


@pytest.mark.parametrize("wrong", [1.2 * DAY, 0.7 * DAY, -0.7 * DAY, -1.2 * DAY])
@pytest.mark.parametrize(("size", "often"), [(1, 1), (2, 1), (7, 10)])
def test_clock_wrong_by_hours_moves_no_rollover_of_several_cars(wrong, size, often):
    others = [sent(car, period=60.0) for car in range(3)]
    wild = sent(3, period=60.0 / often, wrong=wrong, size=size, since=1800.0)
    assert after_midnight(*others, wild).max() <= 180.0


def test_long_lists_of_a_clock_ahead_by_hours_make_rollovers_early_but_not_more():
    others = [sent(car, period=60.0) for car in range(9)]
    _, lane, stamp = stream(*others, sent(9, period=60.0, wrong=0.7 * DAY, size=500, since=1800.0))
    assert len(find_rollover_rows(lane, stamp)) == 1 + 4  # it comes to the fourth midnight before the end


@pytest.mark.parametrize("wrong", [ROLLOVER, -ROLLOVER, 3.0 * DAY])
@pytest.mark.parametrize("cars", [3, 30, 1500])
def test_a_third_of_wrong_clocks_moves_no_rollover(wrong, cars):
    period = 60.0 if cars < 1000 else 900.0
    time, lane, stamp = stream(*(sent(car, period=period, wrong=wrong * (car % 3 == 2)) for car in range(cars)))
    at = time[find_rollover_rows(lane, stamp)]
    assert (at[at > NOON + 3600.0] % DAY).max() <= 2.1 * period
    assert np.floor(at[at > NOON + 3600.0] / DAY).tolist() == [19_000.0, 19_001.0, 19_002.0]


def test_car_without_a_clock_hides_no_rollover():
    assert after_midnight(sent(0), sent(1, wrong=np.nan)).max() <= 1200.0


def test_single_glitch_of_every_car_changes_nothing():
    time, lane, stamp = stream(*(sent(car) for car in range(4)))
    stamp = stamp + YEAR * ((np.arange(len(stamp)) // 4) % 5 == 2)
    at = time[find_rollover_rows(lane, stamp)]
    assert np.floor(at[1:] / DAY).tolist() == [19_000.0, 19_001.0, 19_002.0]


@pytest.mark.parametrize("wrong", [3.0 * DAY, YEAR])
def test_day_that_is_ahead_is_corrected_by_most_active_cars(wrong):
    rollover = DayRollover()
    find_rollover_rows(*stream(*(sent(car, days=0.2, wrong=wrong) for car in range(3)))[1:], rollover=rollover)
    time, lane, stamp = stream(*(sent(car, since=0.2 * DAY) for car in range(3)))
    at = time[find_rollover_rows(lane, stamp, rollover=rollover)]
    assert at[0] <= time[0] + 1200.0
    assert np.floor(at[1:] / DAY).tolist() == [19_000.0, 19_001.0, 19_002.0]


def test_first_car_whose_clock_is_a_day_ahead_delays_no_rollover():
    fellows = [sent(car, period=60.0) for car in range(1, 6)]
    _, lane, stamp = stream(sent(0, period=60.0, wrong=DAY), *fellows)
    _, *others = stream(*fellows)
    times = stamp[find_rollover_rows(lane, stamp)]
    assert set(others[1][find_rollover_rows(*others)][1:]) <= set(times)


def test_one_rollover_after_idle_days():
    _, lane, stamp = stream(
        *(sent(car, days=0.3) for car in range(4)), *(sent(car, since=5.7 * DAY, days=6) for car in range(4))
    )
    assert len(find_rollover_rows(lane, stamp)) == 2


@cache
def several():
    """Return the samples of a fleet with some wrong clocks, one of which sends lists."""
    cars = [sent(car, wrong=wrong) for car, wrong in enumerate((0.0, YEAR, 0.4 * DAY, -3.0 * DAY, 1.1 * DAY))]
    return stream(*cars, sent(5, wrong=-YEAR, size=40))[1:]


@given(st.lists(st.integers(0, 2592), max_size=8))
def test_any_chunking_gives_the_same_rollovers(cuts):
    lane, stamp = several()
    assert find_rollover_rows(lane, stamp, cuts) == find_rollover_rows(lane, stamp)


samples = st.tuples(st.integers(0, 4), st.sampled_from([0.0, np.nan, *(MIDNIGHT + DAY * np.arange(-4.0, 5.0)), 4.2e9]))


@given(st.lists(samples, max_size=40), st.lists(st.integers(0, 40), max_size=5))
def test_rollovers_are_ordered_for_any_stamps_cuts_and_restarts(stamps, cuts):
    lane, stamp = np.array([car for car, _ in stamps], np.int64), np.array([stamp for _, stamp in stamps])
    rows = find_rollover_rows(lane, stamp)
    assert rows == sorted(set(rows))
    assert all(0 < row < len(stamps) for row in rows)
    assert find_rollover_rows(lane, stamp, [cut for cut in cuts if cut <= len(stamps)]) == rows
    one, other, half = DayRollover(), DayRollover(), len(lane) // 2
    before = one.find_rollovers(lane[:half], stamp[:half])
    other.load(one.dump())
    rest = other.find_rollovers(lane[half:], stamp[half:])
    assert [row for row, _ in before] + [half + row for row, _ in rest] == rows
    assert one.find_rollovers(lane[half:], stamp[half:]) == rest
    assert one.dump() == other.dump()


def test_kept_counts_are_those_of_the_newest_samples():
    """The incremental counts equal counts over the newest samples, also after the ring is full."""
    rng = np.random.default_rng(1)
    lane, rollover = (
        rng.integers(0, 5000, 5 * WINDOW_SAMPLES) // rng.integers(1, 5000, 5 * WINDOW_SAMPLES),
        DayRollover(),
    )
    rollover.find_rollovers(lane, MIDNIGHT + DAY * rng.integers(-4, 5, len(lane)))
    again = DayRollover()
    again.load(rollover.dump())
    for votes in ("_recent_votes", "_window_votes"):
        assert np.array_equal(getattr(again, votes), getattr(rollover, votes))
    newest = np.roll(rollover._newest, -rollover._place)
    for name, samples in (("recent", RECENT_SAMPLES), ("window", WINDOW_SAMPLES)):
        counts = np.bincount(newest[-samples:], minlength=len(rollover._clocks))
        assert np.array_equal(rollover._clocks[name], counts)
