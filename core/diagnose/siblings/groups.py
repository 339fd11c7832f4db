"""Group shifts by their driver, and cars by a file: depots, batches of tyres, or whatever cars may have in common."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from socast.core.diagnose.dataset import Windows
from socast.core.diagnose.siblings.sums import Siblings
from socast.core.errors import ModelError

COLUMNS: Final = ("vehicle_id", "group")
DRIVER: Final = "driver_id"
"""Column of the ride table."""
LEAST_SHIFTS: Final = 8
"""Least number of shifts of a group."""


class Group(NamedTuple):
    """Hold a group of shifts.

    Parameters
    ----------
    name : str
        Name of the group, with what it is a group of.
    members : tuple of (s,) bool
        Shifts of the group among those of the cars of each model.
    """

    name: str
    members: tuple[NDArray[np.bool_], ...]


def read_groups(path: Path) -> dict[str, str]:
    """Return the group of each vehicle of a CSV file with the columns `vehicle_id` and `group`."""
    try:
        table = pd.read_csv(path, dtype=str)
    except (OSError, ValueError) as error:
        raise ModelError(f"{path} cannot be read as CSV ({error}): give a file with a header line") from error
    if missing := [name for name in COLUMNS if name not in table]:
        raise ModelError(f"{path} has no column {missing[0]!r}: its header line must be {','.join(COLUMNS)}")
    table = table.dropna(subset=list(COLUMNS))
    if (twice := table["vehicle_id"].duplicated()).any():
        raise ModelError(f"{path} names vehicle {table.loc[twice, 'vehicle_id'].iloc[0]} twice: keep one line of each")
    return dict(zip(table["vehicle_id"], table["group"], strict=True))


def list_groups(windows: Windows, groups: Sequence[Siblings], of_vehicle: Mapping[str, str]) -> list[list[Group]]:
    """Return the groups of each way of grouping: by a file, and by driver; none where there is only one group."""
    by_file = [[of_vehicle.get(siblings.cars[car], "") for car in siblings.car] for siblings in groups]
    ways = [_make_groups("group", by_file)]
    if DRIVER in windows.rides:
        drivers = pd.DataFrame({"day": windows.day_of_ride, "driver": windows.rides[DRIVER].to_numpy(dtype=object)})
        known = drivers.dropna().groupby("day")["driver"].agg(lambda names: names.mode().iloc[0]).to_dict()
        ways.append(_make_groups("driver", [[str(known.get(day, "")) for day in each.day.tolist()] for each in groups]))
    ways = [[group for group in way if _count_shifts(group) >= LEAST_SHIFTS] for way in ways]
    ways = [[group for group in way if not _is_one_car(groups, group)] for way in ways]
    return [way for way in ways if len(way) > 1]


def _count_shifts(group: Group) -> int:
    """Return the number of shifts of a group."""
    return int(sum(there.sum() for there in group.members))


def _is_one_car(groups: Sequence[Siblings], group: Group) -> bool:
    """Return whether a group is one car, which is asked anyway."""
    cars = [np.unique(siblings.car[there]) for siblings, there in zip(groups, group.members, strict=True)]
    if sum(len(each) for each in cars) > 1:
        return False
    return all(
        bool(np.all(there[np.isin(siblings.car, each)]))
        for siblings, there, each in zip(groups, group.members, cars, strict=True)
    )


def _make_groups(kind: str, labels: list[list[str]]) -> list[Group]:
    """Return a group for each label but the empty one."""
    names = sorted({label for each in labels for label in each if label})
    arrays = [np.array(each, dtype=object) for each in labels]
    return [
        Group(f"{kind} {name}", tuple(np.asarray(each == name, dtype=np.bool_) for each in arrays)) for name in names
    ]
