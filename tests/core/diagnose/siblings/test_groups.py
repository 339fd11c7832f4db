"""Test groups: a file names the group of each vehicle, and a wrong file is refused with the remedy."""

import pytest

from socast.core.diagnose.siblings.groups import read_groups
from socast.core.errors import ModelError


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
