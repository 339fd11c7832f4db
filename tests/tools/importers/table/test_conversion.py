"""Test that tables of many forms become the same samples, and that what cannot be read is counted by cause."""

from collections import Counter
from datetime import UTC, datetime

import msgspec
import pandas as pd
import pytest

from socast.core.errors import ImportFileError
from socast.core.wire.messages import Ride
from socast.stream.mcap_reader import McapSource
from socast.tools.importers.table.column_map import read_map
from socast.tools.importers.table.conversion import convert_tables, list_lines, open_tables
from socast.tools.importers.table.row_reader import AMBIGUOUS_TIME, IMPLAUSIBLE_TIME, NO_TIME, NO_VALUE, UNREADABLE_TIME
from socast.tools.importers.table.table_file import list_tables
from socast.tools.importers.table.text_stream import WRONG_WIDTH
from tests.support.own_tables import read_samples

MAP = """\
[vehicle]
name = "taxi-7"
[time]
column = "t"
{time}
{more}
[fields]
speed_kmh = {{ column = "speed" }}
{fields}
"""
NOON = datetime(2024, 5, 1, 12, tzinfo=UTC).timestamp()


def run(tmp_path, content, *, time="", more="", fields="", kind="csv", text=None):
    """Convert one table; return its samples and the summary."""
    files = content if isinstance(content, list) else [tmp_path / f"table.{kind}"]
    if isinstance(content, str):
        files[0].write_text(content, encoding="utf-8")
    elif isinstance(content, bytes):
        files[0].write_bytes(content)
    map_file = tmp_path / "map.toml"
    map_file.write_text(text or MAP.format(time=time, more=more, fields=fields), encoding="utf-8")
    columns = read_map(map_file)
    summary = convert_tables(open_tables(files, kind, columns), columns, tmp_path / "out.mcap")
    return read_samples(tmp_path / "out.mcap"), summary


def refused(tmp_path, *arguments, **options):
    """Return the one line of the error of a conversion."""
    with pytest.raises(ImportFileError) as error:
        run(tmp_path, *arguments, **options)
    assert "\n" not in str(error.value)
    return str(error.value)


SAME = [
    pytest.param("t,speed\n2024-05-01T12:00:00Z,10.5\n", {}, id="plain"),
    pytest.param("\ufefft,speed\n2024-05-01 12:00:00,10.5\n", {}, id="BOM"),
    pytest.param("t;speed\n2024-05-01T12:00:00Z;10,5\n", {}, id="semicolon and decimal comma"),
    pytest.param('t,speed\n2024-05-01T12:00:00Z,"10,5"\n', {}, id="comma and quoted decimal comma"),
    pytest.param("t\tspeed\n2024-05-01T14:00:00+02:00\t10.5\n", {}, id="tabulator and offset"),
    pytest.param("t,speed\n2024-05-01T12:00:00Z,10.5\n".encode("utf-16"), {}, id="UTF-16"),
    pytest.param("t,speed,Höhe\n2024-05-01T12:00:00Z,10.5,7\n".encode("latin-1"), {}, id="Latin-1"),
    pytest.param("logger 3\n\nt,speed\n2024-05-01 12:00,10.5\n", {"more": "[file]\nskip_lines = 2"}, id="lines above"),
    pytest.param("t,speed\r\n1714564800,10.5\r\n", {"time": "unit = 's'"}, id="Unix s"),
    pytest.param("t,speed\n1714564800000,+10.50\n", {"time": "unit = 'ms'"}, id="Unix ms"),
    pytest.param("t,speed\n3600,1.05e1\n", {"time": "unit = 's'\norigin = '2024-05-01T11:00:00'"}, id="origin"),
    pytest.param("t,speed\n2024-05-01 14:00:00,10.5\n", {"time": "zone = 'Europe/Berlin'"}, id="zone"),
    pytest.param(
        "t,speed\n05/01/2024 08:00 AM,10.5\n",
        {"time": "format = '%m/%d/%Y %I:%M %p'\nzone = 'America/Montreal'"},
        id="format",
    ),
]


