"""Test that SRTM tiles and GeoTIFF are read as they are written by rasterio, packed or not, and refused when broken."""

import gzip
import shutil
import sys
import zipfile

import numpy as np
import pytest

from socast.core.errors import SettingsError
from socast.stream.elevation_files import open_elevation
from socast.stream.elevation_tiles import SD_TAG, TILE_SD, read_tile
from tests.support.ground import SRTM_NODES, hills, north_up, srtm_of_hills

rasterio = pytest.importorskip("rasterio")
from rasterio.warp import transform as convert  # noqa: E402

LATITUDE, LONGITUDE = np.radians([45.5, 45.51, 45.99]), np.radians([-73.6, -73.61, -73.01])


@pytest.fixture(scope="module")
def tile(tmp_path_factory):
    return srtm_of_hills(tmp_path_factory.mktemp("tiles") / "N45W074.hgt")


def packed(tile, folder, kind):
    """Return the tile, packed in a file of a kind."""
    if kind == "hgt":
        return tile
    if kind == "gz":
        path = folder / f"{tile.name}.gz"
        path.write_bytes(gzip.compress(tile.read_bytes(), 1))
        return path
    path = folder / "N45W074.SRTMGL3.hgt.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.write(tile, tile.name)
    return path


@pytest.mark.parametrize("kind", ["hgt", "gz", "zip"])
def test_srtm_tile_has_the_elevation_of_the_ground(tile, kind, tmp_path):
    ground = read_tile(packed(tile, tmp_path, kind)).find_ground(LATITUDE, LONGITUDE)
    np.testing.assert_allclose(ground.elevation, hills(LATITUDE, LONGITUDE), atol=1.2)  # metres, 90 m apart
    np.testing.assert_allclose(ground.variance, TILE_SD**2)


@pytest.mark.parametrize("kind", ["hgt", "gz", "zip"])
def test_names_in_upper_case_are_read_like_those_in_lower_case(tile, kind, tmp_path):
    upper = shutil.copy(tile, tmp_path / "N45W074.HGT")
    path = packed(upper, tmp_path, kind)
    path = path.rename(path.with_name(path.name.upper()))
    np.testing.assert_array_equal(open_elevation([path]).layers[0].elevation, read_tile(tile).elevation)


def test_corner_of_an_srtm_tile_is_its_first_node(tile):
    raster = read_tile(tile)
    assert np.degrees([raster.south, raster.west]) == pytest.approx([45.0, -74.0], abs=1e-9)
    assert raster.elevation.shape == (SRTM_NODES, SRTM_NODES)
    assert np.isnan(raster.find_ground(np.radians([44.99]), np.radians([-73.5])).elevation).all()


def test_uncertainty_of_srtm_is_that_of_its_relative_error():
    assert pytest.approx(3.0, abs=0.05) == TILE_SD


def test_voids_are_unknown(tile, tmp_path):
    content = np.frombuffer(tile.read_bytes(), ">i2").reshape(SRTM_NODES, SRTM_NODES).copy()
    content[600, 480] = -32768  # 45.5 N, 73.6 W
    path = tmp_path / "N45W074.hgt"
    path.write_bytes(content.tobytes())
    assert np.isnan(read_tile(path).find_ground(LATITUDE, LONGITUDE).elevation).tolist() == [True, False, False]


def write_geotiff(path, crs, transform, elevation, nodata=None, tags=None):
    shape = elevation.shape
    options = {"driver": "GTiff", "dtype": "float32", "count": 1, "nodata": nodata}
    with rasterio.open(path, "w", width=shape[1], height=shape[0], crs=crs, transform=transform, **options) as file:
        file.write(elevation.astype(np.float32), 1)
        file.update_tags(**(tags or {}))
    return path


def geographic(path, size=200, **options):
    """Write a GeoTIFF of the hills with pixels of 0.0001 degrees about the place where drives begin."""
    step = 1e-4
    north, west = 45.51, -73.61
    latitude, longitude = north - step * (np.arange(size) + 0.5), west + step * (np.arange(size) + 0.5)
    elevation = hills(np.radians(latitude)[:, None], np.radians(longitude)[None, :])
    return write_geotiff(path, "EPSG:4326", north_up(west, north, step), elevation, **options)


