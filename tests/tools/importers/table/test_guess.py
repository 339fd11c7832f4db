"""Test what names, ranges and physics say about columns."""

import numpy as np
import pandas as pd
import pytest

from socast.core.errors import ImportFileError
from socast.tools.importers.table.column_map import FileFormat
from socast.tools.importers.table.guess import guess_map
from socast.tools.importers.table.guess_names import guess_name
from socast.tools.importers.table.table_file import open_table
from tests.support.own_tables import abrp, make_drive

NAMES = [
    ("speed (mph)", "speed_kmh", "mph"),
    ("Speed [km/h]", "speed_kmh", "km/h"),
    ("speed_mps", "speed_kmh", "mps"),
    ("batt_current_A", "battery_current_a", "A"),
    ("HV Battery Current[A]", "battery_current_a", "A"),
    ("power_w", "battery_power_kw", "w"),
    ("power_kW", "battery_power_kw", "kW"),
    ("Power kW", "battery_power_kw", "kW"),
    ("Leistung_kW", "battery_power_kw", "kW"),
    ("PackPowerkW", "battery_power_kw", "kW"),
    ("P_W", "battery_power_kw", "W"),
    ("battery_kw", "battery_power_kw", "kw"),
    ("kW", "battery_power_kw", "kW"),
    ("speedMph", "speed_kmh", "Mph"),
    ("SpeedKph", "speed_kmh", "Kph"),
    ("spd_kph", "speed_kmh", "kph"),
    ("v_kmh", "speed_kmh", "kmh"),
    ("speed km/h", "speed_kmh", "km/h"),
    ("GPSspeed", "speed_kmh", None),
    ("batt_v", "battery_voltage_v", "v"),
    ("batt_i", "battery_current_a", None),
    ("packVoltage_kV", "battery_voltage_v", "kV"),
    ("voltage_mV", "battery_voltage_v", "mV"),
    ("current_mA", "battery_current_a", "mA"),
    ("outsideTempDegF", "ambient_c", "DegF"),
    ("battery_temp_degC", "battery_temperature_c", "degC"),
    ("local_time", "other time", None),
    ("timestamp_utc", "other time", None),
    ("OAT[DegC]", "ambient_c", "DegC"),
    ("elapsed_s", "time", "s"),
    ("timestamp_ms", "time", "ms"),
    ("VehicleId", "vehicle", None),
    ("Vehicle.Speed", "speed_kmh", None),
    ("Vehicle.TraveledDistance", "odometer_km", None),
    ("Vehicle.Powertrain.TractionBattery.StateOfCharge.Current", "soc_pct", None),
    ("Vehicle.Powertrain.TractionBattery.CurrentVoltage", "battery_voltage_v", None),
    ("Vehicle.Powertrain.TractionBattery.CurrentCurrent", "battery_current_a", None),
    ("Vehicle.Powertrain.TractionBattery.CurrentPower", "battery_power_kw", None),
    ("Vehicle.Exterior.AirTemperature", "ambient_c", None),
    ("Vehicle.CurrentLocation.Latitude", "latitude_deg", None),
    ("REESSCurrent", "battery_current_a", None),
    ("REESSVoltage", "battery_voltage_v", None),
    ("U_REESS", "battery_voltage_v", None),
    ("DAActualSpeed", "speed_kmh", None),
    ("tempAmb", "ambient_c", None),
    ("PhaseTime", "other time", None),
    ("windSpeedKph", "wind_speed_kmh", "Kph"),
    ("wind_dir", "wind_from_deg", None),
    ("rain_mm/h", "precipitation_mm", "mm/h"),
    ("Irradiance (W/m²)", "solar_w_m2", "W/m²"),
    ("Relative humidity (%)", "humidity_pct", "%"),
    ("pressure_msl (hPa)", "pressure_hpa", "hPa"),
]


@pytest.mark.parametrize(("name", "role", "unit"), NAMES, ids=[name for name, *_ in NAMES])
def test_name_gives_field_and_unit(name, role, unit):
    assert guess_name(name)[1:] == (role, unit)


@pytest.mark.parametrize(
    "name",
    [
        "wind gust speed",
        "surface pressure",
        "precipitation probability",
        "speed_limit_kph",
        "motor power",
        "motor_kW",
        "battery_power_kWh",
        "soc_Ah",
        "12V voltage",
        "cell voltage max",
        "inside_temp",
        "charger current",
        "notes",
    ],
)
def test_names_of_other_quantities_are_left_out(name):
    assert guess_name(name) is None


def guess(tmp_path, **columns):
    """Return the guessed map of a table of the drive with these columns."""
    path = tmp_path / "table.csv"
    pd.DataFrame(columns).to_csv(path, index=False)
    return guess_map([open_table(path, "csv", FileFormat())])


@pytest.mark.parametrize(("unit", "factor"), [("km/h", 3.6), ("mph", 1 / 0.44704), ("m/s", 1.0)])
def test_unit_of_speed_follows_from_positions(tmp_path, unit, factor):
    d = make_drive(600)
    found = guess(tmp_path, time=d["time"], speed=d["speed"] * factor, lat=d["latitude"], lon=d["longitude"])
    (speed,) = [each for each in found.fields if each.field == "speed_kmh"]
    assert speed.unit == unit


@pytest.mark.parametrize(("unit", "factor"), [("km", 1e-3), ("mi", 1 / 1609.344), ("m", 1.0)])
def test_unit_of_odometer_follows_from_a_known_speed(tmp_path, unit, factor):
    d = make_drive(600)
    found = guess(tmp_path, time=d["time"], speed_kmh=d["speed"] * 3.6, odometer=9e6 * factor + d["distance"] * factor)
    assert {each.field: each.unit for each in found.fields}["odometer_km"] == unit


