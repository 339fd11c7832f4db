"""Look up the elevation of the ground on maps, with its uncertainty; no input or output.

A map is a list of layers: grids of a survey (`ElevationRaster`), or places at which a fleet has measured
(`ElevationPlaces`). Both interpolate bilinearly between four nodes. A place of which one node is unknown is unknown.

Several layers are combined by inverse variance. Their errors are taken as independent, and their elevations as of the
same datum.
"""

from collections import Counter
from collections.abc import Sequence
from functools import cached_property
from hashlib import sha256
from math import pi
from typing import Any, Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Batch, Floats, Ints
from socast.core.cleaning.motion import NULL_ISLAND

_COLUMNS: Final = 2**31
"""Number of columns between two rows of nodes in the key of a place."""
CORNERS: Final = ((0, 0), (0, 1), (1, 0), (1, 1))
"""The four nodes about a position: steps north and east of the one in the south-west."""


class Ground(NamedTuple):
    """Hold the elevation of the ground at n positions.

    Parameters
    ----------
    elevation : (n,) float
        Elevation above the datum of the map, NaN where it is unknown. [m]
    variance : (n,) float
        Variance of its error, NaN where it is unknown. [m^2]
    """

    elevation: Floats
    variance: Floats


class ElevationLayer(Protocol):
    """A part of a map."""

    def find_ground(self, latitude: Floats, longitude: Floats) -> Ground:
        """Return the ground at n positions [rad], NaN where it is unknown."""

    def digest(self) -> bytes:
        """Return a digest of the content."""


class ElevationRaster(NamedTuple):
    """A grid of a survey, with rows from south to north.

    Parameters
    ----------
    south, west : float
        Position of the first node. [rad]
    step_latitude, step_longitude : float
        Distance between nodes, above 0. [rad]
    elevation : (rows, columns) number
        Elevation of the nodes. [m]
    unknown : float
        Value that marks a node without elevation; nodes that are NaN have none either. [m]
    sd : float
        Standard uncertainty of a node. [m]
    """

    south: float
    west: float
    step_latitude: float
    step_longitude: float
    elevation: NDArray[Any]
    unknown: float
    sd: float

    def find_ground(self, latitude: Floats, longitude: Floats) -> Ground:
        """Return the ground at n positions.

        A position up to half a step beyond the outermost nodes has the elevation of the edge. A position beside a node
        without elevation has none.

        Examples
        --------
        >>> nodes = np.array([[0, 10, -32768], [20, 30, -32768]])
        >>> grid = ElevationRaster(0.0, 0.0, 1.0, 1.0, nodes, -32768.0, 3.0)
        >>> grid.find_ground(np.array([0.0, 0.5, 0.5]), np.array([0.25, 0.5, 1.5])).elevation.tolist()
        [2.5, 15.0, nan]
        """
        rows, columns = self.elevation.shape
        y = (latitude - self.south) / self.step_latitude
        x = (longitude - self.west) / self.step_longitude
        inside = (y >= -0.5) & (y <= rows - 0.5) & (x >= -0.5) & (x <= columns - 0.5)  # False for NaN
        y = np.clip(np.where(inside, y, 0.0), 0.0, rows - 1.0)
        x = np.clip(np.where(inside, x, 0.0), 0.0, columns - 1.0)
        row = np.minimum(y.astype(np.int64), max(rows - 2, 0))
        column = np.minimum(x.astype(np.int64), max(columns - 2, 0))
        nodes = np.stack(
            [
                self.elevation[np.minimum(row + up, rows - 1), np.minimum(column + right, columns - 1)]
                for up, right in CORNERS
            ]
        ).astype(np.float64)
        nodes[nodes == self.unknown] = np.nan
        elevation = _interpolate(nodes, y - row, x - column)
        elevation[~inside] = np.nan
        return Ground(elevation, np.where(np.isnan(elevation), np.nan, self.sd * self.sd))

    def digest(self) -> bytes:
        """Return a digest of the content."""
        place = np.array([self.south, self.west, self.step_latitude, self.step_longitude, self.unknown, self.sd])
        return sha256(place.tobytes() + np.ascontiguousarray(self.elevation).tobytes()).digest()


