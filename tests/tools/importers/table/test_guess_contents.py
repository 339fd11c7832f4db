"""Test what the cells of columns say whose names say too little, or something that cannot be."""

import numpy as np
import pandas as pd
import pytest

from socast.core.errors import ImportFileError
from socast.tools.importers.table.column_map import FileFormat, parse_map
from socast.tools.importers.table.guess import guess_map, write_map_text
from socast.tools.importers.table.table_file import open_table
from tests.support.own_tables import make_drive


def guess(tmp_path, **columns):
    """Return the guessed map of a table with these columns."""
    path = tmp_path / "table.csv"
    pd.DataFrame(columns).to_csv(path, index=False)
    return guess_map([open_table(path, "csv", FileFormat())])


def list_units(found):
    """Return the column and the unit of each field."""
    return {each.field: (each.column, each.unit) for each in found.fields}


def test_column_of_times_in_iso_8601_is_the_clock_whatever_its_name(tmp_path):
    d = make_drive(100)
    found = guess(tmp_path, started="2024-05-01T14:00:00", tijdje=d["stamp"].strftime("%Y-%m-%dT%H:%M:%SZ"), speed=1.0)
    assert (found.time.columns, found.time.has_zone) == (("tijdje",), True)


def test_unix_time_goes_before_a_clock_that_starts_at_0(tmp_path):
    d = make_drive(100)
    found = guess(tmp_path, time=d["time"] - d["time"][0], gps_time=d["time"], speed=d["speed"])
    assert (found.time.columns, found.time.needs_origin) == (("gps_time",), False)


def test_iso_date_and_time_of_day_in_two_columns_are_one_clock(tmp_path):
    stamps = make_drive(100)["stamp"]
    found = guess(tmp_path, Time=stamps.strftime("%H:%M:%S"), Date=stamps.strftime("%Y-%m-%d"), speed=1.0)
    assert (found.time.columns, found.time.form, found.time.day_from_file_name) == (("Date", "Time"), None, False)


def test_letters_of_voltage_and_current_are_read_where_their_values_fit(tmp_path):
    d = make_drive(200)
    found = guess(tmp_path, time=d["time"], speed=d["speed"] * 3.6, V=360.0, I=d["power"] / 360.0)
    assert list_units(found)["battery_voltage_v"] == ("V", "V")
    assert list_units(found)["battery_current_a"] == ("I", "A")


@pytest.mark.parametrize("volts", [12.6, np.linspace(0, 100, 200)], ids=["12 V battery", "a speed"])
def test_letters_with_other_values_are_not_read(tmp_path, volts):
    d = make_drive(200)
    found = guess(tmp_path, time=d["time"], speed=d["speed"] * 3.6, V=volts, I=d["power"] / 360.0)
    assert set(list_units(found)) == {"speed_kmh"}


def test_one_temperature_without_a_place_is_taken_as_outside_and_said_so(tmp_path):
    d = make_drive(100)
    found = guess(tmp_path, time=d["time"], speed=d["speed"], tempF=np.linspace(40, 50, 100))
    (field,) = [each for each in found.fields if each.field == "ambient_c"]
    assert (field.column, field.unit, "taken as outside: check it" in field.reasons[0]) == ("tempF", "F", True)
    both = guess(tmp_path, time=d["time"], speed=d["speed"], temp=20.0, batt_temp=25.0)
    assert "ambient_c" not in list_units(both)


@pytest.mark.parametrize(
    ("name", "factor", "unit"),
    [("power_kW", 1.0, "W"), ("power_W", 1e-3, "kW"), ("power_kW", 1e-3, "kW"), ("power_W", 1.0, "W")],
)
def test_unit_in_the_name_of_a_power_yields_to_values_that_contradict_it(tmp_path, name, factor, unit):
    d = make_drive(600)
    found = guess(tmp_path, **{"time": d["time"], "speed_kmh": d["speed"] * 3.6, name: d["power"] * factor})
    (power,) = [each for each in found.fields if each.field == "battery_power_kw"]
    assert (power.unit.lower(), power.sign) == (unit.lower(), 1)
    assert ("by the values" in power.reasons[0]) == (not name.endswith(f"_{unit}"))


@pytest.mark.parametrize(
    ("name", "values", "field", "unit"),
    [
        ("voltage_V", 360_000.0, "battery_voltage_v", "mV"),
        ("soc_pct", np.linspace(0.9, 0.8, 100), "soc_pct", "1"),
        ("soc_pct", np.linspace(90, 80, 100), "soc_pct", "pct"),
    ],
)
def test_unit_in_a_name_yields_to_values_that_are_impossible(tmp_path, name, values, field, unit):
    d = make_drive(100)
    assert list_units(guess(tmp_path, **{"time": d["time"], "speed": 1.0, name: values}))[field] == (name, unit)


def write_rides(tmp_path, names):
    """Return tables of rides whose clocks start at 0."""
    d = make_drive(300)
    for name in names:
        columns = {"time_ms": (d["time"] - d["time"][0]) * 1000, "speed_mps": d["speed"], "power_w": d["power"]}
        pd.DataFrame(columns).to_csv(tmp_path / name, index=False)
    return [open_table(tmp_path / name, "csv", FileFormat()) for name in names]


def test_start_of_a_relative_clock_is_taken_from_file_names(tmp_path):
    tables = write_rides(tmp_path, ["ride_2024-05-01_061500.csv", "ride_2024-05-01_161500.csv"])
    found = guess_map(tables)
    text = write_map_text(found, tables[0])
    assert found.time.origin_form == "%Y-%m-%d_%H%M%S"
    assert parse_map(text.encode(), tmp_path / "map.toml").time.origin_form == "%Y-%m-%d_%H%M%S"


def test_sign_is_judged_for_each_of_several_files_with_a_relative_clock(tmp_path):
    found = guess_map(write_rides(tmp_path, ["TripA01.csv", "TripA02.csv"]))
    (power,) = [each for each in found.fields if each.field == "battery_power_kw"]
    assert power.reasons[-1] == "sign: acceleration discharges the battery"
    assert (found.time.needs_origin, found.time.origin_form) == (True, None)


def test_quoted_decimal_comma_in_a_file_with_commas_is_found(tmp_path):
    path = tmp_path / "table.csv"
    path.write_text("time,speed,power_kW\n" + "".join(f'2024-04-01 06:20:{s:02},"5,5","2,57"\n' for s in range(30)))
    assert open_table(path, "csv", FileFormat()).decimal == ","
    path.write_text("time,speed,odometer\n" + "".join(f'2024-04-01 06:20:{s:02},5.5,"12,345"\n' for s in range(30)))
    assert open_table(path, "csv", FileFormat()).decimal == "."


def test_message_names_the_decimal_mark_where_no_row_can_be_read(tmp_path):
    path = tmp_path / "table.csv"
    path.write_text("time,speed\n" + "".join(f'2024-04-01 06:20:{s:02},"5,5"\n' for s in range(30)))
    table = open_table(path, "csv", FileFormat(decimal="."))
    with pytest.raises(ImportFileError, match=r"no value in any field of the map.*set decimal = ',' in"):
        guess_map([table])
