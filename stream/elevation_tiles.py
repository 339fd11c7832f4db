"""Read tiles of elevation through rasterio: SRTM (`.hgt`, also in gzip or zip) and GeoTIFF.

rasterio comes with the extra `elevation` and is imported when the first tile is read.
"""

import errno
import gzip
import os
import zipfile
from math import radians, sqrt
from pathlib import Path
from typing import Any, Final

import numpy as np

from socast.core.cleaning.elevation_map import ElevationRaster
from socast.core.errors import SettingsError

SRTM_RELATIVE_ERROR: Final = 7.0
"""Error of the difference of two heights of SRTM that is exceeded in one case of ten: mean of six continents. [m]
Farr et al., Rev. Geophys. 45 (2007) RG2004, DOI 10.1029/2005RG000183, Table 1."""
TWO_SIDED_90: Final = 1.6449
"""Half-width of the interval that holds nine tenths of a Gaussian. [standard deviations]"""
TILE_SD: Final = SRTM_RELATIVE_ERROR / TWO_SIDED_90 / sqrt(2.0)
"""Standard uncertainty of a tile that does not state its own: 3.0 m. [m]"""
SD_TAG: Final = "ELEVATION_SD_M"
"""Tag with which a GeoTIFF states its standard uncertainty. [m]"""
SRTM_VOID: Final = -32768
"""Value of a void of SRTM. [m]"""
MOST_NODES: Final = 200_000_000
"""Largest number of nodes of a tile, in files and in memory; a tile of SRTM with 1 arc second has 13 million."""
_LARGEST_HGT: Final = 2 * 3601**2  # a tile of SRTM with 1 arc second [B]
_TOO_LARGE: Final = "it has more than {most:,} bytes: cut it with gdal_translate -projwin"
WGS84: Final = "EPSG:4326"
"""Latitude and longitude."""
INSTALL: Final = "install it with: pip install 'socast[elevation]'"


def read_tile(path: Path) -> ElevationRaster:
    """Return the grid of a tile.

    A GeoTIFF in another coordinate system is resampled to latitude and longitude. Its elevation is that of its first
    band. Nodes without data are unknown.

    Parameters
    ----------
    path : Path
        `.hgt`, `.hgt.gz`, `.hgt.zip`, `.zip` with one `.hgt` inside, `.tif` or `.tiff`, in upper or lower case.
    """
    try:
        from rasterio.errors import RasterioError  # noqa: PLC0415 - an extra
        from rasterio.io import MemoryFile  # noqa: PLC0415
    except ImportError as error:
        raise SettingsError(f"--elevation {path} needs rasterio; {INSTALL}") from error
    try:
        name, content = _read_content(path)
    except OSError as error:
        raise _make_error(path, error.strerror or str(error)) from error
    except (zipfile.BadZipFile, EOFError, ValueError) as error:
        raise _make_error(path, str(error)) from error
    try:
        with MemoryFile(content, filename=name) as memory, memory.open() as dataset:
            return _read_dataset(dataset)
    except RasterioError as error:  # its text names a file in memory that the user does not know
        raise _make_error(path, f"its {len(content):,} bytes are neither an SRTM tile nor a GeoTIFF") from error
    except ValueError as error:
        raise _make_error(path, str(error)) from error


def _make_error(path: Path, reason: str) -> SettingsError:
    """Return the error about a tile that cannot be read."""
    words = " ".join(reason.split())
    return SettingsError(
        f"--elevation {path} cannot be read: {words}; give a whole SRTM tile such as N45W074.hgt, or a GeoTIFF"
    )


def _read_content(path: Path) -> tuple[str, bytes]:
    """Return the name and the content of a tile, unpacked."""
    if not path.is_file():  # a device may never end
        raise ValueError("it is no file" if path.exists() else os.strerror(errno.ENOENT))
    kind = path.suffix.lower()
    if kind == ".gz":
        with gzip.open(path) as file:
            return path.stem, _read_limited(file, path.stem)
    if kind == ".zip":
        with zipfile.ZipFile(path) as archive:
            inside = [name for name in archive.namelist() if name.lower().endswith((".hgt", ".tif", ".tiff"))]
            if len(inside) != 1:
                raise ValueError(f"it holds {len(inside)} tiles and must hold one")
            with archive.open(inside[0]) as file:
                return Path(inside[0]).name, _read_limited(file, inside[0])
    with path.open("rb") as file:
        if path.stat().st_size > 4 * MOST_NODES:
            raise ValueError(_TOO_LARGE.format(most=4 * MOST_NODES))
        return path.name, _read_limited(file, path.name)


def _read_limited(file: Any, name: str) -> bytes:
    """Return the content of a file, or refuse a file that is empty or larger than a tile of its kind."""
    most = _LARGEST_HGT if name.lower().endswith(".hgt") else 4 * MOST_NODES
    if not (content := bytes(file.read(most + 1))):
        raise ValueError("it is empty")
    if len(content) > most:
        raise ValueError(_TOO_LARGE.format(most=most))
    return content


def _read_dataset(dataset: Any) -> ElevationRaster:
    """Return the grid of an open data set, resampled to latitude and longitude if necessary."""
    from rasterio.enums import Resampling  # noqa: PLC0415 - an extra
    from rasterio.vrt import WarpedVRT  # noqa: PLC0415

    if dataset.crs is None:
        raise ValueError("it states no coordinate system")
    if dataset.width * dataset.height > MOST_NODES:
        raise ValueError(f"it has more than {MOST_NODES:,} nodes: cut it with gdal_translate -projwin")
    sd = float(dataset.tags().get(SD_TAG, TILE_SD))
    if not 0.0 < sd < float("inf"):
        raise ValueError(f"its tag {SD_TAG} is {sd:g} and must be above 0")
    transform = dataset.transform
    north_up = transform.b == 0.0 and transform.d == 0.0 and transform.a > 0.0 and transform.e < 0.0
    if dataset.crs.is_geographic and north_up:
        return _make_raster(dataset, sd)
    nodata = SRTM_VOID if dataset.nodata is None else dataset.nodata
    with WarpedVRT(dataset, crs=WGS84, resampling=Resampling.bilinear, nodata=nodata, add_alpha=False) as warped:
        return _make_raster(warped, sd)


def _make_raster(dataset: Any, sd: float) -> ElevationRaster:
    """Return the grid of a data set in latitude and longitude with rows from north to south."""
    elevation = dataset.read(1)[::-1]
    step = dataset.transform
    south = step.f + step.e * (dataset.height - 0.5)
    west = step.c + 0.5 * step.a
    if not (-90.0 <= south <= 90.0 and -180.5 <= west <= 180.0):
        raise ValueError(f"it begins at latitude {south:g}, longitude {west:g}")
    unknown = float(SRTM_VOID if dataset.nodata is None else dataset.nodata)
    return ElevationRaster(
        radians(south), radians(west), radians(-step.e), radians(step.a), np.ascontiguousarray(elevation), unknown, sd
    )
