"""Raster tiles of a map, from a PMTiles file of the user."""

from pathlib import Path
from threading import Lock
from typing import Any, Final, NamedTuple

from pmtiles import reader
from pmtiles.tile import Compression, TileType

from socast.core.errors import SettingsError

_READER: Final[Any] = reader
_KINDS: Final = {
    TileType.PNG: "image/png",
    TileType.JPEG: "image/jpeg",
    TileType.WEBP: "image/webp",
    TileType.AVIF: "image/avif",
}


class TileRange(NamedTuple):
    """Hold the zoom levels of a map and who made it."""

    least_zoom: int
    most_zoom: int
    attribution: str


class TileFile:
    """Read tiles of a PMTiles file."""

    def __init__(self, path: Path) -> None:
        try:
            self._file = path.open("rb")
            self._reader: Any = _READER.Reader(_READER.MmapSource(self._file))
            header, about = self._reader.header(), self._reader.metadata()
        except OSError as error:
            raise SettingsError(f"{path} cannot be read: {error.strerror}; name a PMTiles file") from error
        except Exception as error:
            raise SettingsError(f"{path} is no PMTiles file: {type(error).__name__}; name another file") from error
        if header["tile_type"] not in _KINDS:
            raise SettingsError(
                f"{path} holds {header['tile_type'].name} tiles, and only raster tiles are drawn: "
                "give a PMTiles file with PNG, JPEG, WebP or AVIF tiles"
            )
        if header.get("tile_compression", Compression.NONE) not in {Compression.NONE, Compression.UNKNOWN}:
            raise SettingsError(f"{path} holds compressed raster tiles; make it without tile compression")
        self.kind = _KINDS[header["tile_type"]]
        attribution = about.get("attribution", "") if isinstance(about, dict) else ""
        self.range = TileRange(int(header["min_zoom"]), int(header["max_zoom"]), str(attribution)[:200])
        self._lock = Lock()

    def get(self, zoom: int, x: int, y: int) -> bytes | None:
        """Return a tile, None where the map has none."""
        if not (self.range.least_zoom <= zoom <= self.range.most_zoom and 0 <= x < 1 << zoom and 0 <= y < 1 << zoom):
            return None
        with self._lock:
            found = self._reader.get(zoom, x, y)
        return bytes(found) if found else None
