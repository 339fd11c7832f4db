"""Test that a column of times that stands still is recognised, and another one read in its place."""

import numpy as np
import pandas as pd
import pytest

from socast.core.errors import ImportFileError
from socast.tools.importers.table.column_map import FileFormat, parse_map
from socast.tools.importers.table.conversion import convert_tables, open_tables
from socast.tools.importers.table.guess import guess_map, write_map_text
from socast.tools.importers.table.table_file import open_table
from tests.support.own_tables import START, make_drive, read_samples

CLOCK = "PhaseTime"


@pytest.fixture
def dynamometer(tmp_path):
    """Write a test file with names as in UN regulations, whose column of dates hardly moves."""
    d = make_drive(6000, 0.05)
    seconds = 0.0005 * np.arange(6000) // 0.002 * 0.002
    columns = {
        "Time": pd.to_datetime(START + seconds, unit="s").strftime("%Y-%m-%d %H:%M:%S.%f"),
        CLOCK: (d["time"] - START).round(2),
        "DAScheduleSpeed": 0,
        "DAActualSpeed": d["speed"] * 3.6,
        "REESSCurrent": -d["power"] / 360.0,
        "REESSVoltage": 360.0,
        "REESSCurrent2": 0.0,
        "tempAmb": 18.5,
    }
    path = tmp_path / "wltc.csv"
    pd.DataFrame(columns).to_csv(path, index=False)
    return path


def convert(path, text):
    """Convert a file with a map."""
    columns = parse_map(text.encode(), path.with_suffix(".toml"))
    out = path.with_suffix(".mcap")
    return convert_tables(open_tables([path], "csv", columns), columns, out), out


def test_count_beside_a_clock_that_stands_still_is_read_from_its_first_time(dynamometer):
    table = open_table(dynamometer, "csv", FileFormat())
    guessed = guess_map([table])
    assert guessed.time.columns == (CLOCK,)
    (doubt,) = guessed.time.doubts
    assert doubt.startswith("the times in column 'Time' are wrong: 3 s without gaps, 0.5 ms a row (limit: 5 ms)")
    assert {each.field for each in guessed.fields} == {
        "speed_kmh",
        "battery_voltage_v",
        "battery_current_a",
        "ambient_c",
    }
    summary, out = convert(dynamometer, write_map_text(guessed, table))
    times = [each.time_s for each in read_samples(out)]
    assert (times[0], times[-1]) == (START, START + 299.95)
    assert not [check for check in summary.checks if check.passed is False]


def test_clock_that_stands_still_is_named_with_value_limit_and_remedy(dynamometer):
    table = open_table(dynamometer, "csv", FileFormat())
    text = write_map_text(guess_map([table]), table)
    wrong = text.replace(f'column = "{CLOCK}"', 'column = "Time"').replace('unit = "s"\n', "")
    summary, _ = convert(dynamometer, wrong.replace("origin_column", "# origin_column"))
    (check,) = [check for check in summary.checks if check.passed is False]
    assert (check.name, check.limit) == ("clock against rows", "at least 5 ms between rows")
    assert check.found == "6,000 rows of wltc cover 3 s without gaps, 0.5 ms a row"
    assert "name another column in [time]" in check.remedy


def test_column_of_first_times_is_refused_beside_another_origin(dynamometer):
    text = '[vehicle]\nname = "a"\n[time]\ncolumn = "PhaseTime"\nunit = "s"\norigin_column = "Time"\n'
    fields = '[fields]\nspeed_kmh = { column = "DAActualSpeed" }\n'
    with pytest.raises(ImportFileError, match="leave out origin"):
        convert(dynamometer, text + "origin = '2024-01-01'\n" + fields)
    with pytest.raises(ImportFileError, match="add unit = 's'"):
        convert(dynamometer, text.replace('unit = "s"\n', "") + fields)
