"""Check the clocks of imported files: whether files lie on top of each other, and rows are later than their file."""

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import numpy as np

from socast.core.errors import ImportFileError
from socast.tools.importers.table.agreement import SUN, Check, check_agreement
from socast.tools.importers.table.agreement_sums import CarSums
from socast.tools.importers.table.clock_units import FAR, find_nearest, find_ratio
from socast.tools.importers.table.clock_witness import DAY, EARLIEST, ROLLOVER_WEEKS
from socast.tools.importers.table.column_map import ColumnMap
from socast.tools.importers.table.row_reader import RowReader
from socast.tools.importers.table.row_times import SECONDS_PER_WEEK
from socast.tools.importers.table.table_file import TableFile
from socast.tools.importers.table.time_overlaps import Overlap
from socast.tools.importers.table.time_source import GUESSED_ORIGIN, find_time_unit

CLOCK_TOLERANCE: Final = 300.0
"""Time by which a row may be later than the last change of its file. [s]"""
MOST_FILES: Final = 6
"""Number of files that a check names."""
UNIT: Final = "unit of the clock"
OVERLAP: Final = "times of rows"
"""Name of the check that no time is covered twice."""
_SPANS: Final = (
    (730.0 * 86400.0, 365.25 * 86400.0, "years"),
    (2.0 * 86400.0, 86400.0, "days"),
    (7200.0, 3600.0, "h"),
    (120.0, 60.0, "min"),
)
"""Time from which a unit is used, the unit, and its name. [s]"""


def refuse_overlap(reader: RowReader, columns: ColumnMap) -> None:
    """Refuse files whose clocks all start at one origin, and which cover the same time of one car."""
    overlap = reader.spans.find_overlap()
    if overlap is None or len(overlap.files) < 2 or not columns.time.is_relative:
        return
    raise ImportFileError(
        f"{_describe_overlap(overlap, reader)}, because their clocks all start at one origin; where their names hold "
        'the start, give [time] of the map origin_from_file_name = "ride_%Y-%m-%d_%H%M%S", else --sequence H invents '
        "dates"
    )


class ClockUnit:
    """Measure, by the first rows, whether the distance by speed has the size of that by odometer or positions."""

    def __init__(self, columns: ColumnMap) -> None:
        self._unit = columns.time.unit_s
        self._found: tuple[float | None, str] | None = None if columns.time.unit_s else (None, "")

    def add(self, rows: np.ndarray) -> None:
        """Add rows in the order of time; only the first ones count."""
        if self._found is None:
            self._found = find_ratio([rows])

    def check(self) -> Check | None:
        """Return the check of the unit, None where nothing shows it to be wrong."""
        ratio, witness = self._found or (None, "")
        if ratio is None or self._unit is None or abs(np.log(ratio)) < FAR:
            return None
        unit = find_nearest(ratio * self._unit)
        if abs(np.log(ratio * self._unit / (find_time_unit(unit) or 1.0))) > FAR:
            return None
        what = "the odometer" if witness == "odometer" else "positions"
        found = f"distance by speed is {1.0 / ratio:.3g} times that by {what}"
        return Check(
            UNIT, found, "as large", False, f"the clock probably counts in {unit}: set unit = '{unit}' in [time]"
        )


def list_checks(
    tables: Sequence[TableFile],
    columns: ColumnMap,
    reader: RowReader,
    cars: list[CarSums],
    span: tuple[float, float],
    faults: Sequence[Check | None] = (),
) -> list[Check]:
    """Return all checks of an import; where times are covered twice, others that need their order are not judged.

    Units: span [Unix s].

    Parameters
    ----------
    faults : sequence of Check
        What is wrong with the clock, the worst first; None where nothing is. Checks that need times are not judged.
    """
    is_assumed = reader.has_local_times and str(columns.time.zone) == "UTC"
    checks = check_agreement(cars, is_zone_assumed=is_assumed)
    if found := [fault for fault in faults if fault is not None]:
        why = "the unit of the clock is wrong" if found[0].name == UNIT else "the clock is wrong"
        checks = [found[0], *(_suspend(check, why) if check.passed is False else check for check in checks)]
    overlap = reader.spans.find_overlap()
    if overlap is not None:
        why = "times are covered twice"
        checks = [_suspend(check, why) if check.passed is False and check.name != SUN else check for check in checks]
        checks.insert(0, _check_overlap(overlap, reader))
    weeks = _check_weeks(tables, columns, span)
    return [*checks, *([weeks] if weeks else []), _check_clock(tables, columns, span[1])]


