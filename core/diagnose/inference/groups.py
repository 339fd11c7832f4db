"""Group vehicle-days by their driver, and cars by a file: depots, batches of tyres, or whatever cars have in common."""

from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd

from socast.core.batch import Ints
from socast.core.diagnose.dataset import Windows
from socast.core.diagnose.inference.csv_file import read_csv
from socast.core.diagnose.inference.window_columns import WindowColumns
from socast.core.errors import ModelError

COLUMNS: Final = ("vehicle_id", "group")
DRIVER: Final = "driver_id"
"""Column of the ride table."""
LEAST_DAYS_OF_GROUP: Final = 8
"""Least number of vehicle-days of a group."""
Group = tuple[str, Ints]
"""Name of a group, with what it is a group of, and its vehicle-days."""


def read_groups(path: Path) -> dict[str, str]:
    """Return the group of each vehicle of a CSV file with the columns `vehicle_id` and `group`."""
    table = read_csv(path)
    if missing := [name for name in COLUMNS if name not in table]:
        raise ModelError(f"{path} has no column {missing[0]!r}: its header line must be {','.join(COLUMNS)}")
    table = table[(table["vehicle_id"] != "") & (table["group"] != "")]
    if (twice := table["vehicle_id"].duplicated()).any():
        raise ModelError(f"{path} names vehicle {table.loc[twice, 'vehicle_id'].iloc[0]} twice: keep one line of each")
    return dict(zip(table["vehicle_id"], table["group"], strict=True))


def list_groups(seen: Windows, columns: WindowColumns, of_vehicle: Mapping[str, str]) -> list[Group]:
    """Return the groups of each way of grouping: by a file, and by driver; none where there is only one group."""
    by_file = [of_vehicle.get(columns.cars[car], "") for car in columns.car_of_day.tolist()]
    ways = [_make_groups("group", by_file, columns)]
    if DRIVER in seen.rides:
        days = columns.day_of_ride
        drivers = pd.DataFrame({"day": days, "driver": seen.rides[DRIVER].to_numpy(dtype=object)}).dropna()
        rides = drivers.groupby(["day", "driver"], as_index=False).size()
        most = rides.sort_values("size", ascending=False, kind="stable").drop_duplicates("day")
        known = dict(zip(most["day"], most["driver"], strict=True))
        ways.append(_make_groups("driver", [str(known.get(day, "")) for day in range(len(columns.start))], columns))
    return [group for way in ways if len(way) > 1 for group in way]


def _make_groups(kind: str, labels: list[str], columns: WindowColumns) -> list[Group]:
    """Return a group for each label but the empty one that has enough vehicle-days and is not just one car."""
    of_day = np.array(labels, dtype=object)
    groups = [(f"{kind} {name}", np.flatnonzero(of_day == name)) for name in sorted(set(labels) - {""})]
    return [
        (name, days) for name, days in groups if len(days) >= LEAST_DAYS_OF_GROUP and not _is_one_car(days, columns)
    ]


def _is_one_car(days: Ints, columns: WindowColumns) -> bool:
    """Return whether vehicle-days are all those of one car, which is tested anyway."""
    cars = set(columns.car_of_day[days].tolist())
    return len(cars) == 1 and len(days) == int((columns.car_of_day == cars.pop()).sum())
