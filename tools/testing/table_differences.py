"""The one comparison of tables: which rows and fields of a found table differ from an expected one, and by how much."""

from collections.abc import Collection, Hashable, Sequence
from math import isnan, nan
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from socast.core.batch import Floats
from socast.core.errors import SettingsError, suggest_names
from socast.core.formatting import format_count
from socast.tools.testing.tolerances import DEFAULT, Tolerance, Tolerances, resolve_tolerances

KEYS: Final = (("vehicle_id", "time_s"), ("vehicle_id", "start_s"), ("counter",))
"""Columns that name a row of a table of forecasts, of rides and of counters."""
TIME_DIGITS: Final = 3
"""Decimals of a time [s] in which rows of two tables agree that are compared."""
Row: TypeAlias = tuple[Hashable, ...]


class ValueDifference(NamedTuple):
    """Hold a value that differs.

    Parameters
    ----------
    time : float
        Time of the row, NaN where tables have none. [Unix s]
    allowed : float
        Largest difference that would be none; NaN for values that are no numbers.
    """

    time: float
    expected: Any
    found: Any
    allowed: float

    @property
    def size(self) -> float:
        """Found less expected value, NaN for others than numbers."""
        if isnan(self.allowed) or self.expected is None or self.found is None:
            return nan
        return float(self.found) - float(self.expected)


class FieldDifference(NamedTuple):
    """Hold how a field differs in the rows of one subject, such as a car.

    Parameters
    ----------
    subject, field : str
        Car, or what names the row where tables have none, and name of the column.
    differing, compared : int
        Rows in which it differs, and that were compared.
    first, largest : ValueDifference
        The first difference, and that of the largest size; they are the same for others than numbers.
    """

    subject: str
    field: str
    differing: int
    compared: int
    first: ValueDifference
    largest: ValueDifference


class TableComparison(NamedTuple):
    """Hold how a table differs from an expected one.

    Parameters
    ----------
    rows : str
        What a row is, such as `forecast`.
    missing, additional : dict of str to tuple
        Number of rows of each subject that were expected and not found, and found and not expected, and the time of
        the first. [Unix s]
    differences : tuple of FieldDifference
        Fields that differ, by the time at which they first do.
    """

    rows: str
    compared: int
    missing: dict[str, tuple[int, float]]
    additional: dict[str, tuple[int, float]]
    differences: tuple[FieldDifference, ...]

    @property
    def is_equal(self) -> bool:
        """Whether nothing differs."""
        return not (self.missing or self.additional or self.differences)

    def describe(self) -> str:
        """Return in one line how many rows were compared, and what differs."""
        if self.is_equal:
            return f"{format_count(self.compared, self.rows)} as expected"
        parts = [
            f"{format_count(sum(number for number, _ in rows.values()), self.rows)} {what}"
            for what, rows in (("missing", self.missing), ("not expected", self.additional))
            if rows
        ]
        if self.differences:
            fields = list(dict.fromkeys(each.field for each in self.differences))
            number = sum(each.differing for each in self.differences)
            named = ", ".join(fields[:3]) + (f" and {len(fields) - 3} more" if len(fields) > 3 else "")
            values = f"{format_count(number, 'value')} of {format_count(len(fields), 'field')}"
            parts.insert(0, f"{values} {'differs' if number == 1 else 'differ'} ({named})")
        return f"{'; '.join(parts)}; {format_count(self.compared, self.rows)} compared"


def compare_tables(
    expected: pd.DataFrame,
    found: pd.DataFrame,
    *,
    key: Sequence[str] = (),
    tolerances: Tolerances | None = None,
    rows: str = "row",
    known: Collection[str] = (),
) -> TableComparison:
    """Compare two tables row by row and field by field.

    Parameters
    ----------
    key : sequence of str
        Columns that name a row. By default those of `KEYS` that the tables have, else the names of their index, else
        the number of the row.
    tolerances : mapping, optional
        Largest difference of a field: a number in its unit, or a text such as `2 %`. A name such as `range_km` holds
        for all its parts. By default a number may differ by `ROUNDING`, and nothing else.
    """
    names = list(key) or find_key(expected, found)
    one, other = _name_rows(expected, names), _name_rows(found, names)
    fields = [name for name in dict.fromkeys([*one.columns, *other.columns]) if name not in names]
    allowed = resolve_tolerances(tolerances, fields, known)
    both = one.index.intersection(other.index, sort=False)
    subjects = [_find_subject(row, names) for row in both]
    times = np.array([_find_time(row, names) for row in both])
    compared = pd.Series(subjects, dtype=object).value_counts()
    found_in: list[FieldDifference] = []
    for field in fields:
        wanted, made = (table.reindex(columns=[field]).loc[both, field] for table in (one, other))
        found_in += _compare_column(field, wanted, made, allowed.get(field, DEFAULT), subjects, times, compared)
    found_in.sort(key=lambda each: (each.first.time, each.subject))
    return TableComparison(
        rows, len(both), _count(one.index, both, names), _count(other.index, both, names), tuple(found_in)
    )