def describe_span(seconds: float) -> str:
    """Return a time in the largest unit in which it is at least two.

    Examples
    --------
    >>> describe_span(90.0), describe_span(9000.0), describe_span(500_000.0), describe_span(84e6)
    ('90 s', '2.5 h', '5.79 days', '2.66 years')
    """
    for least, unit, name in _SPANS:
        if seconds >= least:
            return f"{seconds / unit:.3g} {name}"
    return f"{seconds:.3g} s"


def _describe_overlap(overlap: Overlap, reader: RowReader) -> str:
    """Return what is covered twice, and where it begins."""
    span, car = describe_span(overlap.duration), reader.vehicles[overlap.vehicle]
    what = (
        f"{len(overlap.files)} files cover the same {span} of {car}: {_name_files(overlap.files)}"
        if len(overlap.files) > 1
        else f"one file covers {span} of {car} twice"
    )
    return f"{what}, first at {datetime.fromtimestamp(overlap.start, UTC):%Y-%m-%d %H:%M:%S} UTC"


def _name_files(files: Sequence[str]) -> str:
    """Return the first names of files, and how many follow."""
    more = f" and {len(files) - MOST_FILES} more" if len(files) > MOST_FILES else ""
    return f"{', '.join(Path(file).name for file in files[:MOST_FILES])}{more}"


def _check_overlap(overlap: Overlap, reader: RowReader) -> Check:
    """Return the check that no time is covered twice, which has failed."""
    if len(overlap.files) > 1:
        remedy = "leave out files that are given twice, or give each car a name of its own in [vehicle]"
    else:
        remedy = "its clock steps back: set zone in [time] where it is local time, or divide the file"
    return Check(OVERLAP, _describe_overlap(overlap, reader), "each time once", False, remedy)


def _suspend(check: Check, why: str) -> Check:
    """Return a check that is not judged, because of what is wrong with the times of the rows."""
    return check._replace(passed=None, found=f"{check.found}, not judged while {why}", remedy="")


def _check_weeks(tables: Sequence[TableFile], columns: ColumnMap, span: tuple[float, float]) -> Check | None:
    """Return a failed check where rows are so early that a count of GPS weeks may have started again, else None."""
    first, last = span
    moved = last + ROLLOVER_WEEKS * SECONDS_PER_WEEK
    if (
        columns.time.is_relative
        or last >= EARLIEST
        or moved > max(table.path.stat().st_mtime for table in tables) + DAY
    ):
        return None
    days = [f"{datetime.fromtimestamp(each, UTC):%Y-%m-%d}" for each in (first, last, moved)]
    remedy = f"if GPS weeks started again, it was {days[2]}: set add_weeks = {ROLLOVER_WEEKS} in [time]"
    return Check("clock against GPS weeks", f"rows from {days[0]} to {days[1]}", "from 2010 on", False, remedy)


def _check_clock(tables: Sequence[TableFile], columns: ColumnMap, last: float) -> Check:
    """Check that no row is later than the last change of the files, which a wrong zone or unit makes."""
    limit = f"at most {CLOCK_TOLERANCE:g} s after the files were written"
    name = "clock against file"
    if columns.time.is_relative and columns.time.origin == _to_unix(GUESSED_ORIGIN):
        return Check(name, f"the origin {GUESSED_ORIGIN[:10]} is a guess; correct it in [time]", limit, None)
    changed = max(table.path.stat().st_mtime for table in tables)
    late = last - changed
    found = f"last row {describe_span(abs(late))} {'after' if late > 0 else 'before'} the files were written"
    if late <= CLOCK_TOLERANCE:
        return Check(name, found, limit, True)
    return Check(name, found, limit, False, "set zone or unit in [time]")


def _to_unix(text: str) -> float:
    """Return the Unix time of a date in UTC. [s]"""
    return datetime.fromisoformat(text).replace(tzinfo=UTC).timestamp()
