"""Import the RSK Twizy dataset: a Renault Twizy in Rabat, Salé and Kénitra, 2021, logged at 1 Hz.

The data set has neither voltage nor current.

Notes
-----
*Time.* The importer takes `Date` and `Time` as local time in Rabat. Some rows have a garbled date (`90/02/2032`) while
their time continues: they get the date of the row before.

*Speed* is the speed of the wheels, `Speed`; `GpsSpeed` lags by up to 20 s. *Positions* stay for 12 to 20 s and then
jump. The importer passes them on unchanged, so that cleaning detects them.

*Weather* (temperature, humidity, mean wind in m/s, no direction) comes from a weather service and not from the car. The
importer sends it as observations of a station in Rabat, at the start of each drive and at every change.

References
----------
NaitMalek, Najib, Lahlou, Bakhouya, Gaber, Essaaidi: A hybrid approach for state-of-charge forecasting in
battery-powered electric vehicles. Sustainability 14 (2022) 9993, DOI 10.3390/su14169993.
https://github.com/NaitMalekYoussef/RSK_Twizy_EV_Dataset
"""

from datetime import datetime, timedelta
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd

from socast.core.batch import Floats
from socast.core.errors import ImportFileError
from socast.core.wire.messages import Weather
from socast.tools.importers.drive import LONGEST_DRIVE, Drive, ReadOptions
from socast.tools.importers.published import TWIZY, read_table, strip_suffixes

MODEL: Final = "renault-twizy-2012"
TIME_ZONE: Final = "Africa/Casablanca"
VEHICLE: Final = "twizy"
STATION: Final = "rabat"
STATION_LATITUDE, STATION_LONGITUDE = 34.02, -6.84
MS_IN_KMH: Final = 3.6

_EPOCH: Final = datetime(1970, 1, 1)  # noqa: DTZ001 - local wall time


def read_drives(path: Path, options: ReadOptions) -> list[Drive]:
    """Read the drive of one file."""
    table = read_table(path, TWIZY)
    wall, notes = _wall_times(path, table)
    known = np.isfinite(wall)
    order = np.flatnonzero(known)[np.argsort(wall[known], kind="stable")]
    wall = wall[order]
    if wall[-1] - wall[0] > LONGEST_DRIVE:
        raise ImportFileError(
            f"{path}: column 'Time' spans {wall[-1] - wall[0]:g} s; a drive has {LONGEST_DRIVE:g} s at most"
        )
    columns = {name: table[name].to_numpy()[order] for name in TWIZY.needed}
    start = (_EPOCH + timedelta(seconds=float(wall[0]))).replace(tzinfo=options.zone).timestamp()
    elapsed = wall - wall[0]
    drive = Drive(
        vehicle_id=VEHICLE,
        model=MODEL,
        ride_id=strip_suffixes(path),
        start=start,
        elapsed=elapsed,
        rows={
            "latitude_deg": columns["LAT"],
            "longitude_deg": columns["LON"],
            "elevation_m": columns["ALT"],
            "speed_kmh": columns["Speed"],
            "soc_pct": columns["Soc"],
        },
        source=path.name,
        weather=_observe_changes(start + elapsed, columns["Temperature"], columns["Humidity"], columns["WindSpeedAv"]),
        notes=tuple(notes),
    )
    return [drive]


def _wall_times(path: Path, table: pd.DataFrame) -> tuple[Floats, list[str]]:
    """Return the local time of each row since 1970 [s], NaN if unreadable, and notes on what was repaired."""
    days = pd.to_datetime(table["Date"], format="%m/%d/%Y", errors="coerce")
    garbled = days.isna()
    if garbled.all():
        raise ImportFileError(f"{path}: column 'Date' holds {table['Date'].iloc[0][:40]!r}, not month/day/year")
    times = pd.to_datetime(table["Time"], format="%H:%M:%S", errors="coerce")
    unread = times.isna()
    if unread.all():
        raise ImportFileError(f"{path}: column 'Time' holds {table['Time'].iloc[0][:40]!r}, not hours:minutes:seconds")
    notes = []
    if garbled.any():
        example = table["Date"][garbled].iloc[0]
        notes.append(
            f"{path.name}: {garbled.sum()} rows have no readable date (such as '{example[:20]}'); "
            "they get the date of the row before"
        )
    if unread.any():
        notes.append(f"{path.name}: {unread.sum()} rows have no readable time; they are left out")
    day = (days.ffill().bfill() - pd.Timestamp(_EPOCH)).dt.total_seconds()
    wall = day + (times - times.dt.normalize()).dt.total_seconds()
    return np.asarray(wall, dtype=np.float64), notes


def _observe_changes(stamps: Floats, celsius: Floats, humidity: Floats, wind: Floats) -> tuple[Weather, ...]:
    """Return an observation for the first row and for every row whose weather differs from the row before."""
    weather = np.column_stack((celsius, humidity, wind))
    changed = np.flatnonzero(np.append(True, np.any(weather[1:] != weather[:-1], axis=1)))
    return tuple(
        Weather(
            station_id=STATION,
            time_s=round(float(stamps[row]), 3),
            latitude_deg=STATION_LATITUDE,
            longitude_deg=STATION_LONGITUDE,
            temperature_c=_to_json_number(celsius[row]),
            wind_speed_kmh=_to_json_number(wind[row] * MS_IN_KMH),
            humidity_pct=_to_json_number(humidity[row]),
        )
        for row in changed
    )


def _to_json_number(value: float) -> float | None:
    """Return a number as JSON holds it: rounded, None if unknown."""
    return round(float(value), 3) if np.isfinite(value) else None
