"""Test that published files of the Renault Twizy are read, with their weather and garbled dates."""

from datetime import UTC, datetime
from zoneinfo import ZoneInfo

from socast.tools.importers import twizy
from socast.tools.importers.drive import ReadOptions, make_messages, make_samples
from tests.support.published_files import twizy_file

CASABLANCA = ReadOptions(ZoneInfo("Africa/Casablanca"))


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
