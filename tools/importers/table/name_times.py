"""Read days and starts of clocks from the names of files."""

import re
from collections.abc import Sequence
from datetime import datetime, tzinfo
from functools import cache
from pathlib import Path
from typing import Final

from core.errors import ImportFileError

DAY_IN_NAME: Final = re.compile(r"(20\d\d)[-_.]?(0[1-9]|1[0-2])[-_.]?(0[1-9]|[12]\d|3[01])")
"""Year, month and day in the name of a file."""
_DIRECTIVES: Final = {
    "Y": r"\d{4}",
    "y": r"\d{2}",
    "m": r"\d{1,2}",
    "d": r"\d{1,2}",
    "j": r"\d{3}",
    "b": r"[^\W\d_]{3}",
    "B": r"[^\W\d_]{3,9}",
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
_DAY_AND_TIME: Final = re.compile(
    r"(20\d\d)([-_.]?)(0[1-9]|1[0-2])(\2)(0[1-9]|[12]\d|3[01])([-_. T]{0,3})"
    r"([01]\d|2[0-3])([-_.:h]?)([0-5]\d)(?:([-_.:m]?)([0-5]\d))?(?!\d)"
)
"""Day and time of day in the name of a file, from years to seconds."""


def find_day(path: Path) -> str:
    """Return the day that the name of a file holds, such as `2024-05-01`.

    Parameters
    ----------
    path : Path
        The file.

    Raises
    ------
    ImportFileError
        If its name holds none.
    """
    found = DAY_IN_NAME.search(path.name)
    if not found:
        raise ImportFileError(
            f"{path}: its name holds no day such as 2024-05-01, which day_from_file_name needs; "
            "rename the file, or set origin in [time]"
        )
    return "-".join(found.groups())


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

    Parameters
    ----------
    path : Path
        The file.
    form : str
        Form of the start as of `strptime`, anywhere in the name.
    zone : tzinfo
        Time zone of a start without one.

    Raises
    ------
    ImportFileError
        If the name does not have this form.

    Examples
    --------
    >>> from zoneinfo import ZoneInfo
    >>> find_origin(Path("ride_2024-05-01_080000.csv.gz"), "ride_%Y-%m-%d_%H%M%S", ZoneInfo("UTC"))
    1714550400.0
    """
    found = _compile(form).search(path.name)
    try:
        start = datetime.strptime(found[0], form) if found else None  # noqa: DTZ007 - the zone is added below
    except (ValueError, re.error):  # a day that does not exist, or a directive given twice
        start = None
    if start is None:
        raise ImportFileError(
            f"{path}: its name has not the form '{form}' of origin_from_file_name; rename the file, or correct [time]"
        )
    return (start if start.tzinfo else start.replace(tzinfo=zone)).timestamp()


def guess_name_form(paths: Sequence[Path]) -> str | None:
    """Return the form of a day and a time of day in the names of all files, None where one of them holds none.

    Parameters
    ----------
    paths : sequence of Path
        The files.

    Examples
    --------
    >>> guess_name_form([Path("ride_2024-05-01_080000.csv.gz")]), guess_name_form([Path("TripA01.csv")])
    ('%Y-%m-%d_%H%M%S', None)
    """
    found = _DAY_AND_TIME.search(paths[0].name)
    if not found:
        return None
    _, dash, _, _, _, between, _, colon, _, last, seconds = found.groups()
    form = f"%Y{dash}%m{dash}%d{between}%H{colon}%M" + (f"{last}%S" if seconds else "")
    is_in_all = all(_DAY_AND_TIME.search(path.name) and _compile(form).search(path.name) for path in paths)
    return form if is_in_all else None


@cache
def _compile(form: str) -> re.Pattern[str]:
    """Return the pattern of the texts that a form of `strptime` reads."""
    parts = re.split(r"%(.)", form)
    texts = [_DIRECTIVES[part] if at % 2 else re.escape(part) for at, part in enumerate(parts)]
    return re.compile("".join(texts))
