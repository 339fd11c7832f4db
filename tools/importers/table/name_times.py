"""Read days and starts of clocks from the names of files."""

import re
import unicodedata
from collections.abc import Sequence
from datetime import UTC, date, datetime, tzinfo
from functools import cache
from pathlib import Path
from typing import Final, NamedTuple

from socast.core.errors import ImportFileError
from socast.tools.importers.table.month_names import find_month

_YEAR: Final = r"20\d\d"
_MONTH: Final = r"0[1-9]|1[0-2]|[^\W\d_]{3,10}\.?"
_DAY: Final = r"0[1-9]|[12]\d|3[01]"
_MARK: Final = r"[-_. ]?"
_DAYS_IN_NAME: Final = (
    re.compile(rf"(?<!\d)(?P<Y>{_YEAR})(?P<a>{_MARK})(?P<m>{_MONTH})(?P<b>{_MARK})(?P<d>{_DAY})(?!\d{{1,3}}(?!\d))"),
    re.compile(rf"(?<!\d)(?P<d>{_DAY})(?P<a>{_MARK})(?P<m>{_MONTH})(?P<b>{_MARK})(?P<Y>{_YEAR})(?!\d)"),
)
"""Year, month and day in the name of a file, in either order; the month as a number or by its name."""
_DIRECTIVES: Final = {
    "Y": r"\d{4}",
    "y": r"\d{2}",
    "m": r"\d{1,2}",
    "d": r"\d{1,2}",
    "j": r"\d{3}",
    "b": r"[^\W\d_]{3,10}\.?",
    "B": r"[^\W\d_]{3,10}\.?",
    "H": r"\d{1,2}",
    "I": r"\d{1,2}",
    "M": r"\d{2}",
    "S": r"\d{2}",
    "f": r"\d{1,6}",
    "p": r"[AaPp][Mm]",
    "z": r"(?:Z|[+-]\d\d:?\d\d)",
    "%": "%",
}
"""Directive of `strptime` that a form of names may hold -> the text that it stands for."""
_TIME_IN_NAME: Final = re.compile(
    r"([-_. T]{0,3}|, ?| at )([01]\d|2[0-3])([-_.:h]?)([0-5]\d)(?:([-_.:m]?)([0-5]\d))?(?!\d)"
)
"""Time of day that follows the day in the name of a file."""


class _NameDay(NamedTuple):
    """Hold a day in the name of a file, its form, and where it ends."""

    day: date
    form: str
    end: int


def _find_name_day(path: Path) -> _NameDay | None:
    """Return the day that the name of a file holds, None where it holds none."""
    name = unicodedata.normalize("NFC", path.name)
    for order, pattern in zip(("Ymd", "dmY"), _DAYS_IN_NAME, strict=True):
        for found in pattern.finditer(name):
            month = int(found["m"]) if found["m"].isdigit() else find_month(found["m"])
            try:
                day = date(int(found["Y"]), month or 0, int(found["d"]))
            except ValueError:
                continue
            parts = {"Y": "%Y", "m": "%m" if found["m"].isdigit() else "%b", "d": "%d"}
            form = parts[order[0]] + found["a"] + parts["m"] + found["b"] + parts[order[2]]
            return _NameDay(day, form, found.end())
    return None


def find_name_day(path: Path) -> date | None:
    """Return the day that the name of a file holds, None where it holds none.

    Examples
    --------
    >>> find_name_day(Path("trackLog-2024-ago-05_18-57-56.csv")), find_name_day(Path("TripA01.csv"))
    (datetime.date(2024, 8, 5), None)
    """
    found = _find_name_day(path)
    return found.day if found else None


def find_day(path: Path) -> str:
    """Return the day that the name of a file holds, such as `2024-05-01`."""
    found = find_name_day(path)
    if not found:
        raise ImportFileError(
            f"{path}: its name holds no day such as 2024-05-01, which day_from_file_name needs; "
            "rename the file, or set origin in [time]"
        )
    return found.isoformat()


def find_unknown_directive(form: str) -> str | None:
    """Return the first directive of a form that names cannot be read with, None where there is none.

    Examples
    --------
    >>> find_unknown_directive("ride_%Y-%m-%d_%H%M%S"), find_unknown_directive("%A"), find_unknown_directive("50%")
    (None, '%A', '%')
    """
    return next((f"%{each}" for each in re.findall(r"%(.?)", form) if each not in _DIRECTIVES), None)


def find_origin(path: Path, form: str, zone: tzinfo) -> float:
    """Return the start of a clock that the name of a file holds. [Unix s]

    Examples
    --------
    >>> from zoneinfo import ZoneInfo
    >>> find_origin(Path("ride_2024-05-01_080000.csv.gz"), "ride_%Y-%m-%d_%H%M%S", ZoneInfo("UTC"))
    1714550400.0
    """
    found = _compile(form).search(unicodedata.normalize("NFC", path.name))
    try:
        start = datetime.strptime(*_number_month(found, form)) if found else None  # noqa: DTZ007 - the zone is added below
    except (ValueError, re.error):  # a day that does not exist, or a directive given twice
        start = None
    if start is None:
        raise ImportFileError(
            f"{path}: its name has not the form '{form}' of origin_from_file_name; rename the file, or correct [time]"
        )
    return (start if start.tzinfo else start.replace(tzinfo=zone)).timestamp()


def guess_name_form(paths: Sequence[Path]) -> str | None:
    """Return the form of a day and a time of day in the names of all files, None where one of them holds none.

    Examples
    --------
    >>> guess_name_form([Path("ride_2024-05-01_080000.csv.gz")]), guess_name_form([Path("TripA01.csv")])
    ('%Y-%m-%d_%H%M%S', None)
    """
    forms = [_find_form(path) for path in paths]
    first = forms[0]
    fits = first is not None and all(form and _reads(first, path) for form, path in zip(forms, paths, strict=True))
    return first if fits else None


def _find_form(path: Path) -> str | None:
    """Return the form of the day and the time of day in the name of a file, None where it holds none."""
    day = _find_name_day(path)
    found = day and _TIME_IN_NAME.match(unicodedata.normalize("NFC", path.name), day.end)
    if not day or not found:
        return None
    between, _, colon, _, last, seconds = found.groups()
    return f"{day.form}{between}%H{colon}%M" + (f"{last}%S" if seconds else "")


def _reads(form: str, path: Path) -> bool:
    """Return whether a form reads the name of a file."""
    try:
        find_origin(path, form, UTC)
    except ImportFileError:
        return False
    return True


def _number_month(found: re.Match[str], form: str) -> tuple[str, str]:
    """Return a text with the number of its month for the name, and its form."""
    if found.re.groups == 0:
        return found[0], form
    start, end = found.span(1)
    whole = found[0][: start - found.start()] + f"{find_month(found[1]) or 0:02}" + found[0][end - found.start() :]
    return whole, re.sub("%[bB]", "%m", form)


@cache
def _compile(form: str) -> re.Pattern[str]:
    """Return the pattern of the texts that a form of `strptime` reads."""
    parts = re.split(r"%(.)", form)
    named = ("b", "B") if form.count("%b") + form.count("%B") == 1 else ()
    texts = [
        re.escape(part) if at % 2 == 0 else f"({_DIRECTIVES[part]})" if part in named else _DIRECTIVES[part]
        for at, part in enumerate(parts)
    ]
    return re.compile("".join(texts))
