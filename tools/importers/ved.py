"""Import the electric cars of the Vehicle Energy Dataset: 383 cars in Ann Arbor, November 2017 to November 2018.

The importer reads the weekly originals, such as `VED_171101_week.csv`, with all cars and the columns of their engines.
It also reads extracts of single trips.

Notes
-----
*Selection.* A car is electric if it has battery data and no value in any engine column. Three cars are: 10, 455 and
541. The data set names neither make nor year; the importer takes them as the Nissan Leaf of 2013.

*Time.* `DayNum` 1 is 1 November 2017, 00:00. The data set does not name a time zone; the importer takes UTC.
Evidence: over 171 pairs of trips of car 455 within 29 hours the outside temperature peaks at 20:00 on its clock,
which is 16:00 in Ann Arbor, and the car never drives between 4:00 and 9:00. `DayNum` has six digits, so start times
are rounded, to 86 s from day 100 on.

*Rows* are written when any value is refreshed, and repeat the other values. Each row is valid until the next one, which
is up to 27 s later while the car stands. A longer silence is a gap: in trip 1509 the car drove for 650 s without a row.

*Current* is negative when discharging in the files and positive in the wire contract. Heating and air conditioning add
up to `hvac_w`. The state of charge is clipped at 100 % in some trips, and most trips begin and end moving. The importer
passes both on unchanged.

References
----------
Oh, LeBlanc, Peng: Vehicle Energy Dataset (VED), a large-scale dataset for vehicle energy consumption research. IEEE
Transactions on Intelligent Transportation Systems 23 (2022) 3302, arXiv:1905.02081. https://github.com/gsoh/VED
"""

from datetime import datetime, timedelta, tzinfo
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd

from socast.core.errors import ImportFileError
from socast.tools.importers.drive import LONGEST_DRIVE, Drive, ReadOptions
from socast.tools.importers.published import ENGINE_COLUMNS, VED, read_table

MODEL: Final = "nissan-leaf-2013"
TIME_ZONE: Final = "UTC"
DAY_ZERO: Final = datetime(2017, 10, 31)  # noqa: DTZ001 - the options give the zone
LAST_DAY: Final = 100_000.0


def read_drives(path: Path, options: ReadOptions) -> list[Drive]:
    """Read the trips of electric cars from one file.

    Parameters
    ----------
    options : ReadOptions
        Time zone of `DayNum`, and the `VehId`s to read. A selected car needs battery data.
    """
    table = read_table(path, VED).dropna(subset=["DayNum", "VehId", "Trip", "Timestamp(ms)"])
    drives = []
    for vehicle, rows in table.groupby("VehId", sort=True):
        electric = bool(rows[list(ENGINE_COLUMNS)].isna().all(axis=None))
        wanted = vehicle in options.vehicles if options.vehicles else electric
        if wanted and rows["HV Battery Current[A]"].notna().any():
            drives += [_make_drive(path, options.zone, trip) for _, trip in rows.groupby("Trip", sort=True)]
    return drives


def _make_drive(path: Path, zone: tzinfo, trip: pd.DataFrame) -> Drive:
    """Return the drive of the rows of one trip."""
    trip = trip.sort_values("Timestamp(ms)", kind="stable")
    columns = {name: trip[name].to_numpy() for name in VED.needed}
    day, milliseconds = float(columns["DayNum"][0]), columns["Timestamp(ms)"]
    if not 0 <= day <= LAST_DAY:
        raise ImportFileError(f"{path}: column 'DayNum' holds {day:g}; a day is from 0 to {LAST_DAY:g}")
    duration = (milliseconds[-1] - milliseconds[0]) / 1000
    if not (duration <= LONGEST_DRIVE and abs(milliseconds[0]) <= LONGEST_DRIVE * 1000):
        raise ImportFileError(
            f"{path}: column 'Timestamp(ms)' spans {duration:g} s in a trip; a drive has {LONGEST_DRIVE:g} s at most"
        )
    start = (DAY_ZERO + timedelta(days=day, milliseconds=milliseconds[0])).replace(tzinfo=zone).timestamp()
    cooling = np.where(
        np.isnan(columns["Air Conditioning Power[Watts]"]),
        trip["Air Conditioning Power[kW]"].to_numpy() * 1000,
        columns["Air Conditioning Power[Watts]"],
    )
    vehicle = f"ved-{columns['VehId'][0]:.0f}"
    return Drive(
        vehicle_id=vehicle,
        model=MODEL,
        ride_id=f"{vehicle}-{columns['Trip'][0]:.0f}",
        start=start,
        elapsed=(milliseconds - milliseconds[0]) / 1000,
        rows={
            "latitude_deg": columns["Latitude[deg]"],
            "longitude_deg": columns["Longitude[deg]"],
            "speed_kmh": columns["Vehicle Speed[km/h]"],
            "soc_pct": columns["HV Battery SOC[%]"],
            "battery_voltage_v": columns["HV Battery Voltage[V]"],
            "battery_current_a": -columns["HV Battery Current[A]"],
            "ambient_c": columns["OAT[DegC]"],
            "hvac_w": np.maximum(columns["Heater Power[Watts]"], 0) + np.maximum(cooling, 0),
        },
        source=path.name,
    )
