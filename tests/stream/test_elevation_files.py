"""Test that learned maps survive their file, and that unusable files are refused in one line."""

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from socast.core.cleaning.elevation_map import ElevationPlaces
from socast.core.errors import SettingsError
from socast.stream.elevation_files import open_elevation, read_places, write_places


@pytest.fixture
def places():
    row, column = (each.ravel() for each in np.mgrid[5000:5003, -9000:-8996])
    rng = np.random.default_rng(1)
    elevation, sd = rng.uniform(0.0, 90.0, 12), rng.uniform(0.2, 2.0, 12)
    return ElevationPlaces(3.1e-6, 4.4e-6, row, column, elevation, sd, np.arange(12))


def test_map_survives_its_file(places, tmp_path):
    write_places(places, tmp_path / "map.parquet")
    read = read_places(tmp_path / "map.parquet")
    for name in ("row", "column", "fixes"):
        np.testing.assert_array_equal(getattr(read, name), getattr(places, name))
    np.testing.assert_allclose(read.elevation, places.elevation, atol=1e-5)
    np.testing.assert_allclose(read.sd, places.sd, atol=1e-6)
    assert read.step_longitude == pytest.approx(places.step_longitude, rel=1e-15)
    assert open_elevation([tmp_path / "map.parquet"]).layers[0].digest() == read.digest()


def test_file_is_a_table_that_a_person_can_read(places, tmp_path):
    write_places(places, tmp_path / "map.parquet")
    table = pd.read_parquet(tmp_path / "map.parquet")
    assert len(table) == 12
    assert table["latitude_deg"].iloc[0] == pytest.approx(np.degrees(5000 * 3.1e-6), abs=1e-6)
    assert {"elevation_m", "elevation_sd_m", "fixes"} <= set(table)


def test_no_file_is_no_map():
    assert open_elevation([]) is None


def broken(path, places, kind):
    """Make a file that cannot be used, and return it."""
    if kind == "cut":
        write_places(places, path)
        path.write_bytes(path.read_bytes()[:300])
    elif kind == "table":
        pd.DataFrame({"row": [1]}).to_parquet(path)
    elif kind in {"version", "column", "sd"}:
        write_places(places, path)
        table = pq.read_table(path)
        if kind == "version":
            table = table.replace_schema_metadata({**table.schema.metadata, b"version": b"2"})
        elif kind == "column":
            table = table.drop_columns(["fixes"])
        else:
            at = table.column_names.index("elevation_sd_m")
            table = table.set_column(at, "elevation_sd_m", pa.array([0.0] * 12, pa.float32()))
        pq.write_table(table, path)
    return path


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("missing", "there is no map of elevation"),
        ("cut", "Parquet"),
        ("table", "another table, version unknown"),
        ("version", "version 2, and this product reads version 1"),
        ("column", "fixes"),
        ("sd", "not above 0"),
    ],
)
def test_unusable_map_is_refused_in_one_line_with_the_remedy(kind, words, places, tmp_path):
    with pytest.raises(SettingsError) as refused:
        read_places(broken(tmp_path / "map.parquet", places, kind))
    message = str(refused.value)
    assert words in message
    assert "`socast elevation learn`" in message
    assert "\n" not in message


def test_unknown_kind_of_file_and_repeated_file_are_refused(places, tmp_path):
    with pytest.raises(SettingsError, match=r"unknown kind of file '\.csv'; give SRTM tiles"):
        open_elevation([tmp_path / "map.csv"])
    write_places(places, tmp_path / "map.parquet")
    with pytest.raises(SettingsError, match="given twice"):
        open_elevation([tmp_path / "map.parquet", tmp_path / ".." / tmp_path.name / "map.parquet"])


def test_map_in_a_missing_folder_is_refused(places, tmp_path):
    with pytest.raises(SettingsError, match="cannot be written"):
        write_places(places, tmp_path / "no" / "map.parquet")