class ElevationPlaces:
    """Places at which a fleet has measured, on a grid through latitude 0 and longitude 0.

    Parameters
    ----------
    step_latitude, step_longitude : float
        Distance between nodes. [rad]
    row, column : (m,) int
        Nodes that are known: their latitude is `row * step_latitude`, their longitude `column * step_longitude`.
    elevation, sd : (m,) float
        Elevation of the nodes, and its standard uncertainty. [m]
    fixes : (m,) int
        Number of fixes nearest to the node; 0 where neighbours alone determine it.
    """

    def __init__(
        self,
        step_latitude: float,
        step_longitude: float,
        row: Ints,
        column: Ints,
        elevation: Floats,
        sd: Floats,
        fixes: Ints,
    ) -> None:
        order = np.argsort(number_nodes(row, column), kind="stable")
        self.step_latitude, self.step_longitude = float(step_latitude), float(step_longitude)
        self.row, self.column, self.fixes = (np.asarray(each, np.int64)[order] for each in (row, column, fixes))
        self.elevation, self.sd = (np.asarray(each, np.float64)[order] for each in (elevation, sd))

    def __len__(self) -> int:
        return len(self.row)

    @cached_property
    def _keys(self) -> Ints:
        """Key of each node, in ascending order."""
        return number_nodes(self.row, self.column)

    def find_ground(self, latitude: Floats, longitude: Floats) -> Ground:
        """Return the ground at n positions.

        Returns
        -------
        Ground
            The variance is the mean of those of the four nodes, because neighbours share most of their error.

        Examples
        --------
        >>> ones = np.ones(4)
        >>> places = ElevationPlaces(1.0, 1.0, [0, 0, 1, 1], [0, 1, 0, 1], [0.0, 4.0, 0.0, 4.0], 0.5 * ones, ones)
        >>> places.find_ground(np.array([0.5, 0.5]), np.array([0.25, 1.5]))
        Ground(elevation=array([ 1., nan]), variance=array([0.25,  nan]))
        """
        known = ~(np.isnan(latitude) | np.isnan(longitude))
        y = np.where(known, latitude, 0.0) / self.step_latitude
        x = np.where(known, longitude, 0.0) / self.step_longitude
        row, column = np.floor(y).astype(np.int64), np.floor(x).astype(np.int64)
        nodes, variances = np.empty((4, len(y))), np.empty((4, len(y)))
        for corner, (up, right) in enumerate(CORNERS):
            key = number_nodes(row + up, column + right)
            at = np.minimum(np.searchsorted(self._keys, key), max(len(self) - 1, 0))
            here = known & (self._keys[at] == key) if len(self) else np.zeros(len(y), bool)
            nodes[corner] = np.where(here, self.elevation[at], np.nan) if len(self) else np.nan
            variances[corner] = np.where(here, self.sd[at] ** 2, np.nan) if len(self) else np.nan
        return Ground(_interpolate(nodes, y - row, x - column), _interpolate(variances, y - row, x - column))

    def digest(self) -> bytes:
        """Return a digest of the content."""
        parts = (np.array([self.step_latitude, self.step_longitude]), self.row, self.column, self.elevation, self.sd)
        return sha256(b"".join(part.tobytes() for part in parts)).digest()


def number_nodes(row: Any, column: Any) -> Ints:
    """Return one whole number for each node of a grid, in the order of rows and then of columns.

    Examples
    --------
    >>> number_nodes([0, 1], [3, -3]).tolist()
    [3, 2147483645]
    """
    return np.asarray(row, np.int64) * _COLUMNS + np.asarray(column, np.int64)


