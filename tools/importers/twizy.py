"""The RSK Twizy dataset: a Renault Twizy in Rabat, Salé and Kénitra, 2021, logged at 1 Hz without voltage and current.

Notes
-----
*Time.* `Date` and `Time` are taken for local time in Rabat. In some rows the date is garbled (`90/02/2032`) while the
time runs on: those take the date of the row before.

*Speed* is the wheels', `Speed`; `GpsSpeed` lags by up to 20 s. *Positions* hold for 12 to 20 s and then jump, and are
passed on as they are, for cleaning to find.

*Weather* (temperature, humidity, mean wind in m/s, no direction) comes from a weather service and not from the car: it
goes out as observations of a station in Rabat, when it changes and at the start of each drive.

References
----------
NaitMalek, Najib, Lahlou, Bakhouya, Gaber, Essaaidi: A hybrid approach for state-of-charge forecasting in
battery-powered electric vehicles. Sustainability 14 (2022) 9993, DOI 10.3390/su14169993.
https://github.com/NaitMalekYoussef/RSK_Twizy_EV_Dataset
"""

from datetime import datetime, timedelta, tzinfo
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd

from core.batch import Floats
from core.errors import ImportFileError
from core.wire.messages import Weather
from tools.importers.drive import LONGEST_DRIVE, Drive
from tools.importers.published import TWIZY, read, stem

MODEL: Final = "renault-twizy-2012"
TIME_ZONE: Final = "Africa/Casablanca"
VEHICLE: Final = "twizy"
STATION: Final = "rabat"
STATION_LATITUDE, STATION_LONGITUDE = 34.02, -6.84
MS_IN_KMH: Final = 3.6

_EPOCH: Final = datetime(1970, 1, 1)  # noqa: DTZ001 - reckons with local wall time


def read_drives(path: Path, zone: tzinfo) -> list[Drive]:
    """Read one drive.

    Parameters
    ----------
    path : Path
    zone : tzinfo. That of `Date` and `Time`.

    Returns
    -------
    list of Drive
        One.

    Raises
    ------
    ImportFileError
        If it is not such a file, or no date or time in it can be read.
    """
    table = read(path, TWIZY)
    wall, notes = _wall_times(path, table)
    known = np.isfinite(wall)
    order = np.flatnonzero(known)[np.argsort(wall[known], kind="stable")]
    wall = wall[order]
    if wall[-1] - wall[0] > LONGEST_DRIVE:
        raise ImportFileError(
            f"{path}: column 'Time' spans {wall[-1] - wall[0]:g} s; a drive has {LONGEST_DRIVE:g} at most"
        )
    of = {name: table[name].to_numpy()[order] for name in TWIZY.needed}
    start = (_EPOCH + timedelta(seconds=float(wall[0]))).replace(tzinfo=zone).timestamp()
    elapsed = wall - wall[0]
    drive = Drive(
        vehicle_id=VEHICLE,
        model=MODEL,
        ride_id=stem(path),
        start=start,
        elapsed=elapsed,
        rows={
            "latitude_deg": of["LAT"],
            "longitude_deg": of["LON"],
            "elevation_m": of["ALT"],
            "speed_kmh": of["Speed"],
            "soc_pct": of["Soc"],
        },
        source=path.name,
        weather=_weather(start + elapsed, of["Temperature"], of["Humidity"], of["WindSpeedAv"]),
        notes=tuple(notes),
    )
    return [drive]


def _wall_times(path: Path, table: pd.DataFrame) -> tuple[Floats, list[str]]:
    """Return each row's local time since 1970, NaN where it cannot be read, [s], and what was mended."""
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
            f"{path.name}: {garbled.sum()} rows have no readable date (as '{example[:20]}'), took the row's before"
        )
    if unread.any():
        notes.append(f"{path.name}: {unread.sum()} rows have no readable time, left out")
    day = (days.ffill().bfill() - pd.Timestamp(_EPOCH)).dt.total_seconds()
    wall = day + (times - times.dt.normalize()).dt.total_seconds()
    return np.asarray(wall, dtype=np.float64), notes


def _weather(stamps: Floats, celsius: Floats, humidity: Floats, wind: Floats) -> tuple[Weather, ...]:
    """Return an observation for the first row and for every change."""
    seen = np.column_stack((celsius, humidity, wind))
    changed = np.flatnonzero(np.append(True, np.any(seen[1:] != seen[:-1], axis=1)))
    return tuple(
        Weather(
            station_id=STATION,
            time_s=round(float(stamps[row]), 3),
            latitude_deg=STATION_LATITUDE,
            longitude_deg=STATION_LONGITUDE,
            temperature_c=_known(celsius[row]),
            wind_speed_kmh=_known(wind[row] * MS_IN_KMH),
            humidity_pct=_known(humidity[row]),
        )
        for row in changed
    )


def _known(value: float) -> float | None:
    """Return a number as JSON has it, None where unknown."""
    return round(float(value), 3) if np.isfinite(value) else None
