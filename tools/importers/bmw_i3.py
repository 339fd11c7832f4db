"""Import battery and heating data of a BMW i3 (60 Ah) around Munich: 70 drives in summer 2019 and winter 2019/20.

The importer reads `TripA01.csv` to `TripB38.csv`, logged at 10 Hz. It also reads `Overview.xlsx` beside them, because
only that file holds the dates of the drives.

Notes
-----
*Time.* The dates of the overview are local time in Munich: its drives noted as `sunset` and `sunrise` are within half
an hour of both.

*Heating.* Only files with `Heating Power LIN [W]` report the heating power, so only they give `hvac_w` (heater and air
conditioning). In the other files `Heating Power CAN [kW]` is frozen: it is 5.3 kW throughout TripA06, where the whole
car at standstill takes 1.2 kW. The importer does not use that column.

*Weather.* The overview describes the weather in words, which the importer does not convert to numbers. Every sample has
the outside temperature. The files have no positions, the elevation is in whole metres, and the importer does not pass
on the noted loads (`+70 kg`).

*Current* is negative when discharging in the files and positive in the wire contract. The energy of TripB02 and TripB13
does not agree with their state of charge; the importer passes both on unchanged.

References
----------
Steinstraeter, Buberger, Trifonov: Battery and Heating Data in Real Driving Cycles. IEEE DataPort (2020),
DOI 10.21227/6jr9-5235.
"""

import re
from collections.abc import Mapping
from datetime import datetime, tzinfo
from pathlib import Path
from typing import Final
from zipfile import BadZipFile

import numpy as np
import openpyxl
from openpyxl.utils.exceptions import InvalidFileException

from socast.core.errors import ImportFileError
from socast.tools.importers.drive import LONGEST_DRIVE, Drive, ReadOptions
from socast.tools.importers.published import BMW_I3, read_table, strip_suffixes

MODEL: Final = "bmw-i3-2014"
TIME_ZONE: Final = "Europe/Berlin"
VEHICLE: Final = "bmw-i3"
OVERVIEW: Final = "Overview.xlsx"

_DATE: Final = re.compile(r"(\d{4})[-_](\d\d?)[-_](\d\d?)[-_ T](\d\d?)[-:](\d\d?)[-:](\d\d?)")


def read_drives(path: Path, options: ReadOptions) -> list[Drive]:
    """Read the drive of one file; `Overview.xlsx` in the same folder gives its date.

    Parameters
    ----------
    options : ReadOptions
        Time zone of the dates in the overview; the selection of vehicles does not apply.
    """
    overview = _read_overview(path.parent / OVERVIEW)
    table = read_table(path, BMW_I3).dropna(subset=["Time [s]"]).sort_values("Time [s]", kind="stable")
    columns = {name: table[name].to_numpy() for name in (*BMW_I3.needed, *BMW_I3.optional)}
    seconds = columns["Time [s]"]
    if not (len(seconds) and seconds[-1] - seconds[0] <= LONGEST_DRIVE):
        raise ImportFileError(
            f"{path}: column 'Time [s]' spans no time or more than {LONGEST_DRIVE:g} s; give a file of one drive"
        )
    trip = strip_suffixes(path)
    heating = np.maximum(columns["Heating Power LIN [W]"], 0)
    return [
        Drive(
            vehicle_id=VEHICLE,
            model=MODEL,
            ride_id=trip,
            start=_start_time(path, options.zone, trip, overview) + float(seconds[0]),
            elapsed=seconds - seconds[0],
            rows={
                "elevation_m": columns["Elevation [m]"],
                "speed_kmh": columns["Velocity [km/h]"],
                "soc_pct": columns["SoC [%]"],
                "battery_voltage_v": columns["Battery Voltage [V]"],
                "battery_current_a": -columns["Battery Current [A]"],
                "battery_temperature_c": columns["Battery Temperature [C]"],
                "ambient_c": columns["Ambient Temperature [C]"],
                "hvac_w": heating + np.maximum(columns["AirCon Power [kW]"] * 1000, 0),
            },
            source=path.name,
        ),
    ]


def _read_overview(path: Path) -> dict[str, object]:
    """Return the cell `Date` of each trip, such as `TripA01`."""
    if not path.exists():
        raise ImportFileError(
            f"{path}: is missing; it holds the dates of the drives, so put it beside them as published"
        )
    try:
        sheet = openpyxl.load_workbook(path, read_only=True, data_only=True).worksheets[0]
        rows = [tuple(row) for row in sheet.iter_rows(values_only=True)]
    except (BadZipFile, InvalidFileException, KeyError, OSError, ValueError, IndexError) as error:
        raise ImportFileError(f"{path}: is not an Excel workbook: {error}") from error
    for index, header in enumerate(rows):
        if "Trip" in header and "Date" in header:
            trip, date = header.index("Trip"), header.index("Date")
            return {str(row[trip]).strip(): row[date] for row in rows[index + 1 :] if row[trip] is not None}
    missing = "Date" if any("Trip" in row for row in rows) else "Trip"
    raise ImportFileError(f"{path}: has no column '{missing}', so it is not the overview of {BMW_I3.title}")


def _start_time(path: Path, zone: tzinfo, trip: str, overview: Mapping[str, object]) -> float:
    """Return the Unix time at which a trip began. [s]"""
    if trip not in overview:
        raise ImportFileError(f"{path}: {OVERVIEW} has no trip '{trip}' in its column 'Trip', so its date is not known")
    cell = overview[trip]
    try:
        parts = _DATE.match(str(cell).strip())
        local = datetime(*map(int, parts.groups()), tzinfo=zone) if parts else None  # type: ignore[arg-type,misc]
    except ValueError:
        local = None
    if local is None:
        raise ImportFileError(f"{path}: column 'Date' of {OVERVIEW} holds {str(cell)[:40]!r} for '{trip}', not a date")
    return local.timestamp()
