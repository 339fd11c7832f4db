"""Test that published files of the BMW i3 are read in all their variants."""

from datetime import UTC, datetime
from zoneinfo import ZoneInfo

import pytest

from socast.tools.importers import bmw_i3
from socast.tools.importers.drive import ReadOptions, make_messages, make_samples
from socast.tools.importers.published import read_table
from tests.support.published_files import BMW_HEADER, bmw_file, overview

BERLIN = ReadOptions(ZoneInfo("Europe/Berlin"))


@pytest.mark.parametrize(
    ("header", "tail"),
    [
        (BMW_HEADER, ""),
        (BMW_HEADER.replace("[km/h]", "[km/h]]]"), ""),
        (BMW_HEADER + ";", ""),
        (BMW_HEADER + ";", ";"),
        (BMW_HEADER.replace("Time [s]", "Time [s] "), ""),
    ],
)
def test_bmw_header_variants_give_the_same_messages(tmp_path, header, tail):
    overview(tmp_path)
    (drive,) = bmw_i3.read_drives(bmw_file(tmp_path / "TripA01.csv", header, tail=tail), BERLIN)
    (plain,) = bmw_i3.read_drives(bmw_file(tmp_path / "TripA01.csv"), BERLIN)
    assert make_messages([drive], 3.0) == make_messages([plain], 3.0)
    sample = make_samples(drive, 3.0)[4]
    assert (sample.speed_kmh, sample.battery_voltage_v, sample.battery_current_a) == (36.0, 390.0, 10.0)
    assert (sample.elevation_m, sample.ambient_c, sample.battery_temperature_c) == (500.0, 25.0, 20.0)
    assert sample.hvac_w == 1200.0


def test_bmw_file_in_utf8_with_byte_order_mark_is_read(tmp_path):
    text = bmw_file(tmp_path / "TripA01.csv").read_bytes().decode("latin-1")
    (tmp_path / "TripB03.csv").write_text("\ufeff" + text, encoding="utf-8")
    table = read_table(tmp_path / "TripB03.csv", bmw_i3.BMW_I3)
    assert table["Battery Temperature [C]"].eq(20).all()


def test_bmw_dates_are_munich_time_in_both_spellings(tmp_path):
    overview(tmp_path)
    (summer,) = bmw_i3.read_drives(bmw_file(tmp_path / "TripA01.csv"), BERLIN)
    (winter,) = bmw_i3.read_drives(bmw_file(tmp_path / "TripB03.csv"), BERLIN)
    assert datetime.fromtimestamp(summer.start, UTC) == datetime(2019, 6, 25, 11, 21, 14, tzinfo=UTC)
    assert datetime.fromtimestamp(winter.start, UTC) == datetime(2019, 12, 8, 8, 38, 26, tzinfo=UTC)


def test_bmw_frozen_heater_reading_gives_no_heating_power(tmp_path):
    header = BMW_HEADER.replace("Heating Power LIN [W];", "")
    path = bmw_file(tmp_path / "TripA01.csv", header, row="{t};36;500;390;-10;20;80;90;5.32;0.4;25;;9;10")
    overview(tmp_path)
    (drive,) = bmw_i3.read_drives(path, BERLIN)
    assert {s.hvac_w for s in make_samples(drive, 3.0)} == {None}
