"""VSS signals are read with their units and signs, in every encoding that the guide names."""

import json

import pytest

from socast.core.errors import SettingsError
from socast.stream.zenoh_signals import SignalSample
from socast.tools.bridge.row_assembler import RowAssembler
from socast.tools.bridge.vss import VssReader, parse_payload, parse_stamp

NOW = 1_700_000_000.0
BATTERY = "Powertrain/TractionBattery"


@pytest.fixture
def assembler():
    return RowAssembler()


def read(reader, path, payload, *, car="taxi-7/", attachment=b"", stamp_s=None, at=0.0):
    """Give a reader a sample."""
    reader.read(SignalSample(f"{car}Vehicle/{path}", payload, attachment, stamp_s, NOW + at))


def rows(assembler):
    assembler.close_due()
    return [json.loads(message.payload) for message in assembler.pop()[0]]


def test_signals_become_a_sample_with_the_units_and_signs_of_the_contract(assembler):
    reader = VssReader(assembler)
    signals = {
        "Speed": b"49.5",
        "TraveledDistance": b"57913100",
        "CurrentLocation/Latitude": b"45.5",
        "CurrentLocation/Longitude": b"-73.6",
        "CurrentLocation/Altitude": b"30",
        "Exterior/AirTemperature": b"-4.5",
        f"{BATTERY}/StateOfCharge/Current": b"95",
        f"{BATTERY}/StateOfCharge/Displayed": b"96.5",
        f"{BATTERY}/CurrentVoltage": b"350",
        f"{BATTERY}/CurrentCurrent": b"-12.5",
        f"{BATTERY}/CurrentPower": b"-9999",
        f"{BATTERY}/Temperature/Average": b"13",
        f"{BATTERY}/Charging/IsCharging": b"false",
    }
    for path, payload in signals.items():
        read(reader, path, payload)
    assert rows(assembler) == [
        {
            "vehicle_id": "taxi-7",
            "time_s": NOW,
            "seq": 0,
            "latitude_deg": 45.5,
            "longitude_deg": -73.6,
            "elevation_m": 30.0,
            "speed_kmh": 49.5,
            "odometer_km": 57913.1,
            "soc_pct": 96.5,
            "battery_voltage_v": 350.0,
            "battery_current_a": 12.5,
            "battery_temperature_c": 13.0,
            "ambient_c": -4.5,
            "charging": False,
        }
    ]


def test_power_that_leaves_the_battery_is_positive(assembler):
    read(VssReader(assembler), f"{BATTERY}/CurrentPower", b"-3600")
    (row,) = rows(assembler)
    assert row["battery_voltage_v"] * row["battery_current_a"] == 3600.0


def test_odometer_is_in_kilometres_before_version_6(assembler):
    read(VssReader(assembler, version=5), "TraveledDistance", b"57913.1")
    assert rows(assembler)[0]["odometer_km"] == 57913.1


@pytest.mark.parametrize(
    ("payload", "value", "time_s"),
    [
        (b"23.5", 23.5, None),
        (b'"23.5"', "23.5", None),
        (b"on", "on", None),
        (b"null", None, None),
        (b'{"value": 7}', 7, None),
        (b'{"value": 7, "timestamp": "2023-11-14T22:13:20.5Z"}', 7, NOW + 0.5),
        (b'{"value": 7, "ts": "2023-11-14T22:13:20"}', 7, NOW),
        (b'{"v": 7, "time": 1700000000.25}', 7, NOW + 0.25),
        (b'{"value": 7, "timestamp": 1700000000000000000}', 7, NOW),
        (b'{"data": {"path": "Vehicle.Speed", "dp": {"value": "7", "ts": "2023-11-14T23:13:20+01:00"}}}', "7", NOW),
        (b'{"timestamp": 1700000000}', None, NOW),
        (b'{"value": 7, "timestamp": "noon"}', 7, None),
        (b"{", "{", None),
    ],
)
def test_encodings_of_a_value(payload, value, time_s):
    assert parse_payload(payload) == (value, time_s)


@pytest.mark.parametrize("stamp", [True, -1, 0, 1e30, "9999999-01-01", None, [1]])
def test_stamp_that_is_no_time_is_none(stamp):
    assert parse_stamp(stamp) is None


def test_time_of_the_payload_stands_before_that_of_zenoh_and_of_receipt(assembler):
    reader = VssReader(assembler)
    read(reader, "Speed", b'{"value": 1, "timestamp": 1699999000}', stamp_s=NOW - 10.0)
    read(reader, "Speed", b"2", stamp_s=NOW - 10.0)
    read(reader, "Speed", b"3")
    assert [row["time_s"] for row in rows(assembler)] == [1_699_999_000.0, NOW - 10.0, NOW]


@pytest.mark.parametrize(
    ("path", "payload", "attachment", "cause"),
    [
        ("Speed", b"fast", b"", "bad_value"),
        ("Speed", b"true", b"", "bad_value"),
        ("Speed", b"[1]", b"", "bad_value"),
        ("Speed", b"1" + b"0" * 400, b"", "bad_value"),
        ("Speed", b"\xff", b"", "bad_value"),
        ("Speed", b"null", b"", "no_value"),
        ("Speed", b"1" * 5000, b"", "too_large"),
        ("Speed", b"50", b"targetValue", "target_value"),
        ("Body/Horn/IsActive", b"true", b"", "other_signal"),
    ],
)
def test_sample_that_gives_no_value_is_counted(assembler, path, payload, attachment, cause):
    read(VssReader(assembler), path, payload, attachment=attachment)
    assert assembler.counts == {cause: 1}


def test_keys_of_the_only_car_begin_with_vehicle(assembler):
    reader = VssReader(assembler, "depot/", "taxi-7")
    assert reader.name_keys() == "depot/Vehicle/**"
    read(reader, "Speed", b"50", car="depot/", attachment=b"currentValue")
    read(reader, "Speed", b"50", car="depot/taxi-8/")
    assert [row["vehicle_id"] for row in rows(assembler)] == ["taxi-7"]
    assert assembler.counts["bad_key"] == 1


def test_wrong_name_and_wrong_version_are_refused_in_one_line(assembler):
    with pytest.raises(SettingsError, match="--vehicle is 'a b'"):
        VssReader(assembler, vehicle="a b")
    with pytest.raises(SettingsError, match="--vss-version is 9, must be from 3 to 7"):
        VssReader(assembler, version=9)
