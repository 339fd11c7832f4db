"""Nights fall by the stamps of samples, whatever one clock says."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from core.ahead.calendar import DAY, Calendar

YEAR = 365.0 * DAY
MIDNIGHT = 19_000.0 * DAY


def days(cars=4, days=5, wrong=0.0, period=600.0, bursts=1):
    """Return stamps of cars that send one after another, the first one's clock being wrong by so much."""
    time = MIDNIGHT + 1000.0 + period * np.arange(int(days * DAY / period))
    stamps = np.repeat(time[:, None], cars * bursts, axis=1) + np.repeat(np.arange(cars), bursts)
    stamps[:, :bursts] += wrong
    return stamps.ravel()


def found(stamps, cuts=()):
    """Return the rows before which nights fall, of stamps that are cut."""
    calendar, before, rows = Calendar(), 0, []
    for part in np.split(stamps, sorted(cuts)):
        rows += [before + row for row in calendar.nights(part)]
        before += len(part)
    return rows


def test_every_day_has_one_night():
    stamps = days()
    rows = found(stamps)
    assert rows[0] == 1
    assert np.floor(stamps[rows[1:]] / DAY).tolist() == [19_000.0 + day for day in range(1, 6)]
    assert all(stamps[row - 2] < DAY * np.floor(stamps[row] / DAY) for row in rows[1:])


@pytest.mark.parametrize("wrong", [YEAR, 3.0 * DAY, 0.7 * DAY, -0.7 * DAY, -YEAR, 80.0 * YEAR])
@pytest.mark.parametrize("cars", [2, 3, 6])
@pytest.mark.parametrize("bursts", [1, 3])
def test_one_wrong_clock_among_others_does_not_stop_nights(wrong, cars, bursts):
    stamps = days(cars, wrong=wrong, bursts=bursts)
    rows = found(stamps)
    right = np.sort(days(1))
    for day in range(1, 6):
        midnight = MIDNIGHT + DAY * day
        at = [
            row
            for row in rows
            if midnight - 0.7 * DAY <= right[min(row // (cars * bursts), len(right) - 1)] < midnight + DAY
        ]
        assert at, (day, rows)


@given(st.lists(st.integers(0, 2880), max_size=8), st.sampled_from([0.0, YEAR, -YEAR, 2.5 * DAY]))
def test_any_chunking_gives_the_same_nights(cuts, wrong):
    stamps = days(wrong=wrong)
    assert found(stamps, cuts) == found(stamps)


@given(st.lists(st.floats(-1e10, 1e12), max_size=40), st.lists(st.integers(0, 40), max_size=5))
def test_any_stamps_have_nights_in_order_and_within_them(stamps, cuts):
    stamps = np.array(stamps)
    rows = found(stamps)
    assert rows == sorted(set(rows))
    assert all(0 < row < len(stamps) for row in rows)
    assert found(stamps, [cut for cut in cuts if cut <= len(stamps)]) == rows


def test_what_was_dumped_goes_on_as_if_nothing_had_happened():
    stamps = days()
    one, other = Calendar(), Calendar()
    one.nights(stamps[:300])
    other.load(one.dump())
    assert one.nights(stamps[300:]) == other.nights(stamps[300:])