@pytest.mark.parametrize(("values", "unit"), [((20, 25), "degC"), ((60, 80), "degF"), ((285, 290), "K")])
def test_unit_of_temperature_follows_from_its_range(tmp_path, values, unit):
    d = make_drive(100)
    found = guess(tmp_path, time=d["time"], speed=d["speed"], ambient_temp=np.linspace(*values, 100))
    assert {each.field: each.unit for each in found.fields}["ambient_c"] == unit


@pytest.mark.parametrize(
    ("form", "expected"),
    [
        ("%d/%m/%Y %H:%M:%S", "%d/%m/%Y %H:%M:%S"),
        ("%m/%d/%Y %I:%M:%S %p", "%m/%d/%Y %I:%M:%S %p"),
        ("%Y-%m-%dT%H:%M:%S", None),
    ],
)
def test_format_of_dates_is_found(tmp_path, form, expected):
    d = make_drive(200, start=1714572000.0 + 20 * 86400.0)
    found = guess(tmp_path, time=d["stamp"].strftime(form), speed=d["speed"])
    assert (found.time.form, found.time.has_zone) == (expected, False)


def test_day_and_month_are_told_apart_by_the_shorter_span(tmp_path):
    stamps = pd.to_datetime([1714572000 + hour * 3600 for hour in range(0, 24 * 5, 6)], unit="s")
    found = guess(tmp_path, time=stamps.strftime("%d/%m/%Y %H:%M:%S"), speed=1.0)
    assert found.time.form == "%d/%m/%Y %H:%M:%S"
    assert "by the shorter span of time" in found.time.reason


def test_table_without_time_is_refused_in_one_line(tmp_path):
    with pytest.raises(ImportFileError, match="no column looks like a time; it has speed, soc"):
        guess(tmp_path, speed=[1.0], soc=[2.0])


def test_columns_that_are_not_read_are_listed_with_the_reason(tmp_path):
    found = guess_map([open_table(abrp(tmp_path / "a.csv"), "csv", FileFormat())])
    assert dict(found.left_out) == {"is_dcfc": "the preset does not read it"}


@pytest.mark.parametrize(
    ("header", "fields"),
    [
        ("Zeit,Geschwindigkeit [km/h],Leistung [kW],Ladezustand [%]", {"speed_kmh", "battery_power_kw", "soc_pct"}),
        ("Zeit,Außentemperatur,Leistung [kW],Spannung", {"ambient_c", "battery_power_kw", "battery_voltage_v"}),
        ("Heure,Vitesse (km/h),Puissance (kW)", {"speed_kmh", "battery_power_kw"}),
        ("Fecha,Velocidad,Corriente,Voltaje", {"speed_kmh", "battery_current_a", "battery_voltage_v"}),
        ("time,SoC [%],Velocity [km/h]", {"speed_kmh", "soc_pct"}),
    ],
)
def test_names_in_other_languages_and_spellings_are_known(tmp_path, header, fields):
    path = tmp_path / "table.csv"
    rows = [f"2024-05-01 12:00:{s:02}," + ",".join(["30"] * header.count(",")) for s in range(30)]
    path.write_text("\n".join([header, *rows]), encoding="utf-8")
    assert {each.field for each in guess_map([open_table(path, "csv", FileFormat())]).fields} == fields


def test_times_of_day_take_the_day_from_the_file_name(tmp_path):
    path = tmp_path / "2024-05-01.csv"
    path.write_text("time,speed\n" + "".join(f"12:00:{s:02}.5,30\n" for s in range(30)))
    found = guess_map([open_table(path, "csv", FileFormat())])
    assert (found.time.form, found.time.day_from_file_name) == ("%H:%M:%S.%f", True)
    other = path.rename(tmp_path / "drive.csv")
    with pytest.raises(ImportFileError, match="its name holds no day such as 2024-05-01"):
        guess_map([open_table(other, "csv", FileFormat())])


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"PK\x03\x04\x14\0", "is an Excel workbook or another archive; save it as CSV"),
        (b'[{"utc": 1}]', "is JSON; save it as CSV"),
        (b'<?xml version="1.0"?><gpx/>', "is XML or HTML, such as GPX; save it as CSV"),
        (
            b"2024-05-01 12:00:00,30.5,4.2\n2024-05-01 12:00:03,31,4\n",
            "no names of columns; write a line of names above",
        ),
    ],
)
def test_file_that_is_no_table_with_a_header_is_one_line_with_the_remedy(tmp_path, content, words):
    path = tmp_path / "table.csv"
    path.write_bytes(content)
    with pytest.raises(ImportFileError, match=words):
        open_table(path, "csv", FileFormat())


def test_date_and_time_of_day_in_two_columns_below_a_title_are_found(tmp_path):
    path = tmp_path / "fahrten.csv"
    rows = "".join(f"01.06.2024;12:00:{s:02};30,5;4,25\n" for s in range(30))
    path.write_text("Meine Fahrten\n\nDatum;Uhrzeit;Geschwindigkeit (km/h);Leistung (kW)\n" + rows, encoding="utf-8")
    table = open_table(path, "csv", FileFormat())
    assert (table.skip_lines, table.separator, table.decimal) == (2, ";", ",")
    found = guess_map([table])
    assert (found.time.columns, found.time.form) == (("Datum", "Uhrzeit"), "%d.%m.%Y %H:%M:%S")
