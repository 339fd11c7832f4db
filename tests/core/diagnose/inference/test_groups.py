"""A file names the group of each vehicle, a wrong file is refused with the remedy, and drivers are groups too."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from socast.core.diagnose.inference.groups import LEAST_DAYS_OF_GROUP, list_groups, read_groups
from socast.core.errors import ModelError
from tests.support.random_columns import draw_columns

DEPOTS = {"taxi-0": "north", "taxi-1": "north", "taxi-2": "south", "taxi-3": "south"}


@pytest.fixture
def columns():
    """Return four cars that drive on six dates, with two rides a day."""
    return draw_columns(1, cars=4, dates=6, windows=1)


def list_names(columns, of_vehicle, drivers=None):
    """Return the names and the vehicle-days of the groups."""
    rides = pd.DataFrame(index=range(len(columns.day_of_ride)))
    if drivers is not None:
        rides["driver_id"] = np.asarray(drivers, dtype=object)[columns.day_of_ride]
    return {name: days.tolist() for name, days in list_groups(SimpleNamespace(rides=rides), columns, of_vehicle)}


def test_groups_of_a_file_hold_the_days_of_their_cars(columns):
    assert list_names(columns, DEPOTS) == {"group north": list(range(12)), "group south": list(range(12, 24))}


def test_one_group_alone_has_nothing_to_differ_from(columns):
    assert list_names(columns, dict.fromkeys(DEPOTS, "north")) == {}
    assert list_names(columns, {}) == {}


def test_group_of_one_car_is_tested_as_that_car(columns):
    named = list_names(columns, {**DEPOTS, "taxi-0": "alone", "taxi-1": "south"})
    assert named == {}


def test_drivers_are_groups_of_days(columns):
    drivers = np.arange(24) % 2
    named = list_names(columns, {}, [("ann", "bob")[each] for each in drivers])
    assert named == {"driver ann": list(range(0, 24, 2)), "driver bob": list(range(1, 24, 2))}
    assert list_names(columns, {}, [None] * 24) == {}


def test_driver_of_few_days_is_no_group(columns):
    drivers = ["bob"] * (24 - LEAST_DAYS_OF_GROUP + 1) + ["ann"] * (LEAST_DAYS_OF_GROUP - 1)
    assert list_names(columns, {}, drivers) == {}


def test_file_gives_group_of_each_vehicle(tmp_path):
    file = tmp_path / "depots.csv"
    file.write_text("vehicle_id,group\n007,north\ntaxi-2,south\ntaxi-3,\n", encoding="utf-8")
    assert read_groups(file) == {"007": "north", "taxi-2": "south"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("vehicle,group\ntaxi-1,north\n", "no column 'vehicle_id'"),
        ("vehicle_id,group\ntaxi-1,north\ntaxi-1,south\n", "taxi-1 twice"),
        ("", "cannot be read"),
    ],
)
def test_wrong_file_is_refused(tmp_path, text, message):
    file = tmp_path / "depots.csv"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(ModelError, match=message):
        read_groups(file)
