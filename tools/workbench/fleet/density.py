"""Where a fleet has driven: counts of fixes on a grid."""

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any, Final

import numpy as np

from socast.core.batch import Floats
from socast.core.wire.messages import Message
from socast.core.wire.sample_reader import read_samples

CELL_DEG: Final = 0.0005
"""Height and width of a cell of the finest grid. [deg]"""
MOST_CELLS: Final = 20_000
"""Number of cells above which the grid becomes coarser by two."""
MOST_READ: Final = 3_000_000
"""Number of samples of recordings after which no more are read for the grid."""


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

    def add(self, latitude: Floats, longitude: Floats) -> None:
        """Count fixes, unless `count_recordings` has counted all of them; a grid with too many cells becomes coarser.

        Units: latitude [deg], longitude [deg].
        """
        if self._is_complete or not len(latitude):
            return
        y, x = (np.floor_divide(place, self.cell).astype(np.int64).tolist() for place in (latitude, longitude))
        self._counts.update(zip(y, x, strict=True))
        while len(self._counts) > MOST_CELLS:
            coarse: Counter[tuple[int, int]] = Counter()
            for (row, column), count in self._counts.items():
                coarse[row // 2, column // 2] += count
            self._counts, self.cell = coarse, 2.0 * self.cell

    def count_recordings(self, source: Iterable[Sequence[Message]]) -> None:
        """Count the fixes of recordings from beginning to end, and none that are added later."""
        whole, read = TraceDensity(), 0
        for messages in source:
            for _, _, columns in read_samples(messages, Counter()):
                is_fix = columns.find_fixes()
                whole.add(columns.latitude[is_fix], columns.longitude[is_fix])
                read += len(is_fix)
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
