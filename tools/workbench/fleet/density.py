"""Where a fleet has driven: counts of fixes on a grid."""

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any, Final

import msgspec

from core.wire.messages import Message

CELL_DEG: Final = 0.0005
"""Height and width of a cell of the finest grid. [deg]"""
MOST_CELLS: Final = 20_000
"""Number of cells above which the grid becomes coarser by two."""
MOST_READ: Final = 3_000_000
"""Largest number of messages of recordings that are read for the grid."""


class _Fix(msgspec.Struct):
    """Hold the position of a telemetry sample."""

    latitude_deg: float | None = None
    longitude_deg: float | None = None


def is_possible_fix(latitude: float | None, longitude: float | None) -> bool:
    """Return whether a position can be that of a car: known, on the map, and not the zero of a logger without a fix."""
    if latitude is None or longitude is None or not (-85.0 < latitude < 85.0 and -180.0 <= longitude <= 180.0):
        return False
    return abs(latitude) > 0.01 or abs(longitude) > 0.01


class TraceDensity:
    """Count fixes in cells of latitude and longitude.

    Attributes
    ----------
    cell : float
        Height and width of a cell. [deg]
    """

    def __init__(self) -> None:
        self.cell = CELL_DEG
        self._counts: Counter[tuple[int, int]] = Counter()
        self._is_complete = False

    def add(self, latitude: float, longitude: float) -> None:
        """Count a fix, unless `count_recordings` has counted all of them."""
        if not self._is_complete:
            self._count(latitude, longitude)

    def count_recordings(self, source: Iterable[Sequence[Message]]) -> None:
        """Count the fixes of recordings from beginning to end, and none that are added later."""
        decode, read = msgspec.json.Decoder(_Fix | list[_Fix]).decode, 0
        whole = TraceDensity()
        for messages in source:
            for key, payload, _ in messages:
                if key.endswith("/telemetry"):
                    try:
                        value = decode(payload)
                    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
                        continue
                    for fix in value if isinstance(value, list) else [value]:
                        if is_possible_fix(latitude := fix.latitude_deg, longitude := fix.longitude_deg):
                            whole.add(latitude or 0.0, longitude or 0.0)
            read += len(messages)
            if read > MOST_READ:
                break
        self._is_complete = True
        self._counts, self.cell = whole._counts, whole.cell

    def describe(self) -> dict[str, Any]:
        """Return the grid as a JSON record: `cell` [deg], and `y`, `x` and `count` of each cell."""
        cells = list(self._counts.items())
        return {
            "cell": self.cell,
            "y": [place[0] for place, _ in cells],
            "x": [place[1] for place, _ in cells],
            "count": [count for _, count in cells],
        }

    def _count(self, latitude: float, longitude: float) -> None:
        """Count a fix; a grid with too many cells becomes coarser."""
        self._counts[int(latitude // self.cell), int(longitude // self.cell)] += 1
        if len(self._counts) > MOST_CELLS:
            coarse: Counter[tuple[int, int]] = Counter()
            for (y, x), count in self._counts.items():
                coarse[y // 2, x // 2] += count
            self._counts, self.cell = coarse, 2.0 * self.cell