def _interpolate(nodes: Floats, north: Floats, east: Floats) -> Floats:
    """Return the bilinear mean of the values at four nodes, (4, n), at shares of a step from the first one."""
    south_side = nodes[0] + east * (nodes[1] - nodes[0])
    north_side = nodes[2] + east * (nodes[3] - nodes[2])
    return np.asarray(south_side + north * (north_side - south_side))


class ElevationMap:
    """Combine the layers of a map by inverse variance.

    Attributes
    ----------
    identity : str
        Text that differs for maps of different content.
    """

    def __init__(self, layers: Sequence[ElevationLayer]) -> None:
        self.layers = list(layers)
        self.identity = sha256(b"".join(layer.digest() for layer in self.layers)).hexdigest()[:16]

    def find_ground(self, latitude: Floats, longitude: Floats) -> Ground:
        """Return the ground at n positions."""
        weight, weighted = np.zeros(len(latitude)), np.zeros(len(latitude))
        for layer in self.layers:
            ground = layer.find_ground(latitude, longitude)
            known = ~np.isnan(ground.elevation)
            weight[known] += 1.0 / ground.variance[known]
            weighted[known] += ground.elevation[known] / ground.variance[known]
        weight[weight == 0.0] = np.nan
        return Ground(weighted / weight, 1.0 / weight)


class MapLookup:
    """Look up the ground under the fixes of a fleet, and count the fixes that lie outside the map.

    Parameters
    ----------
    elevation_map : ElevationMap, optional
        Map; without one, nothing is looked up.

    Attributes
    ----------
    identity : str
        Identity of the map, empty without one.
    """

    def __init__(self, elevation_map: ElevationMap | None) -> None:
        self._map = elevation_map
        self.identity = elevation_map.identity if elevation_map else ""
        self._fixes = 0
        self._outside: Counter[str] = Counter()

    def find_ground(self, batch: Batch) -> Ground | None:
        """Return the ground under the fixes of a batch, None without a map."""
        if self._map is None:
            return None
        valid = (np.abs(batch.latitude) <= pi / 2) & (np.abs(batch.longitude) <= pi)  # False for NaN
        valid &= (np.abs(batch.latitude) >= NULL_ISLAND) | (np.abs(batch.longitude) >= NULL_ISLAND)
        latitude, longitude = (np.where(valid, each, np.nan) for each in (batch.latitude, batch.longitude))
        ground = self._map.find_ground(latitude, longitude)
        outside = valid & np.isnan(ground.elevation)
        self._fixes += int(valid.sum())
        if outside.any():
            degrees = np.floor(np.degrees(np.stack([latitude[outside], longitude[outside]]))).astype(np.int64)
            tiles, counts = np.unique(degrees, axis=1, return_counts=True)
            self._outside.update(
                {name_tile(*tile): count for tile, count in zip(tiles.T.tolist(), counts.tolist(), strict=True)}
            )
        return ground

    def count_fixes(self) -> dict[str, Any]:
        """Return the numbers of fixes and of fixes outside the map, under `elevation_map`; nothing without a map."""
        if self._map is None:
            return {}
        by_tile = dict(sorted(self._outside.items()))
        counts = {"fixes": self._fixes, "outside": self._outside.total(), "outside_by_tile": by_tile}
        return {"elevation_map": counts}

    def dump(self) -> Any:
        """Return the identity of the map and the counters as plain values."""
        return [self.identity, self._fixes, dict(self._outside)]

    def load(self, state: Any) -> bool:
        """Replace the counters by those that `dump` returned; return whether they come from another map."""
        identity, self._fixes, outside = state
        self._outside = Counter(outside)
        return bool(identity != self.identity)


def name_tile(south: int, west: int) -> str:
    """Return the name of the tile of one degree with a south-western corner, as SRTM names its files.

    Units: south [deg], west [deg].

    Examples
    --------
    >>> name_tile(45, -74), name_tile(-1, 7)
    ('N45W074', 'S01E007')
    """
    return f"{'N' if south >= 0 else 'S'}{abs(south):02d}{'E' if west >= 0 else 'W'}{abs(west):03d}"
