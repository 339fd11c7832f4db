"""Test that a mistake in a map is one line with its place, the value and the remedy."""

import pytest

from socast.core.errors import ImportFileError
from socast.tools.importers.table.column_map import read_map

GOOD = """\
[vehicle]
name = "taxi-7"
[time]
column = "t"
[fields]
speed_kmh = { column = "speed", unit = "mph" }
"""


def write(tmp_path, text):
    """Return a map file."""
    path = tmp_path / "map.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_map_holds_conversions(tmp_path):
    columns = read_map(write(tmp_path, GOOD))
    assert columns.fields["speed_kmh"].conversion.factor == pytest.approx(1.609344)
    assert columns.list_columns() == ["t", "speed"]


@pytest.mark.parametrize(
    ("old", "new", "line", "words"),
    [
        ('unit = "mph"', 'unit = "kWh"', 6, "unit 'kWh' does not convert to km/h; write one such as km/h, mph or m/s"),
        ('unit = "mph"', 'unit = "warp"', 6, "unit 'warp' does not convert"),
        ('unit = "mph"', "sign = 2", 6, "sign is 2, must be 1 or -1"),
        ("speed_kmh", "speed_kph", 6, "no field is called 'speed_kph'; did you mean 'speed_kmh'?"),
        ('column = "speed", ', "", 6, "speed_kmh needs a column"),
        ('"t"', '"t"\nzone = "Berlin"', 5, "zone is 'Berlin', which is no time zone"),
        ('"t"', '"t"\nunit = "days"', 5, "unit is 'days', must be one of s, ms"),
        ('"t"', "7", 4, "column is 7, must be text in quotes or a list"),
        ('"t"', '"t"\norigin = "noon"', 5, "origin is 'noon', must be a date and time"),
        ('"t"', '"t"\norigin_from_file_name = "%Y-%m-%d"', 5, "add unit = 's'"),
        ('"t"', '"t"\nunit = "s"\norigin_from_file_name = "%A"', 6, "'%A' holds '%A'; write a form such as ride_%Y-"),
        ('"t"', '"t"\nunit = "s"\norigin_from_file_name = "%H%M"', 6, "'%H%M' holds no day"),
        ("[time]", "[clock]", 3, "no table is called 'clock'"),
        ('name = "taxi-7"', "", 1, "[vehicle] needs one of column, name and from_file_name, and has none"),
        ('name = "taxi-7"', 'nmae = "x"', 2, "'vehicle' has no key 'nmae'; did you mean 'name'?"),
        ("[fields]", "[ride]\ngap_s = 0.5\n[fields]", 6, "gap_s is 0.5, must be from 1 to 86400 s"),
        ("[fields]", "[file]\ndecimal = ';'\n[fields]", 6, "decimal is ';', must be '.' or ','"),
        ("[fields]", "[fields", 5, "is not TOML"),
    ],
)
def test_mistake_is_one_line_with_its_place(tmp_path, old, new, line, words):
    assert old in GOOD
    path = write(tmp_path, GOOD.replace(old, new))
    with pytest.raises(ImportFileError) as refused:
        read_map(path)
    message = str(refused.value)
    assert message.startswith(f"{path}, line {line}"), message
    assert words in message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ('[vehicle]\nname = "taxi-7"\n', "names no car; add [vehicle] with name = ..."),
        ('[time]\ncolumn = "t"\n', "has no table [time]; add [time] with column = ..."),
    ],
)
def test_missing_table_is_named_without_a_line(tmp_path, table, words):
    path = write(tmp_path, GOOD.replace(table, ""))
    with pytest.raises(ImportFileError) as refused:
        read_map(path)
    assert str(refused.value).startswith(f"{path}: {words}")


def test_missing_map_names_the_way_to_write_one(tmp_path):
    with pytest.raises(ImportFileError, match="write a first map with --guess"):
        read_map(tmp_path / "none.toml")


def test_signal_without_long_form_is_refused(tmp_path):
    path = write(tmp_path, GOOD.replace('column = "speed"', 'signal = "speed"'))
    with pytest.raises(ImportFileError, match=r"\[long\] is missing"):
        read_map(path)
