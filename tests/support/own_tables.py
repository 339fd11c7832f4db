"""Tables of a simulated drive in the forms of exports that people have, with their documented column names."""

from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np
import pandas as pd

from socast.core.wire.messages import Telemetry
from socast.stream.mcap_reader import McapSource

START: Final = 1714572000.0
"""1 May 2024, 14:00 UTC. [Unix s]"""
KM_PER_MILE: Final = 1.609344
CAPACITY_KWH: Final = 40.0
MASS_KG: Final = 1600.0


def make_drive(rows: int = 1200, step: float = 2.0, start: float = START) -> dict[str, Any]:
    """Return a drive with hills of speed: time [s], speed [m/s], power [W], distance [m], charge [%] and position."""
    elapsed = np.arange(rows) * step
    speed = np.clip(12 + 8 * np.sin(elapsed / 37) + 3 * np.sin(elapsed / 11), 0, None)
    power = MASS_KG * np.gradient(speed, step) * speed + 0.42 * speed**3 + 160 * speed + 500
    distance = np.concatenate(([0.0], np.cumsum((speed[1:] + speed[:-1]) / 2 * step)))
    energy = np.concatenate(([0.0], np.cumsum((power[1:] + power[:-1]) / 2 * step))) / 3.6e6
    return {
        "time": start + elapsed,
        "stamp": pd.to_datetime(start + elapsed, unit="s"),
        "speed": speed,
        "power": power,
        "distance": distance,
        "soc": 80 - energy / CAPACITY_KWH * 100,
        "latitude": 45.5 + distance / 111194.9,
        "longitude": np.full(rows, -73.6),
    }


def teslamate(path: Path, **changes: Any) -> Path:
    """Write a table `positions` of TeslaMate, as `COPY ... WITH CSV HEADER` exports it.

    Times are UTC without a zone, power is in whole kW and positive while driving, speed in whole km/h.
    """
    d = make_drive()
    columns = {
        "id": np.arange(len(d["time"])),
        "car_id": 1,
        "drive_id": 7,
        "date": d["stamp"].strftime("%Y-%m-%d %H:%M:%S.%f"),
        "elevation": 30,
        "latitude": d["latitude"].round(6),
        "longitude": d["longitude"].round(6),
        "speed": (d["speed"] * 3.6).round().astype(int),
        "power": (d["power"] / 1000).round().astype(int),
        "odometer": (12000 + d["distance"] / 1000).round(6),
        "rated_battery_range_km": 210.5,
        "battery_level": d["soc"].round().astype(int),
        "usable_battery_level": d["soc"].round().astype(int),
        "inside_temp": 20.5,
        "outside_temp": 12.0,
        "is_climate_on": "t",
    }
    pd.DataFrame(columns | changes).to_csv(path, index=False)
    return path


def abrp(path: Path, sign: int = 1, start: float = START) -> Path:
    """Write samples of ABRP telemetry: power in kW and current in A are positive when discharging."""
    d = make_drive(start=start)
    columns = {
        "utc": d["time"].astype(int),
        "soc": d["soc"].round(1),
        "power": (sign * d["power"] / 1000).round(3),
        "speed": (d["speed"] * 3.6).round(2),
        "lat": d["latitude"].round(6),
        "lon": d["longitude"].round(6),
        "is_charging": 0,
        "is_dcfc": 0,
        "voltage": 360.0,
        "current": (sign * d["power"] / 360).round(2),
        "ext_temp": 12,
        "batt_temp": 20,
        "odometer": (12000 + d["distance"] / 1000).round(2),
    }
    pd.DataFrame(columns).to_csv(path, index=False)
    return path


def ovms(path: Path) -> Path:
    """Write standard metrics of OVMS v3 by their names, with `yes` and `no` for flags."""
    d = make_drive()
    columns = {
        "m.time.utc": d["time"].astype(int),
        "v.b.soc": d["soc"].round(1),
        "v.b.voltage": 360.0,
        "v.b.current": (d["power"] / 360).round(2),
        "v.b.12v.voltage": 13.8,
        "v.b.temp": 20,
        "v.c.charging": "no",
        "v.e.temp": 12,
        "v.p.latitude": d["latitude"].round(6),
        "v.p.longitude": d["longitude"].round(6),
        "v.p.odometer": (12000 + d["distance"] / 1000).round(1),
        "v.p.speed": (d["speed"] * 3.6).round(2),
    }
    pd.DataFrame(columns).to_csv(path, index=False)
    return path


