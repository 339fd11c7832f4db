"""Test that weather from columns of the rows and from files of stations enters a recording as observations."""

from datetime import UTC, datetime

import msgspec
import numpy as np
import pandas as pd
import pytest

from socast.core.errors import ImportFileError
from socast.core.wire.messages import Weather
from socast.stream.mcap_reader import McapSource
from socast.tools.importers.table.column_map import parse_map
from socast.tools.importers.table.conversion import convert_tables, open_tables
from socast.tools.importers.table.weather_file import read_weather_file
from tests.support.own_tables import START, make_drive

MAP = """[vehicle]
name = "taxi-7"
[time]
column = "time"
unit = "s"
[fields]
latitude_deg = { column = "lat" }
longitude_deg = { column = "lon" }
speed_kmh = { column = "speed" }
"""
COLUMNS = """ambient_c = { column = "air" }
wind_speed_kmh = { column = "wind", unit = "m/s" }
wind_from_deg = { column = "from" }
precipitation_mm = { column = "rain", unit = "mm/h" }
"""
OPEN_METEO = """latitude,longitude,elevation,utc_offset_seconds,timezone,timezone_abbreviation
45.4,-73.7,36.0,-14400,America/Toronto,GMT-4

time,temperature_2m (°C),wind_speed_10m (km/h),wind_direction_10m (°)
"""


def convert(tmp_path, fields="", weather=None):
    """Convert a drive of 40 min; return the summary and the observations in the recording."""
    d = make_drive()
    columns = {"time": d["time"], "speed": d["speed"] * 3.6, "lat": d["latitude"], "lon": d["longitude"]}
    here = {"air": 1.5, "wind": 3.0, "from": np.where(np.arange(1200) % 2, 350.0, 10.0), "rain": 2.0}
    pd.DataFrame(columns | here).to_csv(tmp_path / "car.csv", index=False)
    parsed = parse_map((MAP + fields).encode(), tmp_path / "map.toml")
    out = tmp_path / "car.mcap"
    summary = convert_tables(open_tables([tmp_path / "car.csv"], "csv", parsed), parsed, out, weather=weather)
    decode = msgspec.json.Decoder(Weather).decode
    messages = [message for block in McapSource(out) for message in block]
    assert [each.receipt_ns for each in messages] == sorted(each.receipt_ns for each in messages)
    return summary, [decode(each.payload) for each in messages if each.key.startswith("weather/")]


def write_hours(path, head, first, hours=48):
    """Write an observation per hour from a local time on, as Open-Meteo does."""
    stamps = [datetime.fromtimestamp(first + 3600 * hour, UTC) for hour in range(hours)]
    path.write_text(head + "".join(f"{each:%Y-%m-%dT%H:%M},{each.hour},18.0,270\n" for each in stamps))
    return path


def test_columns_of_rows_become_observations_at_the_place_of_the_car(tmp_path):
    _, seen = convert(tmp_path, COLUMNS)
    assert [each.time_s - START for each in seen] == [300.0 * place for place in range(8)]
    first, second = seen[:2]
    assert (first.station_id, first.latitude_deg, first.temperature_c) == ("taxi-7", 45.5, 1.5)
    assert (first.wind_speed_kmh, first.wind_from_deg) == (10.8, 10.0)
    assert second.wind_speed_kmh == pytest.approx(10.8 * np.cos(np.radians(10.0)), abs=1e-3)
    assert (first.precipitation_mm, second.precipitation_mm) == (2.0, pytest.approx(2.0 / 12.0, abs=1e-3))


def test_file_of_open_meteo_is_read_in_its_own_zone(tmp_path):
    file = read_weather_file(write_hours(tmp_path / "om.csv", OPEN_METEO, START - 12 * 3600.0))
    summary, seen = convert(tmp_path, COLUMNS, file)
    assert {each.station_id for each in seen} == {"om"}
    assert (seen[-1].time_s, seen[-1].temperature_c) == (START, 10.0)
    assert (seen[0].latitude_deg, seen[0].wind_speed_kmh) == (45.4, 18.0)
    (check,) = [check for check in summary.checks if check.name == "weather against rows"]
    assert check.passed


def test_weather_of_other_days_is_named_with_both_times(tmp_path):
    file = read_weather_file(write_hours(tmp_path / "om.csv", OPEN_METEO, START - 100 * 3600.0))
    summary, _ = convert(tmp_path, "", file)
    (check,) = [check for check in summary.checks if check.passed is False]
    assert check.found == "0%, observations from 2024-04-27 14:00 to 2024-04-29 13:00 UTC"


def test_station_without_a_place_is_put_where_the_cars_drive(tmp_path):
    head = "valid,tmpf,sknt,drct\n"
    file = read_weather_file(write_hours(tmp_path / "yul.csv", head, START - 2 * 3600.0, 5))
    summary, seen = convert(tmp_path, "", file)
    assert seen[0].longitude_deg == -73.6
    assert seen[0].temperature_c == pytest.approx((12.0 - 32.0) / 1.8, abs=1e-3)
    assert seen[0].wind_speed_kmh == pytest.approx(18.0 * 1.852, abs=1e-3)
    assert any("its place is not stated" in note and "read as UTC" in note for note in summary.notes)


def test_file_without_weather_or_times_is_refused_with_the_remedy(tmp_path):
    path = tmp_path / "notes.csv"
    path.write_text("time,remark\n2024-05-01T08:00Z,fine\n")
    with pytest.raises(ImportFileError, match="name columns as the contract does: temperature_c"):
        read_weather_file(path)
    path.write_text("day,temperature\nMonday,12\nTuesday,13\n")
    with pytest.raises(ImportFileError, match="no column holds dates with times"):
        read_weather_file(path)
