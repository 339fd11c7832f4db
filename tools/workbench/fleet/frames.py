"""Binary frames of the newest values of all cars: one encoding that all browsers share.

A frame holds the number of cars, the epoch, a sequence number and the newest time, and then one column after another,
each little-endian and quantised: the value of a car is its number times `scale`, unknown where the number is `missing`.
The names of the columns are sent once as JSON. A frame never refers to an earlier one, so that a slow browser may skip
any.
"""

import struct
from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from socast.core.wire.live_fields import LiveDisplay, list_live_fields
from socast.core.wire.messages import Forecast
from socast.tools.workbench.fleet.board import Board

HEAD: Final = struct.Struct("<IIQd")
"""Number of cars, epoch, sequence number, and newest time of the fleet [Unix s]; 24 bytes."""
RIDING, CHARGING, SILENT, OVER = 1, 2, 4, 8
OF_SHIFT: Final = tuple(
    column for field in list_live_fields(Forecast) if field.display.of_shift for column in field.columns
)
"""Columns about the rest of a shift, unknown once it is over."""


class FrameColumn(NamedTuple):
    """Describe a column of a frame.

    Parameters
    ----------
    scale : float
        Value of one unit of the number.
    display : LiveDisplay
        How pages show the column.
    is_interval : bool
        Whether it is the mean of an interval.
    """

    name: str
    dtype: str
    scale: float = 1.0
    unit: str = ""
    display: LiveDisplay = LiveDisplay()
    is_interval: bool = False

    @property
    def missing(self) -> int | None:
        """Number that stands for an unknown value; None for floats, where NaN does."""
        if self.dtype == "f4":
            return None
        return int(np.iinfo(self.dtype).min if self.dtype[0] == "i" else np.iinfo(self.dtype).max)

    def quantise(self, values: NDArray[np.float64]) -> bytes:
        """Return the numbers of a column as bytes; values beyond the range become its ends."""
        missing = self.missing
        if missing is None:
            return values.astype("<f4").tobytes()
        limits = np.iinfo(self.dtype)
        low, high = (limits.min + 1, limits.max) if self.dtype[0] == "i" else (0, limits.max - 1)
        known = np.isfinite(values)
        number = np.clip(np.rint(np.where(known, values, 0.0) / self.scale), low, high)
        return np.where(known, number, missing).astype(f"<{self.dtype}").tobytes()


def _list_columns() -> Iterator[FrameColumn]:
    """Yield the columns of a frame: places, the declared fields of a forecast, and states."""
    yield from (FrameColumn("latitude", "f4"), FrameColumn("longitude", "f4"), FrameColumn("age", "u2"))
    for field in list_live_fields(Forecast):
        if (packing := field.display.packing) is not None:
            mean, *bounds = field.columns
            unit = "" if field.unit == "1" else field.unit
            yield FrameColumn(mean, packing.dtype, packing.step, unit, field.display, field.is_interval)
            yield from (FrameColumn(name, packing.dtype, packing.step) for name in bounds if packing.bounds)
    yield FrameColumn("speed", "u1", 1.0, "km/h", LiveDisplay("Speed"))
    yield from (FrameColumn("faults", "u1", display=LiveDisplay("Faults")), FrameColumn("flags", "u1"))


COLUMNS: Final = tuple(sorted(_list_columns(), key=lambda each: np.dtype(each.dtype).itemsize, reverse=True))
"""Columns of a frame, the widest first, so that each begins at a multiple of its width."""


def describe_frames() -> dict[str, Any]:
    """Return the columns of a frame, and how pages show them, as a JSON record."""
    columns = [
        {
            "name": each.name,
            "dtype": each.dtype,
            "scale": each.scale,
            "missing": each.missing,
            "unit": each.unit,
            "isInterval": each.is_interval,
            "title": each.display.title,
            "label": each.display.label,
            "digits": each.display.digits,
            "narrow": each.display.narrow,
        }
        for each in COLUMNS
    ]
    flags = {"riding": RIDING, "charging": CHARGING, "silent": SILENT, "over": OVER}
    return {"head": HEAD.size, "columns": columns, "flags": flags}


def encode_frame(board: Board, sequence: int) -> bytes:
    """Return the newest values of all cars as a frame."""
    with board.lock:
        flags = RIDING * (board.column("riding") > 0.0) + CHARGING * (board.column("charging") > 0.0)
        is_over = board.find_over()
        derived = {"age": board.get_ages(), "flags": flags + SILENT * board.find_silent() + OVER * is_over}
        derived |= {name: np.where(is_over, np.nan, board.column(name)) for name in OF_SHIFT}
        parts = [
            each.quantise(derived[each.name] if each.name in derived else board.column(each.name)) for each in COLUMNS
        ]
        return HEAD.pack(len(board), board.epoch, sequence, board.newest) + b"".join(parts)
