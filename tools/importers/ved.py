"""The Vehicle Energy Dataset: electric cars among 383 in Ann Arbor, November 2017 to November 2018.

Read are the weekly originals, `VED_171101_week.csv`, with all cars and their engines' columns, as well as extracts of
single trips.

Notes
-----
*Which cars.* A car is electric if it has battery data and nothing in any engine column. The three that
are (10, 455 and 541) are taken for the Nissan Leaf of 2013; the data set names neither make nor year.

*Time.* `DayNum` 1 is 1 November 2017, 00:00; the data set does not say in which time zone. Taken for UTC: over 171
pairs of trips of car 455 within 29 hours the outside temperature peaks at 20:00 on its clock, which is 16:00 in Ann
Arbor, and the car is never out between 4 and 9. `DayNum` has six digits, so starts are rounded, to 86 s from day 100.

*Rows* come when anything refreshes and repeat the rest: each stands until the next, which is up to 27 s later where
the car stands. A longer silence is a gap: in trip 1509 the car drove on for 650 s unlogged.

*Current* is negative when discharging; the contract has it the other way round. Heating and air conditioning add up
to `hvac_w`. SOC is clipped at 100 in some trips, most trips begin and end moving, and all this is left as it is.

References
----------
Oh, LeBlanc, Peng: Vehicle Energy Dataset (VED), a large-scale dataset for vehicle energy consumption research. IEEE
Transactions on Intelligent Transportation Systems 23 (2022) 3302, arXiv:1905.02081. https://github.com/gsoh/VED
"""

from collections.abc import Collection
from datetime import datetime, timedelta, tzinfo
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd

from core.errors import ImportFileError
from tools.importers.drive import LONGEST_DRIVE, Drive
from tools.importers.published import ENGINE, VED, read

MODEL: Final = "nissan-leaf-2013"
TIME_ZONE: Final = "UTC"
DAY_ZERO: Final = datetime(2017, 10, 31)  # noqa: DTZ001 - the zone is the caller's
LAST_DAY: Final = 100_000.0


def read_drives(path: Path, zone: tzinfo, vehicles: Collection[int] = ()) -> list[Drive]:
    """Read the trips of electric cars from one file.

    Parameters
    ----------
    path : Path
    zone : tzinfo. That of `DayNum`.
    vehicles : collection of int. Only these `VehId`s, if they have battery data; by default all electric cars.

    Returns
    -------
    list of Drive
        Empty where the file holds none of them.

    Raises
    ------
    ImportFileError
        If it is not such a file, or a time in it is out of bounds.
    """
    table = read(path, VED).dropna(subset=["DayNum", "VehId", "Trip", "Timestamp(ms)"])
    drives = []
    for vehicle, rows in table.groupby("VehId", sort=True):
        wanted = vehicle in vehicles if vehicles else bool(rows[list(ENGINE)].isna().all(axis=None))
        if wanted and rows["HV Battery Current[A]"].notna().any():
            drives += [_drive(path, zone, trip) for _, trip in rows.groupby("Trip", sort=True)]
    return drives


def _drive(path: Path, zone: tzinfo, trip: pd.DataFrame) -> Drive:
    """Return one trip's rows as a drive."""
    trip = trip.sort_values("Timestamp(ms)", kind="stable")
    of = {name: trip[name].to_numpy() for name in VED.needed}
    day, milliseconds = float(of["DayNum"][0]), of["Timestamp(ms)"]
    if not 0 <= day <= LAST_DAY:
        raise ImportFileError(f"{path}: column 'DayNum' holds {day:g}; a day is from 0 to {LAST_DAY:g}")
    duration = (milliseconds[-1] - milliseconds[0]) / 1000
    if not (duration <= LONGEST_DRIVE and abs(milliseconds[0]) <= LONGEST_DRIVE * 1000):
        raise ImportFileError(
            f"{path}: column 'Timestamp(ms)' spans {duration:g} s in a trip; a drive has {LONGEST_DRIVE:g}"
        )
    start = (DAY_ZERO + timedelta(days=day, milliseconds=milliseconds[0])).replace(tzinfo=zone).timestamp()
    cooling = np.where(
        np.isnan(of["Air Conditioning Power[Watts]"]),
        trip["Air Conditioning Power[kW]"].to_numpy() * 1000,
        of["Air Conditioning Power[Watts]"],
    )
    vehicle = f"ved-{of['VehId'][0]:.0f}"
    return Drive(
        vehicle_id=vehicle,
        model=MODEL,
        ride_id=f"{vehicle}-{of['Trip'][0]:.0f}",
        start=start,
        elapsed=(milliseconds - milliseconds[0]) / 1000,
        rows={
            "latitude_deg": of["Latitude[deg]"],
            "longitude_deg": of["Longitude[deg]"],
            "speed_kmh": of["Vehicle Speed[km/h]"],
            "soc_pct": of["HV Battery SOC[%]"],
            "battery_voltage_v": of["HV Battery Voltage[V]"],
            "battery_current_a": -of["HV Battery Current[A]"],
            "ambient_c": of["OAT[DegC]"],
            "hvac_w": np.maximum(of["Heater Power[Watts]"], 0) + np.maximum(cooling, 0),
        },
        source=path.name,
    )
