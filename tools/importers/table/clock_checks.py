"""Check the clocks of imported files: whether files lie on top of each other, and rows are later than their file."""

from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Final

from core.errors import ImportFileError
from tools.importers.table.agreement import Check, check_agreement
from tools.importers.table.agreement_sums import CarSums
from tools.importers.table.column_map import GUESSED_ORIGIN, ColumnMap
from tools.importers.table.row_reader import RowReader
from tools.importers.table.table_file import TableFile
from tools.importers.table.time_overlaps import Overlap

CLOCK_TOLERANCE: Final = 300.0
"""Time by which a row may be later than the last change of its file. [s]"""
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
    """Refuse files whose clocks all start at one origin, and which cover the same time of one car.

    Parameters
    ----------
    reader : RowReader
        Reader that has read all files.
    columns : ColumnMap
        The map.

    Raises
    ------
    ImportFileError
        If they do.
    """
    overlap = reader.spans.find_overlap()
    if overlap is None or overlap.files < 2 or not columns.time.is_relative:
        return
    raise ImportFileError(
        f"{_describe_overlap(overlap, reader)}, because their clocks all start at one origin; where their names hold "
        'the start, give [time] of the map origin_from_file_name = "ride_%Y-%m-%d_%H%M%S", else import each file with '
        "an origin of its own"
    )


def list_checks(
    tables: Sequence[TableFile], columns: ColumnMap, reader: RowReader, cars: list[CarSums], last: float
) -> list[Check]:
    """Return all checks of an import; where times are covered twice, others that need their order are not judged.

    Parameters
    ----------
    tables : sequence of TableFile
        The files.
    columns : ColumnMap
        The map.
    reader : RowReader
        Reader that has read them.
    cars : list of CarSums
        Sums of each car.
    last : float
        Time of the last row. [Unix s]
    """
    checks = check_agreement(cars)
    overlap = reader.spans.find_overlap()
    if overlap is not None:
        checks = [_suspend(check) if check.passed is False else check for check in checks]
        checks.insert(0, _check_overlap(overlap, reader))
    return [*checks, _check_clock(tables, columns, last)]


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
        f"{overlap.files} files cover the same {span} of {car}"
        if overlap.files > 1
        else f"one file covers {span} of {car} twice"
    )
    return f"{what}, first at {datetime.fromtimestamp(overlap.start, UTC):%Y-%m-%d %H:%M:%S} UTC"


def _check_overlap(overlap: Overlap, reader: RowReader) -> Check:
    """Return the check that no time is covered twice, which has failed."""
    if overlap.files > 1:
        remedy = "leave out files that are given twice, or give each car a name of its own in [vehicle]"
    else:
        remedy = "its clock steps back: set zone in [time] where it is local time, or divide the file"
    return Check(OVERLAP, _describe_overlap(overlap, reader), "each time once", False, remedy)


def _suspend(check: Check) -> Check:
    """Return a check that is not judged, because the rows may be in a wrong order."""
    return check._replace(passed=None, found=f"{check.found}, not judged while times are covered twice", remedy="")


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