def geotab(folder: Path) -> list[Path]:
    """Write trip and status data of Geotab: a file of log records, and one of status data with a diagnostic per row.

    Speed is in km/h, the odometer in metres, the state of charge in %.
    """
    d = make_drive()
    stamps = d["stamp"].strftime("%Y-%m-%dT%H:%M:%S.000Z")
    log = {
        "dateTime": stamps,
        "device": "b28",
        "latitude": d["latitude"].round(6),
        "longitude": d["longitude"].round(6),
        "speed": (d["speed"] * 3.6).round(),
    }
    signals = {
        "DiagnosticStateOfChargeId": d["soc"].round(1),
        "DiagnosticOdometerId": (12e6 + d["distance"]).round(),
        "DiagnosticElectricVehicleBatteryPowerId": d["power"].round(),
        "DiagnosticOutsideTemperatureId": np.full(len(stamps), 12.0),
        "DiagnosticEngineSpeedId": np.full(len(stamps), 900.0),
    }
    status = pd.concat(
        [pd.DataFrame({"dateTime": stamps, "device": "b28", "diagnostic": k, "data": v}) for k, v in signals.items()]
    )
    pd.DataFrame(log).to_csv(folder / "LogRecord.csv", index=False)
    status.to_csv(folder / "StatusData.csv", index=False)
    return [folder / "LogRecord.csv", folder / "StatusData.csv"]


def teslafi(path: Path) -> Path:
    """Write a month of TeslaFi: miles and mph, whole kW, and no speed while the car is parked.

    Times are local, here those of UTC.
    """
    d = make_drive()
    odometer = (12000 + d["distance"] / 1000) / KM_PER_MILE
    columns = {
        "data_id": np.arange(len(d["time"])),
        "Date": d["stamp"].strftime("%Y-%m-%d %H:%M:%S"),
        "vehicle_id": 1111,
        "state": "online",
        "battery_level": d["soc"].round().astype(int),
        "charging_state": "Disconnected",
        "longitude": d["longitude"].round(6),
        "latitude": d["latitude"].round(6),
        "speed": (d["speed"] * 3.6 / KM_PER_MILE).round(2),
        "shift_state": "D",
        "outside_temp": 12.0,
        "odometer": odometer.round(6),
        "power": (d["power"] / 1000).round().astype(int),
        "driveNumber": 12,
        "charge_current_request": 32,
    }
    pd.DataFrame(columns).to_csv(path, index=False, encoding="utf-8-sig")
    return path


def leafspy(path: Path) -> Path:
    """Write a log of LeafSpy Pro: charge in millionths, positions in degrees and minutes, outside air in Fahrenheit."""
    d = make_drive()
    columns = {
        "Date/Time": d["stamp"].strftime("%m/%d/%Y %H:%M:%S"),
        "Lat": [_to_minutes(each) for each in d["latitude"]],
        "Long": [_to_minutes(each) for each in d["longitude"]],
        "Elv": 30,
        "Speed": (d["speed"] * 3.6).round(1),
        "Gids": (d["soc"] * 3).round().astype(int),
        "SOC": (d["soc"] * 1e4).round().astype(int),
        "Pack Volts": 360.0,
        "Pack Amps": (d["power"] / 360).round(3),
        "Pack T1 F": 68.0,
        "Pack T1 C": 20.0,
        "CP1": 3750,
        "12v Bat Amps": 1.5,
        "VIN": "SJNFAAZE0U6000000",
        "Odo(km)": (12000 + d["distance"] / 1000).round(2),
        "Ambient": 53.6,
        "epoch time": d["time"].astype(int),
        "Power SW": 1,
    }
    pd.DataFrame(columns).to_csv(path, index=False)
    return path


def torque(path: Path) -> Path:
    """Write a trip of Torque Pro: spaces in the header, which comes a second time, and `-` for unknown values."""
    d = make_drive()
    columns = {
        "GPS Time": d["stamp"].strftime("%a %b %d %H:%M:%S GMT %Y"),
        " Device Time": d["stamp"].strftime("%d-%b-%Y %H:%M:%S.%f").str[:-3],
        " Longitude": d["longitude"].round(6),
        " Latitude": d["latitude"].round(6),
        "GPS Speed (Meters/second)": d["speed"].round(2),
        " Altitude": "-",
        "Speed (OBD)(km/h)": (d["speed"] * 3.6).round(2),
        "Ambient air temp(°C)": 12,
        "HV Battery Current(A)": (d["power"] / 360).round(2),
        "HV Battery Voltage(V)": 360.0,
        "HV SOC(%)": d["soc"].round(1),
    }
    lines = pd.DataFrame(columns).to_csv(index=False).splitlines(keepends=True)
    path.write_text("".join([*lines[:600], lines[0], *lines[600:]]), encoding="utf-8")
    return path


