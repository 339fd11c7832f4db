"""Test that times which are covered twice are found, and that files which share a time rightly are not."""

from collections import Counter

import numpy as np
import pytest

from socast.tools.importers.table.row_order import COVERED_TWICE, TimeSpans, leave_out_covered_twice


def make_rows(times, vehicle=0, **fields):
    """Return rows of one car; by default each has a speed."""
    fields = fields or {"speed_kmh": 30.0}
    rows = np.zeros(len(times), [("time", "f8"), ("vehicle", "i4"), *((name, "f8") for name in fields)])
    rows["time"], rows["vehicle"] = times, vehicle
    for name, value in fields.items():
        rows[name] = value
    return rows


def find(*blocks):
    """Return the overlap of blocks, each with the name of its file."""
    spans = TimeSpans()
    for file, rows in blocks:
        spans.add(file, rows)
    return spans.find_overlap()


HOUR = np.arange(0.0, 3600.0, 3.0)


def test_files_on_top_of_each_other_are_found():
    found = find(("a", make_rows(HOUR)), ("b", make_rows(HOUR[:600])), ("c", make_rows(HOUR + 7200.0)))
    assert (found.files, found.start, found.vehicle) == (("a", "b"), 0.0, 0)
    assert found.duration == pytest.approx(1797.0)


def test_clock_that_steps_back_in_one_file_is_found_across_blocks():
    found = find(("a", make_rows(HOUR)), ("a", make_rows(HOUR + 600.0)), ("a", make_rows(HOUR + 4200.0)))
    assert (found.files, found.start) == (("a",), 600.0)
    assert found.duration == pytest.approx(2997.0)


@pytest.mark.parametrize(
    "times",
    [
        pytest.param(HOUR[::-1], id="last row first"),
        pytest.param(np.random.default_rng(1).permutation(HOUR), id="in no order"),
        pytest.param(np.concatenate([HOUR + 7200.0, HOUR]), id="last ride first"),
        pytest.param(HOUR + 20.0 * (np.arange(len(HOUR)) % 2), id="small steps back"),
    ],
)
def test_order_of_rows_in_a_file_is_free(times):
    assert find(*(("a", make_rows(part)) for part in np.array_split(times, 3))) is None


def test_files_of_different_cars_or_with_different_fields_may_share_a_time():
    assert find(("a", make_rows(HOUR, 0)), ("b", make_rows(HOUR, 1))) is None
    assert find(("a", make_rows(HOUR, speed_kmh=1.0)), ("b", make_rows(HOUR, speed_kmh=np.nan, soc_pct=80.0))) is None


def test_rides_that_share_their_end_and_start_do_not_overlap():
    assert find(("a", make_rows(HOUR)), ("b", make_rows(HOUR + 3597.0))) is None


@pytest.mark.parametrize(
    ("speed", "left", "lost"), [(60.0, 400, 2000), (30.0, 2400, 0)], ids=["other rows", "the same"]
)
def test_rows_of_a_clock_that_steps_back_are_left_out_unless_they_repeat_each_other(speed, left, lost):
    again = make_rows(HOUR[200:], speed_kmh=speed)
    spans, causes = TimeSpans(), Counter()
    first = make_rows(np.concatenate([HOUR, HOUR[-1:] + 3.0 * np.arange(1, 201)]))
    spans.add("a", first)
    spans.add("a", again)
    rows = np.concatenate([first, again])
    rows = rows[np.argsort(rows["time"], kind="stable")]
    kept = np.concatenate(list(leave_out_covered_twice([rows[:700], rows[700:]], spans, causes)))
    assert (len(kept), causes[COVERED_TWICE]) == (left, lost)
    assert (np.diff(kept["time"]) >= 0.0).all()
