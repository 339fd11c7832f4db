"""Open maps of elevation for `--elevation`: tiles of a survey, and files that `socast elevation learn` wrote.

A learned map is a Parquet file with one row per place, sorted by `row` and `column`. Its metadata hold the version of
the format and the distance between places.
"""

import os
from collections.abc import Sequence
from math import degrees, radians
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from socast.core.cleaning.elevation_map import ElevationLayer, ElevationMap, ElevationPlaces
from socast.core.errors import SettingsError
from socast.core.files import refuse_beyond_memory, replacing
from socast.stream.elevation_tiles import read_tile

SUFFIX: Final = ".parquet"
"""End of the name of a learned map."""
TILES: Final = (".hgt", ".gz", ".zip", ".tif", ".tiff")
"""Ends of the names of tiles, in upper or lower case."""
FORMAT: Final = "socast elevation map"
"""Name of the format, in the metadata of a file."""
VERSION: Final = 1
"""Version of the format. It rises when a column is removed, is renamed or changes its meaning."""
COLUMNS: Final = {
    "row": pa.int32(),  # latitude over the distance between rows [1]
    "column": pa.int32(),  # longitude over the distance between columns [1]
    "latitude_deg": pa.float64(),  # WGS 84, for readers
    "longitude_deg": pa.float64(),
    "elevation_m": pa.float32(),
    "elevation_sd_m": pa.float32(),  # standard uncertainty
    "fixes": pa.int32(),  # number of fixes nearest to the place; 0 where neighbours determine it
}
"""Columns of a learned map."""


def open_elevation(files: Sequence[Path]) -> ElevationMap | None:
    """Return the map that files make up, None without files."""
    if not files:
        return None
    layers: list[ElevationLayer] = []
    known: set[str] = set()
    for file in files:
        if (place := os.path.realpath(file)) in known:  # unlike `resolve`, it takes links in a circle
            raise SettingsError(f"--elevation {file} is given twice; give it once")
        known.add(place)
        kind = file.suffix.lower()
        if kind not in (SUFFIX, *TILES):
            raise SettingsError(
                f"--elevation {file}: unknown kind of file {file.suffix!r}; give SRTM tiles (.hgt, .hgt.gz, .zip), "
                f"GeoTIFF (.tif), or a map that `socast elevation learn` wrote ({SUFFIX})"
            )
        layers.append(read_places(file) if kind == SUFFIX else read_tile(file))
    return ElevationMap(layers)


def write_places(places: ElevationPlaces, path: Path) -> None:
    """Write a learned map."""
    columns = {
        "row": places.row,
        "column": places.column,
        "latitude_deg": np.round(np.degrees(places.row * places.step_latitude), 7),
        "longitude_deg": np.round(np.degrees(places.column * places.step_longitude), 7),
        "elevation_m": places.elevation,
        "elevation_sd_m": places.sd,
        "fixes": places.fixes,
    }
    about: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "step_latitude_deg": repr(degrees(places.step_latitude)),
        "step_longitude_deg": repr(degrees(places.step_longitude)),
    }
    schema = pa.schema(list(COLUMNS.items()), metadata={name: str(value) for name, value in about.items()})
    arrays = [pa.array(columns[name]).cast(kind) for name, kind in COLUMNS.items()]
    try:
        with replacing(path) as fresh:
            pq.write_table(pa.Table.from_arrays(arrays, schema=schema), fresh, compression="zstd")
    except OSError as error:
        raise SettingsError(f"{path} cannot be written: {error.strerror}; name a file in an existing folder") from error


def read_places(path: Path) -> ElevationPlaces:
    """Return a learned map."""
    if not path.is_file():
        raise SettingsError(f"there is no map of elevation {path}; give a file that `socast elevation learn` wrote")
    try:
        with pq.ParquetFile(path) as file:
            refuse_beyond_memory(path, file.metadata.num_rows, len(file.schema_arrow))
            table = file.read()
        about = {name.decode(): value.decode() for name, value in (table.schema.metadata or {}).items()}
        if about.get("format") != FORMAT or int(about["version"]) != VERSION:
            made_as = f"{about.get('format', 'another table')}, version {about.get('version', 'unknown')}"
            raise _make_error(path, f"it is {made_as}, and this product reads version {VERSION}")
        steps = [radians(float(about[f"step_{name}_deg"])) for name in ("latitude", "longitude")]
        row, column, _, _, elevation, sd, fixes = (table[name].to_numpy() for name in COLUMNS)
    except OSError as error:
        raise _make_error(path, error.strerror or str(error)) from error
    except (pa.ArrowException, KeyError, ValueError) as error:
        raise _make_error(path, str(error)) from error
    if not (min(steps) > 0.0 and np.isfinite(steps).all() and np.isfinite(elevation).all() and (sd > 0.0).all()):
        raise _make_error(path, "a distance or an uncertainty in it is not above 0, or an elevation is missing")
    return ElevationPlaces(steps[0], steps[1], row, column, elevation, sd, fixes)


def _make_error(path: Path, reason: str) -> SettingsError:
    """Return the error about a map that cannot be used."""
    words = " ".join(reason.split())
    return SettingsError(
        f"{path} cannot be read as a learned map of elevation: {words}; make one with `socast elevation learn`"
    )
