"""Test that an import finds and announces what the power of its samples covers."""

import msgspec
import numpy as np
import pandas as pd
import pytest

from socast.core.errors import ImportFileError
from socast.core.wire.messages import Vehicle
from socast.stream.mcap_reader import McapSource
from socast.tools.importers.table.column_map import parse_map
from socast.tools.importers.table.conversion import convert_tables, open_tables
from socast.tools.importers.table.row_messages import measure_span
from tests.support.own_tables import START, make_drive

FINE = 10
MAP = """[vehicle]
name = "taxi-7"
model = "nissan-leaf-2013"
[time]
column = "time"
unit = "s"
[fields]
speed_kmh = { column = "speed" }
battery_power_kw = { column = "power" }
"""


def make_rows(span, step=2.0):
    """Return times [s], speeds [km/h] and powers [W] of rows whose power covers a span, by a drive ten times finer."""
    d = make_drive(1200 * FINE, step / FINE)
    sums = np.append(0.0, np.cumsum(d["power"]))
    at = FINE * np.arange(2, 1198)
    low, high = {"moment": (0, 1), "before": (-FINE, 0), "around": (-FINE // 2, FINE // 2), "after": (0, FINE)}[span]
    return d["time"][at], d["speed"][at] * 3.6, (sums[at + high] - sums[at + low]) / (high - low)


def announce(tmp_path, rows, extra=""):
    """Import rows; return what the recording announces of the power, and the notes of the summary."""
    times, speed, power = rows
    pd.DataFrame({"time": times, "speed": speed, "power": power / 1e3}).to_csv(tmp_path / "car.csv", index=False)
    columns = parse_map((extra + MAP).encode(), tmp_path / "map.toml")
    summary = convert_tables(open_tables([tmp_path / "car.csv"], "csv", columns), columns, tmp_path / "car.mcap")
    messages = [m for block in McapSource(tmp_path / "car.mcap") for m in block if m.key.endswith("/vehicle")]
    return msgspec.json.decode(messages[0].payload, type=Vehicle).power_covers, summary.notes


@pytest.mark.parametrize(
    ("span", "found"), [("moment", None), ("before", "before"), ("around", None), ("after", "after")]
)
@pytest.mark.parametrize("step", [1.0, 3.0])
def test_kinetic_power_on_one_side_of_a_row_shows_a_mean(span, found, step):
    evidence = measure_span(*make_rows(span, step))
    assert evidence is not None
    assert evidence.span == found


def test_power_without_driving_shows_nothing():
    times, speed, power = make_rows("before")
    assert measure_span(times, 0.0 * speed, power) is None
    noise = np.random.default_rng(1).normal(0.0, 1e4, len(power))
    evidence = measure_span(times, speed, noise)
    assert evidence is None or evidence.span is None


def test_import_announces_what_rows_show_and_says_so(tmp_path):
    span, notes = announce(tmp_path, make_rows("before"))
    assert span == "before"
    (note,) = [note for note in notes if note.startswith("the power of taxi-7")]
    assert "is taken as the mean over the time before each row" in note
    assert "write power_covers = 'moment' in [rows]" in note


def test_statement_of_the_map_comes_before_what_rows_show(tmp_path):
    assert announce(tmp_path, make_rows("before"), '[rows]\npower_covers = "moment"\n')[0] == "moment"
    with pytest.raises(ImportFileError, match="power_covers is 'mean', must be one of moment, before"):
        announce(tmp_path, make_rows("before"), '[rows]\npower_covers = "mean"\n')


def test_samples_of_many_rows_cover_the_time_around_them(tmp_path):
    rows = make_rows("moment")
    assert announce(tmp_path, rows, "[rows]\nperiod_s = 6\n")[0] == "around"
    assert announce(tmp_path, rows, "[rows]\nperiod_s = 2\n")[0] is None
    assert rows[0][0] > START