@pytest.mark.parametrize(("content", "options"), SAME)
def test_forms_of_a_table_give_the_same_sample(tmp_path, content, options):
    (sample,), summary = run(tmp_path, content, **options)
    assert (sample.vehicle_id, sample.time_s, sample.speed_kmh) == ("taxi-7", NOON, 10.5)
    assert not summary.causes
    assert not summary.cells


def test_parquet_with_types_gives_the_samples_of_text(tmp_path):
    times = pd.to_datetime(["2024-05-01T12:00:00", "2024-05-01T12:00:02"])
    frame = pd.DataFrame({"t": times, "speed": [10, 11], "plugged": [True, False], "soc": [0.8, None]})
    frame.to_parquet(tmp_path / "table.parquet")
    fields = 'charging = { column = "plugged" }\nsoc_pct = { column = "soc", unit = "1" }'
    samples, _ = run(tmp_path, None, fields=fields, kind="parquet")
    assert [(s.time_s - NOON, s.speed_kmh, s.charging, s.soc_pct) for s in samples] == [
        (0.0, 10.0, True, 80.0),
        (2.0, 11.0, False, None),
    ]


def test_units_and_signs_are_converted(tmp_path):
    fields = """\
battery_voltage_v = { column = "u", unit = "mV" }
battery_current_a = { column = "i", sign = -1 }
ambient_c = { column = "temp", unit = "degF" }
odometer_km = { column = "odo", unit = "mi" }
elevation_m = { column = "alt", unit = "ft" }
"""
    (sample,), _ = run(tmp_path, "t,speed,u,i,temp,odo,alt\n2024-05-01T12:00Z,1,360000,-5,50,100,1000\n", fields=fields)
    assert (sample.battery_voltage_v, sample.battery_current_a) == (360.0, 5.0)
    assert (sample.ambient_c, sample.odometer_km, sample.elevation_m) == (10.0, 160.9344, 304.8)


def test_power_alone_is_sent_as_voltage_times_current(tmp_path):
    content = "t,speed,p,u\n2024-05-01T12:00:00Z,1,7200,\n2024-05-01T12:00:02Z,1,-3000,400\n"
    fields = 'battery_power_kw = { column = "p", unit = "W" }\nbattery_voltage_v = { column = "u" }'
    samples, _ = run(tmp_path, content, fields=fields)
    assert [(s.battery_voltage_v, s.battery_current_a) for s in samples] == [(360.0, 20.0), (400.0, -7.5)]


def test_rows_that_cannot_be_read_are_counted_by_cause_and_others_kept(tmp_path):
    good = [f"2024-05-01T12:00:{second:02},{second}" for second in range(10)]
    bad = [",1", "yesterday,2", "1970-01-02T00:00:00,3", "2024-05-01T13:00:00,", "2024-05-01T13:00:00,1,2,3"]
    samples, summary = run(tmp_path, "\n".join(["t,speed", *good, *bad, "2024-05-01T14:00:00,fast"]) + "\n")
    assert [s.speed_kmh for s in samples] == list(range(10))
    assert summary.causes == Counter({NO_TIME: 1, UNREADABLE_TIME: 1, IMPLAUSIBLE_TIME: 1, NO_VALUE: 2, WRONG_WIDTH: 1})
    assert summary.rows == len(samples) + summary.causes.total()
    assert (summary.cells, summary.examples) == (Counter({"speed": 1}), {"speed": "fast"})


def read_hours(tmp_path, times):
    """Return hours and minutes in UTC of local times in Berlin, and what was counted."""
    samples, summary = run(tmp_path, "\n".join(["t,speed", *(f"{t},1" for t in times)]), time="zone = 'Europe/Berlin'")
    return [datetime.fromtimestamp(s.time_s, UTC).strftime("%H:%M") for s in samples], summary.causes


