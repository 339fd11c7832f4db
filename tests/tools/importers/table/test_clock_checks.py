"""Test that files on top of each other are refused or reported, and not blamed on signs."""

import numpy as np
import pandas as pd
import pytest

from socast.core.errors import ImportFileError
from socast.tools.importers.table.column_map import parse_map
from socast.tools.importers.table.conversion import convert_tables, open_tables
from tests.support.own_tables import make_drive, read_samples

MAP = """\
[vehicle]
name = "taxi-7"
[time]
column = "t"
{time}
[fields]
speed_kmh = {{ column = "speed" }}
battery_power_kw = {{ column = "power" }}
"""


def run(tmp_path, tables, time):
    """Convert tables of the columns t, speed and power by their names; return the summary."""
    for name, columns in tables.items():
        pd.DataFrame(columns).to_csv(tmp_path / name, index=False)
    columns = parse_map(MAP.format(time=time).encode(), tmp_path / "map.toml")
    files = open_tables([tmp_path / name for name in tables], "csv", columns)
    return convert_tables(files, columns, tmp_path / "out.mcap")


def make_table(times, seed=0):
    """Return a drive, with another start of its speeds for each seed."""
    d = make_drive(len(times) + 50)
    part = slice(seed * 7, seed * 7 + len(times))
    return {"t": times, "speed": d["speed"][part] * 3.6, "power": d["power"][part] / 1000.0}


ELAPSED = np.arange(600) * 2.0


def test_files_with_one_origin_that_cover_the_same_time_are_refused(tmp_path):
    tables = {f"{name}.csv": make_table(ELAPSED, seed) for seed, name in enumerate("abc")}
    with pytest.raises(ImportFileError) as refused:
        run(tmp_path, tables, "unit = 's'\norigin = '2000-01-01T00:00:00'")
    message = str(refused.value)
    assert message.startswith(
        "3 files cover the same 39.9 min of taxi-7: a.csv, b.csv, c.csv, first at 2000-01-01 00:00:00 UTC"
    )
    assert "origin_from_file_name" in message
    assert "\n" not in message
    assert not (tmp_path / "out.mcap").exists()


def test_starts_in_file_names_place_files_one_after_the_other(tmp_path):
    tables = {f"ride_2024-05-01_{hour}0000.csv": make_table(ELAPSED) for hour in ("08", "16")}
    summary = run(
        tmp_path, tables, "unit = 's'\norigin_from_file_name = 'ride_%Y-%m-%d_%H%M%S'\nzone = 'Europe/Berlin'"
    )
    times = [sample.time_s for sample in read_samples(tmp_path / "out.mcap")]
    assert (times[0], times[600]) == (1714543200.0, 1714543200.0 + 8 * 3600.0)
    assert not [check for check in summary.checks if check.passed is False]


def test_local_time_read_as_utc_is_reported_and_signs_are_not_judged(tmp_path):
    local = pd.date_range("2024-10-26 23:30", periods=1800, freq="6s", tz="UTC").tz_convert("Europe/Berlin")
    d = make_drive(1800, step=6.0)
    table = {"t": local.strftime("%Y-%m-%d %H:%M:%S"), "speed": d["speed"] * 3.6, "power": d["power"] / 1000.0}
    failed = [check for check in run(tmp_path, {"a.csv": table}, "").checks if check.passed is False]
    assert [check.name for check in failed] == ["times of rows"]
    assert failed[0].found == "one file covers 59.9 min of taxi-7 twice, first at 2024-10-27 02:00:00 UTC"
    assert "set zone in [time]" in failed[0].remedy
    assert not [
        check for check in run(tmp_path, {"a.csv": table}, "zone = 'Europe/Berlin'").checks if check.passed is False
    ]


@pytest.mark.parametrize(
    ("origin", "passed", "words"),
    [
        ("2000-01-01T00:00:00", None, "the origin 2000-01-01 is a guess"),
        ("2012-01-01T00:00:00", True, "years before the files were written"),
        ("2099-01-01T00:00:00", False, "years after the files were written"),
    ],
)
def test_clock_is_compared_with_the_file_in_years_and_not_for_a_guessed_origin(tmp_path, origin, passed, words):
    check = run(tmp_path, {"a.csv": make_table(ELAPSED)}, f"unit = 's'\norigin = '{origin}'").checks[-1]
    assert (check.name, check.passed) == ("clock against file", passed)
    assert words in check.found
