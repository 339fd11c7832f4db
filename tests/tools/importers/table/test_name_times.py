"""Test that days and starts of clocks are read from the names of files."""

from pathlib import Path
from zoneinfo import ZoneInfo

import pytest

from socast.core.errors import ImportFileError
from socast.tools.importers.table.time_words import find_origin, find_unknown_directive, guess_name_form

EIGHT = 1714550400.0
"""1 May 2024, 08:00 UTC. [Unix s]"""


@pytest.mark.parametrize(
    ("name", "form"),
    [
        ("ride_2024-05-01_080000.csv.gz", "%Y-%m-%d_%H%M%S"),
        ("2024-05-01 08.00.00.csv", "%Y-%m-%d %H.%M.%S"),
        ("log20240501T0800.csv", "%Y%m%dT%H%M"),
        ("20240501080000.csv", "%Y%m%d%H%M%S"),
    ],
)
def test_form_of_the_start_in_a_name_is_guessed_and_read(name, form):
    assert guess_name_form([Path(name)]) == form
    assert find_origin(Path(name), form, ZoneInfo("UTC")) == EIGHT


@pytest.mark.parametrize("name", ["TripA01.csv", "2024-05-01.csv", "ride_2024-05-01_990000.csv", "1714550400.csv"])
def test_name_without_day_and_time_has_no_form(name):
    assert guess_name_form([Path("ride_2024-05-01_080000.csv"), Path(name)]) is None


def test_start_in_a_name_is_local_time_of_the_zone():
    form = "ride_%Y-%m-%d_%H%M%S"
    assert find_origin(Path("ride_2024-05-01_080000.csv"), form, ZoneInfo("Europe/Berlin")) == EIGHT - 7200.0


@pytest.mark.parametrize("name", ["ride.csv", "ride_2024-13-01_080000.csv"])
def test_name_of_another_form_is_one_clear_line(name):
    with pytest.raises(ImportFileError, match="its name has not the form 'ride_%Y-%m-%d_%H%M%S' of origin_from"):
        find_origin(Path(name), "ride_%Y-%m-%d_%H%M%S", ZoneInfo("UTC"))


def test_directive_given_twice_is_one_clear_line():
    with pytest.raises(ImportFileError, match="its name has not the form '%Y-%Y'"):
        find_origin(Path("2024-2024.csv"), "%Y-%Y", ZoneInfo("UTC"))


def test_unknown_directive_is_found():
    assert find_unknown_directive("%A %d") == "%A"
