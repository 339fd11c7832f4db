"""Battery and heating data of a BMW i3 (60 Ah) around Munich, 70 drives in summer 2019 and winter 2019/20.

Read are `TripA01.csv` to `TripB38.csv`, logged at 10 Hz, and `Overview.xlsx` beside them, which alone knows their
dates.

Notes
-----
*Time.* The overview's dates are local time in Munich: its drives `sunset` and `sunrise` are within half an hour of
those.

*Heating.* Only files with `Heating Power LIN [W]` know it, so only they give `hvac_w` (heater and air conditioning). In
the others `Heating Power CAN [kW]` is frozen: 5.3 kW all through TripA06, where the whole car at standstill
takes 1.2 kW. It is not used.

*Weather* in the overview is a word, of which no number is made; the outside temperature is in every sample. There are
no positions, elevation is in whole metres, and the loads noted (`+70 kg`) are not passed on.

*Current* is negative when discharging; the contract has it the other way round. The energy of TripB02 and TripB13 does
not agree with their state of charge; they are passed on as they are.

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

from core.errors import ImportFileError
from tools.importers.drive import LONGEST_DRIVE, Drive
from tools.importers.published import BMW_I3, read, stem

MODEL: Final = "bmw-i3-2014"
TIME_ZONE: Final = "Europe/Berlin"
VEHICLE: Final = "bmw-i3"
OVERVIEW: Final = "Overview.xlsx"

_DATE: Final = re.compile(r"(\d{4})[-_](\d\d?)[-_](\d\d?)[-_ T](\d\d?)[-:](\d\d?)[-:](\d\d?)")


def read_overview(path: Path) -> dict[str, object]:
    """Read when each trip began.

    Parameters
    ----------
    path : Path. `Overview.xlsx`.

    Returns
    -------
    dict of str to object
        Trip, as `TripA01` -> what its cell `Date` holds.

    Raises
    ------
    ImportFileError
        If it is missing, not a workbook, or has no columns `Trip` and `Date`.
    """
    if not path.exists():
        raise ImportFileError(
            f"{path}: is missing; the drives' dates are in it, put it beside them as it was published"
        )
    try:
        sheet = openpyxl.load_workbook(path, read_only=True, data_only=True).worksheets[0]
        rows = [tuple(row) for row in sheet.iter_rows(values_only=True)]
    except (BadZipFile, InvalidFileException, KeyError, OSError, ValueError, IndexError) as error:
        raise ImportFileError(f"{path}: is not an Excel workbook: {error}") from error
    for place, header in enumerate(rows):
        if "Trip" in header and "Date" in header:
            trip, date = header.index("Trip"), header.index("Date")
            return {str(row[trip]).strip(): row[date] for row in rows[place + 1 :] if row[trip] is not None}
    missing = "Date" if any("Trip" in row for row in rows) else "Trip"
    raise ImportFileError(f"{path}: has no column '{missing}', so it is not the overview of {BMW_I3.title}")


def read_drives(path: Path, zone: tzinfo, overview: Mapping[str, object]) -> list[Drive]:
    """Read one drive.

    Parameters
    ----------
    path : Path
    zone : tzinfo. That of the overview's dates.
    overview : mapping of str to object. From `read_overview`.

    Returns
    -------
    list of Drive
        One.

    Raises
    ------
    ImportFileError
        If it is not such a file, or the overview does not know its date.
    """
    table = read(path, BMW_I3).dropna(subset=["Time [s]"]).sort_values("Time [s]", kind="stable")
    of = {name: table[name].to_numpy() for name in (*BMW_I3.needed, *BMW_I3.optional)}
    seconds = of["Time [s]"]
    if not (len(seconds) and seconds[-1] - seconds[0] <= LONGEST_DRIVE):
        raise ImportFileError(
            f"{path}: column 'Time [s]' spans no time or more than {LONGEST_DRIVE:g} s; a drive has less"
        )
    trip = stem(path)
    return [
        Drive(
            vehicle_id=VEHICLE,
            model=MODEL,
            ride_id=trip,
            start=_start(path, zone, trip, overview) + float(seconds[0]),
            elapsed=seconds - seconds[0],
            rows={
                "elevation_m": of["Elevation [m]"],
                "speed_kmh": of["Velocity [km/h]"],
                "soc_pct": of["SoC [%]"],
                "battery_voltage_v": of["Battery Voltage [V]"],
                "battery_current_a": -of["Battery Current [A]"],
                "battery_temperature_c": of["Battery Temperature [C]"],
                "ambient_c": of["Ambient Temperature [C]"],
                "hvac_w": np.maximum(of["Heating Power LIN [W]"], 0) + np.maximum(of["AirCon Power [kW]"] * 1000, 0),
            },
            source=path.name,
        ),
    ]


def _start(path: Path, zone: tzinfo, trip: str, overview: Mapping[str, object]) -> float:
    """Return the Unix time at which a trip began [s]."""
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