def car_scanner(path: Path) -> Path:
    """Write a recording of Car Scanner with a column per sensor: each row holds one reading, at a time of day."""
    readings = _list_readings()
    names = {"speed": "Vehicle speed (km/h)", "voltage": "Battery DC Voltage (V)", "current": "Battery DC Current (A)"}
    names |= {"soc": "State of charge (%)", "ambient": "Ambient temperature (℃)", "oil": "OBD Module Voltage (V)"}
    frame = pd.DataFrame({"time": pd.to_datetime(readings["time"], unit="s").dt.strftime("%H:%M:%S.%f").str[:-3]})
    for signal, name in names.items():
        frame[name] = readings["value"].where(readings["signal"] == signal)
    frame.to_csv(path, index=False)
    return path


def car_scanner_long(path: Path) -> Path:
    """Write a recording of Car Scanner with a row per reading, in seconds since midnight."""
    readings = _list_readings()
    names = {"speed": "Vehicle speed", "voltage": "[BMS] HV Battery voltage", "current": "[BMS] HV Battery Current"}
    names |= {"soc": "[BMS] HV State of charge", "ambient": "Ambient air temperature", "oil": "Oil"}
    seconds = readings["time"] - readings["time"].iloc[0] // 86400 * 86400
    lines = ['"SECONDS";"PID";"VALUE";"UNITS"']
    for second, signal, value in zip(seconds, readings["signal"], readings["value"], strict=True):
        lines.append(f'"{second:.6f}";"{names[signal]}";"{value}";"?"')
    path.write_text("\r\n".join(lines) + "\r\n", encoding="utf-8")
    return path


def vss(path: Path) -> Path:
    """Write signals of COVESA VSS by their names: current and power are positive into the battery, power in W."""
    d = make_drive()
    battery = "Vehicle.Powertrain.TractionBattery"
    columns = {
        "timestamp": d["stamp"].strftime("%Y-%m-%dT%H:%M:%SZ"),
        "Vehicle.Speed": (d["speed"] * 3.6).round(2),
        "Vehicle.TraveledDistance": (12000 + d["distance"] / 1000).round(3),
        f"{battery}.StateOfCharge.Displayed": d["soc"].round(1),
        f"{battery}.CurrentVoltage": 360.0,
        f"{battery}.CurrentCurrent": (-d["power"] / 360).round(2),
        f"{battery}.CurrentPower": (-d["power"]).round(),
        "Vehicle.Exterior.AirTemperature": 12.0,
    }
    pd.DataFrame(columns).to_csv(path, index=False)
    return path


def tesla_fleet_telemetry(path: Path) -> Path:
    """Write fields of Tesla Fleet Telemetry, each in a row of its own when it changes, at the latest after 120 s."""
    readings = _list_readings()
    scale = {"speed": 1 / KM_PER_MILE}
    names = {"speed": "VehicleSpeed", "voltage": "PackVoltage", "current": "PackCurrent", "soc": "Soc"}
    names |= {"ambient": "OutsideTemp"}
    changed = (readings.groupby("signal")["value"].diff() != 0) | (readings["time"] % 120 < 2)
    kept = readings[changed & readings["signal"].isin(names)]
    stamps = pd.to_datetime(kept["time"], unit="s").dt.strftime("%Y-%m-%dT%H:%M:%S.%f").str[:-3] + "Z"
    frame = pd.DataFrame({"created_at": stamps, "vin": "5YJ3000000NEXUS01"})
    for signal, name in names.items():
        frame[name] = (kept["value"] * scale.get(signal, 1.0)).where(kept["signal"] == signal)
    frame.to_csv(path, index=False)
    return path


def _list_readings() -> pd.DataFrame:
    """Return readings of single sensors one after another, five in two seconds."""
    d = make_drive()
    signals = {
        "speed": (d["speed"] * 3.6).round(2),
        "voltage": np.full(len(d["time"]), 360.0),
        "current": (d["power"] / 360).round(3),
        "soc": d["soc"].round(2),
        "ambient": np.full(len(d["time"]), 12.0),
        "oil": np.full(len(d["time"]), 14.4),
    }
    parts = [
        pd.DataFrame({"time": d["time"] + 0.05 * place, "signal": signal, "value": values})
        for place, (signal, values) in enumerate(signals.items())
    ]
    return pd.concat(parts).sort_values("time", kind="stable", ignore_index=True)


def _to_minutes(degrees: float) -> str:
    """Return a position in degrees and minutes."""
    whole, minutes = divmod(abs(float(degrees)) * 60, 60)
    return f"{'-' if degrees < 0 else ''}{whole:.0f} {minutes:.5f}"


def read_samples(path: Path) -> list[Telemetry]:
    """Return the samples of a recording."""
    decode = msgspec.json.Decoder(Telemetry).decode
    return [decode(m.payload) for block in McapSource(path) for m in block if m.key.endswith("/telemetry")]
