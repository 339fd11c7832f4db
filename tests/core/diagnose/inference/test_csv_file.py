"""Small CSV files: what is read, and what is refused without taking memory or time."""

import pytest

from socast.core.diagnose.inference.csv_file import LARGEST_CSV, read_csv
from socast.core.errors import ModelError


def test_cells_are_text_and_an_empty_one_is_empty(tmp_path):
    file = tmp_path / "depots.csv"
    file.write_text("vehicle_id,group\n007,NA\n008,\n")
    assert read_csv(file).to_dict("records") == [
        {"vehicle_id": "007", "group": "NA"},
        {"vehicle_id": "008", "group": ""},
    ]


@pytest.mark.parametrize("name", ["/dev/zero", "circle", "folder", "absent", "latin", "quote", "n" * 300])
def test_what_is_no_csv_file_is_one_line(tmp_path, name):
    path = tmp_path / name
    (tmp_path / "circle").symlink_to("circle")
    (tmp_path / "folder").mkdir()
    (tmp_path / "latin").write_bytes(b"a\xff\n")
    (tmp_path / "quote").write_bytes(b'a\n"' + b"x" * 1000)
    with pytest.raises(ModelError, match="cannot be read as CSV") as refused:
        read_csv(path)
    assert "\n" not in str(refused.value)


def test_file_that_is_too_large_is_refused_with_its_limit(tmp_path):
    path = tmp_path / "large.csv"
    with path.open("wb") as file:
        file.truncate(LARGEST_CSV + 1)
    with pytest.raises(ModelError, match="16,777,217 bytes or more, above the limit of 16,777,216"):
        read_csv(path)
