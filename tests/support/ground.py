"""Ground whose elevation is known, fixes on it, and tiles of it."""

from pathlib import Path
from typing import Any

import numpy as np

from socast.core.columns import EARTH_RADIUS
from socast.core.fit.elevation_learning import ElevationFixes
from tests.support.telemetry import PLACE, drive

SRTM_NODES = 1201
"""Nodes along a side of an SRTM tile with 3 arc seconds."""


def metres(latitude, longitude):
    """Return the position east and north of the place where drives begin. [m]"""
    north = (latitude - np.radians(PLACE[0])) * EARTH_RADIUS
    return (longitude - np.radians(PLACE[1])) * EARTH_RADIUS * np.cos(np.radians(PLACE[0])), north


def hills(latitude, longitude):
    """Return the elevation of gentle hills at positions [rad]. [m]"""
    x, y = metres(latitude, longitude)
    return 50.0 + 20.0 * np.sin(y / 300.0) + 8.0 * np.cos(x / 400.0)


def hilly_drive(n=300, seed=1, noise=2.0, offset=0.0, **columns):
    """Return the samples of a drive over the hills, whose logger has noise and an offset [m]."""
    made = drive(n, seed=seed, speed=12.0, **columns)
    truth = hills(np.radians(made["latitude_deg"]), np.radians(made["longitude_deg"]))
    wrong = np.random.default_rng(seed).normal(0.0, noise, n)
    return made | {"elevation_m": truth + wrong + offset, "truth": truth}


def street_fixes(rides, seed=1, noise=2.0, offsets=(0.0,), ride_sd=0.0, error=None, spacing=25.0):
    """Return the fixes of rides over a grid of six streets of 1 km, and the elevation without errors.

    Each car in turn has one of the offsets [m]; `ride_sd` is the standard deviation of those of its rides [m].
    """
    rng = np.random.default_rng(seed)
    along = np.arange(0.0, 1000.0, spacing)
    parts = []
    for ride in range(rides):
        across = 200.0 * rng.integers(0, 6) + rng.normal(0.0, 3.0, len(along))
        x, y = (along, across) if ride % 2 else (across, along)
        latitude = np.radians(PLACE[0]) + y / EARTH_RADIUS
        longitude = np.radians(PLACE[1]) + x / EARTH_RADIUS / np.cos(np.radians(PLACE[0]))
        truth = hills(latitude, longitude)
        car = ride % len(offsets)
        wrong = offsets[car] + rng.normal(0.0, ride_sd) + rng.normal(0.0, noise, len(along))
        if error is not None:
            wrong[rng.integers(len(along))] += error
        ones = np.ones(len(along), np.int64)
        parts.append((latitude, longitude, truth + wrong, car * ones, ride * ones, 20_000 * ones + ride // 4))
    return ElevationFixes(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def north_up(west: float, north: float, step: float) -> Any:
    """Return the transform of a grid with square pixels, given its corner in the north-west."""
    from rasterio import Affine  # noqa: PLC0415 - an extra; its `from_origin` calls what affine is about to drop

    return Affine(step, 0.0, west, 0.0, -step, north)


def write_srtm(path: Path, elevation) -> Path:
    """Write an SRTM tile through rasterio, with rows from north to south; the name gives its corner."""
    import rasterio  # noqa: PLC0415 - an extra

    sign = {"N": 1, "S": -1, "E": 1, "W": -1}
    south, west = sign[path.name[0]] * int(path.name[1:3]), sign[path.name[3]] * int(path.name[4:7])
    step = 1.0 / (SRTM_NODES - 1)
    transform = north_up(west - step / 2, south + 1 + step / 2, step)
    options = {"driver": "SRTMHGT", "dtype": "int16", "count": 1, "nodata": -32768, "crs": "EPSG:4326"}
    from rasterio.io import MemoryFile  # noqa: PLC0415
    from rasterio.shutil import copy  # noqa: PLC0415

    with MemoryFile() as memory:
        with memory.open(
            **(options | {"driver": "GTiff"}), width=SRTM_NODES, height=SRTM_NODES, transform=transform
        ) as tile:
            tile.write(np.asarray(elevation, np.int16), 1)
        with memory.open() as tile:
            copy(tile, str(path), driver="SRTMHGT")
    assert rasterio.open(path).shape == (SRTM_NODES, SRTM_NODES)
    return path


def srtm_of_hills(path: Path) -> Path:
    """Write the SRTM tile N45W074 of the hills, rounded to metres."""
    step = np.radians(1.0 / (SRTM_NODES - 1))
    latitude = np.radians(46.0) - step * np.arange(SRTM_NODES)[:, None]
    longitude = np.radians(-74.0) + step * np.arange(SRTM_NODES)[None, :]
    return write_srtm(path, np.rint(hills(*np.broadcast_arrays(latitude, longitude))))
