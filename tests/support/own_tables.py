"""Tables of a simulated drive in the forms of exports that people have, with their documented column names."""

from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np
import pandas as pd

from core.wire.messages import Telemetry
from stream.mcap_reader import McapSource

START: Final = 1714572000.0
"""1 May 2024, 14:00 UTC. [Unix s]"""
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


def abrp(path: Path, sign: int = 1) -> Path:
    """Write samples of ABRP telemetry: power in kW and current in A are positive when discharging."""
    d = make_drive()
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


def read_samples(path: Path) -> list[Telemetry]:
    """Return the samples of a recording."""
    decode = msgspec.json.Decoder(Telemetry).decode
    return [decode(m.payload) for block in McapSource(path) for m in block if m.key.endswith("/telemetry")]
