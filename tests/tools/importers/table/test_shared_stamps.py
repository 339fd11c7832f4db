"""Test that rows which share a stamp get the times at which they were taken, or are left out."""

import numpy as np
import pandas as pd
import pytest

from socast.tools.importers.table.row_messages import join_signals
from socast.tools.importers.table.shared_stamps import StampStatistics, spread_rows
from tests.support.commands import called
from tests.support.own_tables import make_drive, read_samples

TIMES = 1714572013.4 + np.arange(0.0, 900.0)


def make_rows(stamps, vehicle=0):
    """Return rows with stamps; the speed says when each was taken."""
    rows = np.zeros(len(stamps), [("time", "f8"), ("vehicle", "i4"), ("ride", "i4"), ("speed_kmh", "f8")])
    rows["time"], rows["vehicle"], rows["speed_kmh"] = stamps, vehicle, np.arange(len(stamps))
    return rows


def spread(rows, parts=1, counts=None, left_out=None):
    """Return rows with times of their own, given in parts, and the rules."""
    statistics = StampStatistics()
    statistics.add(rows)
    ordered = rows[np.lexsort((rows["vehicle"], rows["time"]))]
    cuts = np.unique(np.searchsorted(ordered["time"], ordered["time"][:: max(1, len(rows) // parts)], "left"))[1:]
    blocks = spread_rows(np.split(ordered, cuts), statistics.find_rules(), {} if counts is None else counts,
                         {} if left_out is None else left_out)  # fmt: skip
    return np.concatenate(list(blocks)), statistics.find_rules()


def send_in_bursts(size):
    """Return the stamps of bursts: the time of the last row of each, and half a second."""
    last = np.minimum((np.arange(len(TIMES)) // size + 1) * size - 1, len(TIMES) - 1)
    return TIMES[last] + 0.5


STAMPS = {
    "cut to minutes": (np.floor(TIMES / 60) * 60, "cut"),
    "cut to 10 s": (np.floor(TIMES / 10) * 10, "cut"),
    "rounded to minutes": (np.round(TIMES / 60) * 60, "cut"),
    "bursts of 20": (send_in_bursts(20), "sent after"),
    "bursts of 37": (send_in_bursts(37), "sent after"),
}


@pytest.mark.parametrize("name", STAMPS)
def test_rows_lie_a_second_apart_in_their_order(name):
    stamps, kind = STAMPS[name]
    rows, rules = spread(make_rows(stamps))
    assert rules[0].kind == kind
    assert rules[0].period == pytest.approx(1.0, rel=0.02)
    assert rows["speed_kmh"].tolist() == list(range(900))
    assert np.diff(rows["time"]) == pytest.approx(1.0, abs=0.2)
    assert np.ptp(rows["time"]) == pytest.approx(899.0, abs=2.0)


def test_rows_of_a_file_with_the_newest_first_are_turned():
    rows, rules = spread(make_rows(np.floor(TIMES[::-1] / 60) * 60))
    assert rules[0].is_reversed
    assert rows["speed_kmh"].tolist() == list(range(899, -1, -1))


def test_rows_before_a_pause_begin_with_their_minute_and_those_after_it_end_with_theirs():
    times = np.append(TIMES[:300], TIMES[300:] + 1000.0)
    rows, _ = spread(make_rows(np.floor(times / 60) * 60))
    assert np.abs(rows["time"] - times).max() < 1.1


def test_minutes_that_lack_rows_are_left_out():
    left_out = {}
    lost = (TIMES[0] + 400.0 < TIMES) & (TIMES[0] + 430.0 > TIMES)
    stamps = np.floor(TIMES[~lost] / 60) * 60
    rows, _ = spread(make_rows(stamps), left_out=left_out)
    assert 25 <= left_out[0] <= 65
    assert len(rows) == len(stamps) - left_out[0]


@pytest.mark.parametrize("parts", [3, 10])
def test_division_into_blocks_changes_nothing(parts):
    both = np.concatenate([make_rows(STAMPS["cut to minutes"][0]), make_rows(TIMES + 0.2, vehicle=1)])
    whole, _ = spread(both)
    divided, _ = spread(both, parts)
    assert divided.tolist() == whole.tolist()
    assert (np.diff(whole["time"]) >= 0).all()


@pytest.mark.parametrize("stamps", [TIMES, np.repeat(TIMES, 2), np.append(TIMES, TIMES[:40])])
def test_rows_with_stamps_of_their_own_and_rows_given_twice_are_left_alone(stamps):
    rows = make_rows(np.sort(stamps))
    rows["speed_kmh"] = np.searchsorted(TIMES, rows["time"])
    assert spread(rows)[1] == {}


def test_rows_of_one_time_are_joined_only_where_they_hold_different_fields():
    nan = np.nan
    dtype = [("time", "f8"), ("vehicle", "i4"), ("speed_kmh", "f8"), ("soc_pct", "f8")]
    rows = np.array([(1, 0, 5, nan), (1, 0, nan, 80), (1, 0, 6, nan), (2, 0, 7, 81)], dtype)
    assert join_signals(rows, is_long=False)["speed_kmh"].tolist() == [5, 6, 7]
    assert join_signals(rows)["speed_kmh"].tolist() == [6, 7]


def write(file, stamps):
    """Write the drive with some stamps."""
    d = make_drive(rows=1200, step=1.0)
    columns = {"time": stamps(d["stamp"]), "speed_kmh": d["speed"] * 3.6, "power_kw": d["power"] / 1000}
    pd.DataFrame(columns | {"odometer_km": 12000 + d["distance"] / 1000}).round(3).to_csv(file, index=False)


def test_import_of_whole_minutes_says_how_rows_were_spread(tmp_path):
    write(tmp_path / "log.csv", lambda stamps: stamps.floor("min").astype(str))
    printed, errors, code = called("import", "csv", tmp_path / "log.csv", "--guess", "-o", tmp_path / "log.mcap")
    assert code == 0, errors
    assert "1,200 rows of log share stamps with others (stamps cut to 60 s: rows spread evenly" in printed
    assert "does not agree" not in printed
    times = np.array([each.time_s for each in read_samples(tmp_path / "log.mcap")])
    assert np.diff(times) == pytest.approx(1.0, abs=0.01)


def test_rows_of_which_all_share_one_stamp_are_refused(tmp_path):
    write(tmp_path / "log.csv", lambda stamps: [str(stamps[0])] * len(stamps))
    _, errors, code = called("import", "csv", tmp_path / "log.csv", "--guess", "-o", tmp_path / "log.mcap")
    assert code == 2
    assert "nothing shows when its rows were taken" in errors
