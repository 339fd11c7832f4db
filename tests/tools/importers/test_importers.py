"""Each importer converts small files in its published format; test_real_drives.py imports the real ones."""

from datetime import UTC, datetime
from zoneinfo import ZoneInfo

import msgspec
import numpy as np
import pytest

from core.vehicles import load_catalogue
from core.wire.messages import Ride, Telemetry, Vehicle, Weather, address
from tests.support.published_files import BMW_HEADER, VED_HEADER, bmw_file, overview, twizy_file, ved_file, ved_row
from tools.importers import bmw_i3, twizy, ved
from tools.importers.drive import ReadOptions, make_messages, make_samples
from tools.importers.published import read_table

UTC_ZONE, BERLIN, CASABLANCA = (ReadOptions(ZoneInfo(name)) for name in ("UTC", "Europe/Berlin", "Africa/Casablanca"))


def decode(messages):
    """Return the values of messages."""
    kinds = {"telemetry": Telemetry, "vehicle": Vehicle, "ride": Ride, "weather": Weather}
    return [msgspec.json.decode(m.payload, type=kinds[address(m.key).kind]) for m in messages]


def test_drive_gives_vehicle_start_samples_and_end(tmp_path):
    (drive,) = ved.read_drives(ved_file(tmp_path / "week.csv"), UTC_ZONE)
    out = decode(make_messages([drive], 3.0))
    vehicle, start, *sent, end = out
    assert vehicle == Vehicle("ved-455", start.time_s, "nissan-leaf-2013")
    assert (start.ride_id, start.event) == ("ved-455-1", "start")
    assert end == Ride("ved-455", sent[-1].time_s, "ved-455-1", "end")
    assert [s.seq for s in sent] == list(range(21))
    assert np.diff([s.time_s for s in sent]) == pytest.approx(3.0, abs=2e-3)
    assert sent[3] == Telemetry(
        "ved-455",
        sent[3].time_s,
        ride_id="ved-455-1",
        seq=3,
        latitude_deg=42.24,
        longitude_deg=-83.74,
        speed_kmh=36.0,
        soc_pct=80.1,
        battery_voltage_v=360.0,
        battery_current_a=20.0,
        ambient_c=11.5,
        hvac_w=1000.0,
    )


def test_ved_day_numbers_count_from_november_2017(tmp_path):
    (drive,) = ved.read_drives(
        ved_file(tmp_path / "week.csv", [ved_row(250, day=1.5), ved_row(3000, day=1.5)]), UTC_ZONE
    )
    assert drive.start == datetime(2017, 11, 1, 12, tzinfo=UTC).timestamp() + 0.25
    (local,) = ved.read_drives(tmp_path / "week.csv", ReadOptions(ZoneInfo("America/Detroit")))
    assert local.start - drive.start == 4 * 3600


def test_ved_weekly_file_gives_only_electric_cars(tmp_path):
    rows = [ved_row(ms, trip=trip) for trip in (1, 2) for ms in (0, 1000, 2000)]
    rows += [ved_row(ms, vehicle=9, engine=1200) for ms in (0, 1000)]
    rows += [ved_row(ms, vehicle=8, current=None) for ms in (0, 1000)]
    rows += [ved_row(ms, vehicle=10) for ms in (0, 1000)]
    path = ved_file(tmp_path / "VED_171101_week.csv", rows)
    assert [d.ride_id for d in ved.read_drives(path, UTC_ZONE)] == ["ved-10-1", "ved-455-1", "ved-455-2"]
    assert [d.ride_id for d in ved.read_drives(path, UTC_ZONE._replace(vehicles=[455]))] == ["ved-455-1", "ved-455-2"]
    assert ved.read_drives(path, UTC_ZONE._replace(vehicles=[8])) == []


ENGINE_NAMES = {"MAF[g/sec]", "Engine RPM[RPM]", "Absolute Load[%]"}


def test_ved_extract_without_engine_columns_gives_the_same_messages(tmp_path):
    keep = [i for i, name in enumerate(VED_HEADER.split(",")) if "Fuel" not in name and name not in ENGINE_NAMES]
    ved_file(tmp_path / "week.csv")
    lines = [line.split(",") for line in (tmp_path / "week.csv").read_text().splitlines()]
    (tmp_path / "trip.csv").write_text("\n".join(",".join(line[i] for i in keep) for line in lines))
    (whole,), (extract,) = (ved.read_drives(tmp_path / name, UTC_ZONE) for name in ("week.csv", "trip.csv"))
    assert make_messages([whole], 3.0) == make_messages([extract], 3.0)


def test_ved_uses_kilowatts_of_air_conditioning_where_watts_are_missing(tmp_path):
    rows = [ved_row(ms).replace(",0.1,100,", ",0.25,NaN,") for ms in (0, 3000)]
    (drive,) = ved.read_drives(ved_file(tmp_path / "week.csv", rows), UTC_ZONE)
    assert drive.rows["hvac_w"].tolist() == [1150.0, 1150.0]


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


def test_twizy_weather_becomes_observations_of_a_station(tmp_path):
    (drive,) = twizy.read_drives(twizy_file(tmp_path / "T3.csv"), CASABLANCA)
    (observed,) = drive.weather
    assert (observed.wind_speed_kmh, observed.temperature_c, observed.humidity_pct) == (9.0, 20.0, 60.0)
    assert observed.wind_from_deg is None
    assert make_messages([drive], 3.0)[0].key == "weather/rabat"
    assert make_samples(drive, 3.0)[0].ambient_c is None


def test_twizy_garbled_dates_get_the_date_of_their_neighbours(tmp_path):
    (clean,) = twizy.read_drives(twizy_file(tmp_path / "T3.csv"), CASABLANCA)
    (repaired,) = twizy.read_drives(twizy_file(tmp_path / "T3.csv", garbled={0, 7, 8, 60}), CASABLANCA)
    assert make_messages([repaired], 3.0) == make_messages([clean], 3.0)
    assert "4 rows have no readable date" in repaired.notes[0]
    assert not clean.notes


def test_twizy_time_is_local_time_of_rabat_including_ramadan(tmp_path):
    (march,) = twizy.read_drives(twizy_file(tmp_path / "a.csv", date="03/29/2021"), CASABLANCA)
    (april,) = twizy.read_drives(twizy_file(tmp_path / "b.csv"), CASABLANCA)
    assert march.start == datetime(2021, 3, 29, 7, 42, tzinfo=UTC).timestamp()
    assert april.start == datetime(2021, 4, 22, 8, 42, tzinfo=UTC).timestamp()


def test_twizy_defective_positions_stay_in_the_recording(tmp_path):
    (drive,) = twizy.read_drives(twizy_file(tmp_path / "T3.csv"), CASABLANCA)
    positions = [(s.latitude_deg, s.longitude_deg) for s in make_samples(drive, 3.0)]
    assert positions[10] == (0.0, 0.0)
    assert set(positions) == {(0.0, 0.0), (33.986225, -6.725523)}


def test_imported_models_are_in_the_catalogue():
    assert {ved.MODEL, bmw_i3.MODEL, twizy.MODEL} <= set(load_catalogue())
