"""Describe the clock of a table: its columns, its unit or format, its zone, and where it starts."""

import re
from collections.abc import Mapping
from datetime import tzinfo
from typing import Final, NamedTuple

TIME_UNITS: Final[Mapping[str, float]] = {
    "s": 1.0,
    "ms": 1e-3,
    "us": 1e-6,
    "ns": 1e-9,
    "min": 60.0,
    "h": 3600.0,
    "d": 86400.0,
    "excel": 86400.0,
}
"""Unit of a time in numbers -> seconds. Days of `excel` count from 30 December 1899 in local time."""
_TIME_UNIT: Final = re.compile(rf"(?:(\d+(?:\.\d+)?) ?)?({'|'.join(TIME_UNITS)})")
"""Unit of a time in numbers, perhaps several of them, such as `10 ms`."""
SERIAL: Final = "excel"
FIRST_EPOCH: Final = 946684800.0
LAST_EPOCH: Final = 4102444800.0
"""1 January 2000 and 2100, between which the times of rows lie. [Unix s]"""
MOST_WEEKS: Final = 4096
"""Largest number of weeks by which times are moved."""
GUESSED_ORIGIN: Final = "2000-01-01T00:00:00"
"""Time of the number 0 in a guessed map, which a person must correct."""


class TimeSource(NamedTuple):
    """Describe the clock of a table.

    Parameters
    ----------
    columns : tuple of str
        Column of the time, or those of date and time of day, which are joined by a space.
    unit_s : float, optional
        Unit of a time in numbers; None for a time in text. [s]
    form : str, optional
        Format of a time in text as of `strptime`; None is ISO 8601.
    zone : tzinfo
        Time zone of a time without one.
    origin : float
        Unix time of the number 0. [s]
    day_from_file_name : bool
        Whether the table holds times of day, and the name of its file the day.
    origin_form : str, optional
        Form of the time of the number 0 in the name of the file, as of `strptime`.
    offset_column : str, optional
        Column whose cells state the offset of the local times from UTC, as an offset or at the end of a time.
    add_weeks : int
        Weeks by which all times are moved, as for a receiver whose count of weeks starts again.
    is_serial : bool
        Whether numbers are days of a spreadsheet, in local time.
    gap_s : float, optional
        Time from the last row of a file to the number 0 of the next one, where the files follow each other at invented
        dates. [s]
    origin_column : str, optional
        Column whose first time in a file is that of the first row, for numbers that count from 0 in each file. `form`
        is then the format of this column.
    """

    columns: tuple[str, ...]
    unit_s: float | None
    form: str | None
    zone: tzinfo
    origin: float
    day_from_file_name: bool = False
    origin_form: str | None = None
    offset_column: str | None = None
    add_weeks: int = 0
    is_serial: bool = False
    gap_s: float | None = None
    origin_column: str | None = None

    @property
    def is_relative(self) -> bool:
        """Whether numbers count from a start that the map gives for all files alike."""
        return self.unit_s is not None and self.origin != 0.0


def find_time_unit(text: str) -> float | None:
    """Return a unit of numbers that are times, None for no such unit. [s]

    Examples
    --------
    >>> find_time_unit("ms"), find_time_unit("10 ms"), find_time_unit("weeks")
    (0.001, 0.01, None)
    """
    found = _TIME_UNIT.fullmatch(text)
    return float(found[1] or 1.0) * TIME_UNITS[found[2]] if found else None
