"""Test that rows are sorted across runs on disk."""

import numpy as np
import pytest

from socast.tools.importers.table.row_order import sort_rows

DTYPE = np.dtype([("time", "f8"), ("vehicle", "i4"), ("at", "i8")])


def make_blocks(times, size):
    """Return rows with a running number in blocks."""
    rows = np.array([(time, at % 3, at) for at, time in enumerate(times)], DTYPE)
    return [rows[at : at + size] for at in range(0, len(rows), size)]


@pytest.mark.parametrize("run_rows", [50, 10_000])
@pytest.mark.parametrize("window_rows", [7, 100_000])
def test_rows_of_any_order_come_out_by_time_and_vehicle(tmp_path, run_rows, window_rows):
    times = np.random.default_rng(1).integers(0, 60, 500).astype(float)
    windows = list(sort_rows(make_blocks(times, 13), tmp_path, run_rows, window_rows))
    rows = np.concatenate(windows)
    expected = sorted(zip(times.tolist(), (np.arange(500) % 3).tolist(), range(500), strict=True))
    assert [tuple(row) for row in rows.tolist()] == expected
    assert list(tmp_path.iterdir()) == []


def test_rows_of_one_time_are_never_divided(tmp_path):
    windows = list(sort_rows(make_blocks([1.0] * 40 + [2.0] * 40, 10), tmp_path, 20, 5))
    ends = [(window["time"][0], window["time"][-1]) for window in windows]
    assert [b for _, b in ends[:-1]] < [a for a, _ in ends[1:]]
    assert sum(map(len, windows)) == 80


def test_no_rows_give_nothing(tmp_path):
    assert list(sort_rows([], tmp_path)) == []