def test_hour_that_the_change_of_the_clock_repeats_is_placed_by_the_rows_beside_it(tmp_path):
    hours = ["01:55", "02:00", "02:05", *(f"02:{m}" for m in range(10, 60, 5))]
    again = ["02:00", "02:05", *(f"02:{m}" for m in range(10, 60, 5)), "03:00"]
    found, causes = read_hours(tmp_path, [f"2024-10-27 {hour}:00" for hour in hours + again])
    assert found == ["23:55", *(f"{h:02}:{m:02}" for h in (0, 1) for m in range(0, 60, 5)), "02:00"]
    assert not causes


def test_rows_of_the_second_repeated_hour_are_placed_by_those_after_it(tmp_path):
    found, causes = read_hours(tmp_path, [f"2024-10-27 {hour}" for hour in ("02:50", "02:55", "03:00", "03:05")])
    assert (found, causes) == (["01:50", "01:55", "02:00", "02:05"], Counter())


def test_repeated_hour_without_rows_beside_it_and_skipped_hour_are_counted(tmp_path):
    times = ["2024-10-27 01:45:00", "2024-10-27 02:30:00", "2024-10-27 03:00:00", "2024-03-31 02:30:00"]
    found, causes = read_hours(tmp_path, times)
    assert found == ["23:45", "02:00"]
    assert causes == Counter({AMBIGUOUS_TIME: 2})


def test_time_of_day_takes_the_day_from_the_file_name_and_passes_midnight(tmp_path):
    file = tmp_path / "drive_2024-05-01.csv"
    file.write_text("t,speed\n23:59:58.5,1\n23:59:59.5,2\n00:00:00.5,3\n")
    samples, _ = run(tmp_path, [file], time="format = '%H:%M:%S.%f'\nday_from_file_name = true")
    assert [s.time_s - NOON for s in samples] == [43198.5, 43199.5, 43200.5]
    file.write_text("t,speed\n86398,1\n1,3\n")
    samples, _ = run(tmp_path, [file], time="unit = 's'\nday_from_file_name = true\nzone = 'Europe/Berlin'")
    assert [s.time_s - NOON for s in samples] == [35998, 36001]
    other = tmp_path / "drive.csv"
    other.write_text("t,speed\n1,3\n")
    assert "its name holds no day" in refused(tmp_path, [other], time="unit = 's'\nday_from_file_name = true")


def test_positions_in_degrees_and_minutes_are_read(tmp_path):
    content = "t,speed,lat,lon\n2024-05-01T12:00Z,1,9 54.5,-84 6\n2024-05-01T12:01Z,1,9.5,-84.25\n"
    fields = 'latitude_deg = { column = "lat" }\nlongitude_deg = { column = "lon" }'
    samples, _ = run(tmp_path, content, fields=fields)
    assert [s.latitude_deg for s in samples] == pytest.approx([9.9083333, 9.5])
    assert [s.longitude_deg for s in samples] == pytest.approx([-84.1, -84.25])


def test_rows_table_holds_values_and_sets_the_period(tmp_path):
    content = "t,speed,i\n" + "".join(
        f"{1714564800 + s},{'' if s % 2 else 36},{5 if s % 2 else ''}\n" for s in range(60)
    )
    fields = 'battery_current_a = { column = "i", hold_s = 3 }'
    samples, summary = run(tmp_path, content, time="unit = 's'", more="[rows]\nperiod_s = 2", fields=fields)
    assert (len(samples), summary.samples, summary.rows) == (30, 30, 60)
    assert {(s.speed_kmh, s.battery_current_a) for s in samples} == {(36.0, 5.0)}
    samples, _ = run(tmp_path, content, time="unit = 's'", more="[rows]\nhold_s = 0.5")
    assert [s.speed_kmh for s in samples[:3]] == [36.0, 36.0, 36.0]


def test_decimal_comma_that_the_map_denies_is_named_with_its_remedy(tmp_path):
    content = 't,speed,soc\n2024-05-01T12:00:00Z,"10,5",80\n'
    fields = 'soc_pct = { column = "soc" }'
    _, summary = run(tmp_path, content, more="[file]\ndecimal = '.'", fields=fields)
    assert any("'10,5'; set decimal = ',' in [file]" in line for line, _ in list_lines(summary))


