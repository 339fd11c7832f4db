"""Test that the unit of a clock in numbers follows from what a car can drive, and not from its name alone."""

import numpy as np
import pandas as pd
import pytest

from tests.support.commands import called
from tests.support.own_tables import make_drive, read_samples

DRIVE = make_drive(600)
START = DRIVE["time"][0]
ELAPSED = DRIVE["time"] - START
PER_SECOND = {"ns": 1e9, "us": 1e6, "ms": 1e3, "s": 1.0, "min": 1 / 60, "h": 1 / 3600, "d": 1 / 86400}
WITNESSES = {
    "odometer": {"odometer_km": (12000 + DRIVE["distance"] / 1000).round(3)},
    "positions": {"latitude": DRIVE["latitude"], "longitude": DRIVE["longitude"]},
    "acceleration": {},
}


def import_guessed(path, columns):
    """Import a table with a guessed map; return the samples, what was printed, and the map."""
    pd.DataFrame(columns).to_csv(path, index=False)
    out, map_file = path.with_suffix(".mcap"), path.with_suffix(".toml")
    printed, errors, code = called("import", "csv", path, "--guess", "--map", map_file, "-o", out)
    assert code == 0, errors
    return read_samples(out), printed, map_file.read_text(encoding="utf-8")


def list_times(samples):
    """Return the times of samples. [Unix s]"""
    return np.array([each.time_s for each in samples])


@pytest.mark.parametrize("witness", WITNESSES)
@pytest.mark.parametrize("unit", PER_SECOND)
def test_unit_follows_from_what_the_car_drives(tmp_path, unit, witness):
    columns = {"time": ELAPSED * PER_SECOND[unit], "speed_kmh": DRIVE["speed"] * 3.6, **WITNESSES[witness]}
    samples, printed, text = import_guessed(tmp_path / "ride 2024-05-01 14-00-00.csv", columns)
    assert f'unit = "{unit}"' in text
    assert list_times(samples) == pytest.approx(START + ELAPSED, abs=0.01)
    assert "does not agree" not in printed


def test_unit_in_the_name_that_the_distance_contradicts_is_not_believed(tmp_path):
    columns = {"time (s)": ELAPSED * 1000, "speed_kmh": DRIVE["speed"] * 3.6, **WITNESSES["odometer"]}
    _, _, text = import_guessed(tmp_path / "ride 2024-05-01 14-00-00.csv", columns)
    assert "agrees with the odometer in ms, not in s as the name says; check it" in text


def test_ticks_of_a_tenth_of_a_second_follow_from_a_distance_in_known_units(tmp_path):
    columns = {"ticks": ELAPSED * 10, "speed_kmh": DRIVE["speed"] * 3.6, **WITNESSES["odometer"]}
    samples, _, text = import_guessed(tmp_path / "ride 2024-05-01 14-00-00.csv", columns)
    assert 'unit = "0.1 s"' in text
    assert list_times(samples) == pytest.approx(START + ELAPSED, abs=0.01)


def test_log_with_one_value_a_row_and_a_clock_in_milliseconds_is_one_ride(tmp_path):
    parts = [
        pd.DataFrame({"Time": ELAPSED * 1000 + shift, name: values})
        for shift, (name, values) in enumerate(
            {
                "Speed": DRIVE["speed"] * 3.6,
                "Battery voltage": np.full(600, 360.0),
                "Battery current": DRIVE["power"] / 360,
                "Odometer": 12000 + DRIVE["distance"] / 1000,
            }.items()
        )
    ]
    samples, printed, _ = import_guessed(tmp_path / "All 2024-05-01 14-00-00.csv", pd.concat(parts).sort_values("Time"))
    assert np.ptp(list_times(samples)) == pytest.approx(ELAPSED[-1], abs=5)
    assert "agrees: odometer against speed" in printed


def test_wrong_unit_in_a_map_is_one_line_with_the_right_one(tmp_path):
    path, map_file = tmp_path / "ride.csv", tmp_path / "map.toml"
    columns = {"time": ELAPSED * 1000, "speed_kmh": DRIVE["speed"] * 3.6, **WITNESSES["odometer"]}
    pd.DataFrame(columns).to_csv(path, index=False)
    map_file.write_text(
        '[vehicle]\nname = "a"\n[time]\ncolumn = "time"\nunit = "s"\norigin = "2024-05-01T14:00:00"\n[fields]\n'
        'speed_kmh = { column = "speed_kmh" }\nodometer_km = { column = "odometer_km" }\n'
    )
    printed, errors, code = called("import", "csv", path, "--map", map_file, "-o", tmp_path / "a.mcap")
    assert code == 0, errors
    (line,) = [line for line in printed.splitlines() if "does not agree: unit of the clock" in line]
    assert "1e+03 times that by the odometer" in line
    assert "set unit = 'ms' in [time]" in line


@pytest.mark.parametrize(("unit", "factor"), [("s", 1.0), ("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
def test_unix_time_is_found_in_every_unit(tmp_path, unit, factor):
    columns = {"timestamp": (DRIVE["time"] * factor).astype("i8"), "speed_kmh": DRIVE["speed"] * 3.6}
    samples, _, text = import_guessed(tmp_path / "a.csv", columns)
    assert f'unit = "{unit}"' in text
    assert list_times(samples) == pytest.approx(DRIVE["time"])


def test_count_of_microseconds_as_large_as_unix_time_is_none(tmp_path):
    columns = {"time": 1.3e9 + ELAPSED * 1e6, "speed_kmh": DRIVE["speed"] * 3.6, **WITNESSES["odometer"]}
    samples, _, text = import_guessed(tmp_path / "ride 2024-05-01 14-00-00.csv", columns)
    assert 'unit = "us"' in text
    assert np.ptp(list_times(samples)) == pytest.approx(ELAPSED[-1], abs=0.1)


def test_days_of_a_spreadsheet_are_local_time(tmp_path):
    days = DRIVE["time"] / 86400 + 25569
    samples, _, text = import_guessed(tmp_path / "a.csv", {"Date": days, "speed_kmh": DRIVE["speed"] * 3.6})
    assert 'unit = "excel"' in text
    assert "the file does not state it: correct it where it is local time" in text
    assert list_times(samples) == pytest.approx(DRIVE["time"], abs=0.01)


@pytest.mark.parametrize(("unit", "factor"), [("s", 1.0), ("ms", 1e3)])
def test_gps_weeks_and_time_of_week_are_utc(tmp_path, unit, factor):
    since = DRIVE["time"] - 315964800 + 18
    columns = {
        "GPS Week": (since // 604800).astype(int),
        "TOW": (since % 604800 * factor).astype(int),
        "speed_kmh": DRIVE["speed"] * 3.6,
    }
    samples, _, text = import_guessed(tmp_path / "a.csv", columns)
    assert f'unit = "{unit}"' in text
    assert list_times(samples) == pytest.approx(DRIVE["time"])


def test_digits_of_date_and_time_without_marks_are_a_date(tmp_path):
    digits = DRIVE["stamp"].strftime("%Y%m%d%H%M%S").astype("i8")
    samples, _, text = import_guessed(tmp_path / "a.csv", {"timestamp": digits, "speed_kmh": DRIVE["speed"] * 3.6})
    assert 'format = "%Y%m%d%H%M%S"' in text
    assert list_times(samples) == pytest.approx(DRIVE["time"])