def test_geotiff_states_its_uncertainty(tmp_path):
    raster = read_tile(geographic(tmp_path / "city.tif", tags={SD_TAG: "0.3"}))
    ground = raster.find_ground(LATITUDE[:1], LONGITUDE[:1])
    assert ground.elevation == pytest.approx(hills(LATITUDE[:1], LONGITUDE[:1]), abs=0.05)
    assert ground.variance == pytest.approx([0.09])


def test_geotiff_in_metres_is_resampled(tmp_path):
    (x,), (y,) = convert("EPSG:4326", "EPSG:32618", [-73.6], [45.5])
    east, north = x - 500.0 + 10.0 * (np.arange(100) + 0.5), y + 500.0 - 10.0 * (np.arange(100) + 0.5)
    grid = np.meshgrid(east, north)
    longitude, latitude = convert("EPSG:32618", "EPSG:4326", *(each.ravel() for each in grid))
    elevation = hills(np.radians(latitude), np.radians(longitude)).reshape(100, 100)
    transform = north_up(x - 500.0, y + 500.0, 10.0)
    raster = read_tile(write_geotiff(tmp_path / "utm.tif", "EPSG:32618", transform, elevation))
    near = LATITUDE[:1] + 3e-5, LONGITUDE[:1] - 2e-5
    assert raster.find_ground(*near).elevation == pytest.approx(hills(*near), abs=0.2)


def refused(path):
    with pytest.raises(SettingsError) as error:
        read_tile(path)
    message = str(error.value)
    assert message.startswith(f"--elevation {path} cannot be read: ")
    assert "\n" not in message
    assert message.endswith("give a whole SRTM tile such as N45W074.hgt, or a GeoTIFF")
    assert "vsimem" not in message
    return message


def test_missing_and_broken_tiles_are_refused_in_one_line(tile, tmp_path):
    assert "No such file" in refused(tmp_path / "N45W074.hgt")
    for name, content in {
        "N45W074.hgt": tile.read_bytes()[:5000],
        "N45W073.hgt.gz": gzip.compress(tile.read_bytes(), 1)[:5000],
        "N45W072.hgt.gz": b"no gzip",
        "N45W071.zip": b"no archive",
        "city.tif": b"no tif",
    }.items():
        (tmp_path / name).write_bytes(content)
        refused(tmp_path / name)
    assert "its 5,000 bytes are neither an SRTM tile nor a GeoTIFF" in refused(tmp_path / "N45W074.hgt")
    (tmp_path / "empty.hgt").touch()
    assert "it is empty" in refused(tmp_path / "empty.hgt")


def test_archive_that_expands_beyond_a_tile_is_refused(tmp_path):
    (tmp_path / "N45W074.hgt.gz").write_bytes(gzip.compress(bytes(100_000_000), 1))
    assert "it has more than 25,934,402 bytes" in refused(tmp_path / "N45W074.hgt.gz")


def test_geotiff_that_is_cut_off_is_refused(tmp_path):
    path = geographic(tmp_path / "city.tif")
    path.write_bytes(path.read_bytes()[:100_000])
    assert "its 100,000 bytes" in refused(path)


def test_archive_with_no_tile_or_several_is_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "two.zip", "w") as archive:
        archive.writestr("a.hgt", b"")
        archive.writestr("b.hgt", b"")
    assert "it holds 2 tiles and must hold one" in refused(tmp_path / "two.zip")


def test_wrong_uncertainty_and_missing_coordinate_system_are_refused(tmp_path):
    assert "must be above 0" in refused(geographic(tmp_path / "city.tif", tags={SD_TAG: "0"}))
    elevation = np.zeros((20, 20))
    nowhere = write_geotiff(tmp_path / "nowhere.tif", None, north_up(0.0, 1.0, 0.1), elevation)
    assert "coordinate system" in refused(nowhere)


def test_missing_rasterio_is_one_line_with_the_command_that_installs_it(tile, monkeypatch):
    monkeypatch.setitem(sys.modules, "rasterio.errors", None)
    with pytest.raises(SettingsError, match=r"needs rasterio; install it with: pip install 'socast\[elevation\]'$"):
        read_tile(tile)