def test_duplicate_headers_are_refused_until_one_is_chosen(tmp_path):
    content = "t,speed,speed\n2024-05-01T12:00:00Z,1,2\n"
    assert "column 'speed' appears 2 times; write speed#1 or speed#2 in the map" in refused(tmp_path, content)
    text = MAP.format(time="", more="", fields="").replace('"speed"', '"speed#2"')
    ((sample,), _) = run(tmp_path, content, text=text)
    assert sample.speed_kmh == 2.0


def test_files_in_any_order_are_merged_by_time(tmp_path):
    files = []
    for name, seconds in (("b", (3, 1)), ("a", (2, 0))):
        files.append(tmp_path / f"{name}.csv")
        rows = "".join(f"2024-05-01T12:00:0{second}Z,{second}\n" for second in seconds)
        files[-1].write_text("t,speed\n" + rows)
    text = MAP.format(time="", more="[ride]\nfrom_file_name = true", fields="").replace(
        'name = "taxi-7"', 'from_file_name = true\nprefix = "car-"\nmodel = "nissan-leaf-2013"'
    )
    samples, _ = run(tmp_path, list_tables([tmp_path], "csv"), text=text)
    assert [(s.vehicle_id, s.ride_id, s.speed_kmh) for s in samples] == [
        ("car-a", "a", 0), ("car-b", "b", 1), ("car-a", "a", 2), ("car-b", "b", 3),
    ]  # fmt: skip
    assert files
    keys = [message.key for block in McapSource(tmp_path / "out.mcap") for message in block]
    assert keys.count("fleet/car-a/vehicle") == 1


def test_gaps_divide_rides_of_each_car_and_leave_them_without_names(tmp_path):
    rows = [("a", 0), ("b", 5), ("a", 10), ("b", 700), ("a", 701), ("a", 702)]
    stamps = [(car, datetime.fromtimestamp(NOON + second, UTC).isoformat()) for car, second in rows]
    content = "t,speed,car\n" + "".join(f"{stamp},1,{car}\n" for car, stamp in stamps)
    text = MAP.format(time="", more="[ride]\ngap_s = 300", fields="").replace('name = "taxi-7"', 'column = "car"')
    samples, _ = run(tmp_path, content, text=text)
    assert {s.ride_id for s in samples} == {None}
    messages = [m for block in McapSource(tmp_path / "out.mcap") for m in block if m.key.endswith("/ride")]
    events = [msgspec.json.decode(m.payload, type=Ride) for m in messages]
    assert [(e.vehicle_id, e.event, e.time_s - NOON) for e in events] == [
        ("b", "end", 5), ("b", "start", 700), ("a", "end", 10), ("a", "start", 701),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "is empty"),
        ("t,speed\n", "none of 0 rows can be read"),
        ("t,speed\nx,1\n", "1 rows can be read (1 with a time that cannot be read; first in table.csv line 2: 'x')"),
        ("when,speed\n1,2\n", "has no column 't'; it has when, speed; correct the map"),
        (b"PAR1\0\0\0\0", "use `socast import parquet`"),
    ],
)
def test_wrong_file_is_one_clear_line(tmp_path, content, words):
    assert words in refused(tmp_path, content)
    assert not (tmp_path / "out.mcap").exists()


def test_missing_parquet_file_is_one_clear_line(tmp_path):
    assert "cannot be read" in refused(tmp_path, [tmp_path / "none.parquet"], kind="parquet")


def test_rows_longer_than_the_header_are_read_where_the_map_says_so(tmp_path):
    rows = "".join(f"2024-05-01T12:00:{s:02}Z,{s}{',x,9' if s > 5 else ''}\n" for s in range(10))
    samples, summary = run(tmp_path, "t,speed\n" + rows)
    assert (len(samples), summary.causes) == (6, Counter({WRONG_WIDTH: 4}))
    samples, summary = run(tmp_path, "t,speed\n" + rows + "2024\n", more="[file]\nextra_cells = true")
    assert [s.speed_kmh for s in samples] == list(range(10))
    assert (summary.causes, summary.rows) == (Counter({WRONG_WIDTH: 1}), 11)