def find_key(*tables: pd.DataFrame) -> list[str]:
    """Return the columns or levels of the index that name a row of tables; none where only its number does."""
    for names in KEYS:
        if all(set(names) <= {*table.columns, *table.index.names} for table in tables):
            return list(names)
    return [str(name) for name in tables[-1].index.names if name is not None]


def _name_rows(table: pd.DataFrame, names: Sequence[str]) -> pd.DataFrame:
    """Return a table whose index is its key, and the number of a row among those of the same key."""
    if levels := [name for name in table.index.names if name is not None]:
        table = table.reset_index(level=[name for name in levels if name not in table.columns])
    if missing := [name for name in names if name not in table.columns]:
        raise SettingsError(f"key {missing[0]!r}: there is no such column; {suggest_names(missing[0], table.columns)}")
    parts = [table[name].round(TIME_DIGITS) if table[name].dtype.kind == "f" else table[name] for name in names]
    frame = pd.concat(parts, axis=1) if parts else pd.DataFrame(index=table.index)
    number = frame.groupby(list(names), dropna=False).cumcount() if parts else pd.Series(range(len(table)), dtype=int)
    index = pd.MultiIndex.from_arrays([*(part.astype(object) for part in parts), number], names=[*names, None])
    return table.set_axis(index, axis=0)


def _find_subject(row: Row, names: Sequence[str]) -> str:
    """Return the car of a row, or what names it."""
    if "vehicle_id" in names:
        return str(row[list(names).index("vehicle_id")])
    return " ".join(map(str, row[:-1])) if names else f"row {row[-1]}"


def _find_time(row: Row, names: Sequence[str]) -> float:
    for name in ("time_s", "start_s"):
        if name in names:
            return float(str(row[list(names).index(name)]))
    return nan


def _count(rows: pd.Index, both: pd.Index, names: Sequence[str]) -> dict[str, tuple[int, float]]:
    """Return the number of rows of each subject that are not in both tables, and the time of the first."""
    absent: dict[str, tuple[int, float]] = {}
    for row in rows.difference(both, sort=False):
        subject, time = _find_subject(row, names), _find_time(row, names)
        number, first = absent.get(subject, (0, time))
        absent[subject] = number + 1, min(first, time)
    return absent


def _compare_column(
    field: str,
    expected: pd.Series,
    found: pd.Series,
    tolerance: Tolerance,
    subjects: Sequence[str],
    times: Floats,
    compared: pd.Series,
) -> list[FieldDifference]:
    """Return how a field differs, for each subject in whose rows it does."""
    differs, size, allowed = _find_differences(expected, found, tolerance)
    rows = np.flatnonzero(differs)
    rows = rows[np.argsort(times[rows], kind="stable")]
    of_subject: dict[str, list[int]] = {}
    for row in rows.tolist():
        of_subject.setdefault(subjects[row], []).append(row)

    def get_difference(row: int) -> ValueDifference:
        values = _get_value(expected, row), _get_value(found, row)
        return ValueDifference(float(times[row]), *values, float(allowed[row]))

    return [
        FieldDifference(
            subject,
            field,
            len(its),
            int(compared[subject]),
            get_difference(its[0]),
            get_difference(its[int(np.nan_to_num(size[its], nan=-1.0).argmax())]),
        )
        for subject, its in of_subject.items()
    ]


def _find_differences(
    expected: pd.Series, found: pd.Series, tolerance: Tolerance
) -> tuple[NDArray[np.bool_], Floats, Floats]:
    """Return where values differ, the absolute differences of numbers, and the allowed ones."""
    if _is_number(expected) and _is_number(found):
        one, other = (pd.to_numeric(each).to_numpy(np.float64, na_value=nan) for each in (expected, found))
        allowed = tolerance.absolute + tolerance.relative * np.abs(one)
        with np.errstate(invalid="ignore"):
            size = np.abs(other - one)
        unknown = np.isnan(one), np.isnan(other)
        agrees = (
            (np.isfinite(size) & (size <= allowed))
            | (one == other)
            | (unknown[0] & unknown[1])
            | np.isinf(tolerance.absolute)
        )
        return ~agrees, size, np.where(np.isnan(allowed), tolerance.absolute, allowed)
    different = [a != b for a, b in zip(_make_plain(expected), _make_plain(found), strict=True)]
    none = np.full(len(different), nan)
    return np.array(different, dtype=bool) & (not np.isinf(tolerance.absolute)), none, none


def _is_number(column: pd.Series) -> bool:
    """Return whether a column holds numbers only, or nothing that is known."""
    is_number = pd.api.types.is_numeric_dtype(column) and not pd.api.types.is_bool_dtype(column)
    return bool(is_number or column.isna().all())


def _make_plain(column: pd.Series) -> list[Any]:
    """Return values, with None for what is unknown; a file of text does not distinguish it from an empty text."""
    unknown = column.isna() | (column == "")
    return [None if is_unknown else value for value, is_unknown in zip(column, unknown, strict=True)]


def _get_value(column: pd.Series, row: int) -> Any:
    value = column.iloc[row]
    return None if pd.isna(value) else value.item() if isinstance(value, np.generic) else value
