"""The words of clocks: units, offsets from UTC and months, the description of a clock, and times in names of files."""

import re
import unicodedata
from collections.abc import Mapping, Sequence
from datetime import UTC, date, datetime, tzinfo
from functools import cache
from pathlib import Path
from typing import Final, NamedTuple

from socast.core.errors import ImportFileError

LARGEST: Final = 14 * 3600
"""Largest offset of a time zone from UTC. [s]"""
_NAMED: Final[Mapping[str, float]] = {
    **dict.fromkeys(("Z", "UTC", "GMT", "WET", "UT"), 0.0),
    **dict.fromkeys(("CET", "MEZ", "WEST", "HNEC"), 1.0),
    **dict.fromkeys(("CEST", "MESZ", "EET", "SAST", "OEZ"), 2.0),
    **dict.fromkeys(("EEST", "MSK", "TRT", "OESZ"), 3.0),
    "ADT": -3.0,
    "EDT": -4.0,
    "EST": -5.0,
    "CDT": -5.0,
    "MDT": -6.0,
    "MST": -7.0,
    "PDT": -7.0,
    "PST": -8.0,
    "AKDT": -8.0,
    "AKST": -9.0,
    "HST": -10.0,
    "NST": -3.5,
    "NDT": -2.5,
    "HKT": 8.0,
    "AWST": 8.0,
    "KST": 9.0,
    "JST": 9.0,
    "ACST": 9.5,
    "AEST": 10.0,
    "ACDT": 10.5,
    "AEDT": 11.0,
    "NZST": 12.0,
    "NZDT": 13.0,
}
"""Abbreviation of a time zone -> offset from UTC [h], without those of several zones, such as CST, IST and BST."""
_OFFSET: Final = re.compile(r"(?:UTC|GMT)?\s*([+\-−])?(\d{1,2})(?::?([0-5]\d))?(?::[0-5]\d)?", re.IGNORECASE)
_STEMS: Final = (
    "jan gen ene ian jaan led sty tammi oca sau xan urt yan sij ιαν янв яну јан січ сту",
    "feb fev feu unor uno lut helmi sub febr vas veebr ots velj φεβ фев феб лют",
    "mar mrt marc maa maer brez bre maalis kov ozu μαρ мар бер сак",
    "apr avr abr avril dub kwi huhti nis bal ebr api trav tra απρ апр кві кра",
    "may mai maj mei mag kve touko maig geg svi μαι май маи мая мај тра",
    "jun juin giu cze cvn cervn cerven kesa haz iun juun xun birz eka lipanj lipnj ιουν июн юни јун чер чэр",
    "jul juil lug lip cvc cervenc cervenec heina tem iul juul liep xul uzt srpanj srpnj ιουλ июл юли јул лип ліп",
    "aug ago agost aou avg agu sie srp elo ogo rugp abu kolo αυγ авг сер жні",
    "sep set wrz zar syys szep rugs eyl ira ruj σεπ сен сеп вер",
    "oct okt ott out paz rij loka eki spal urr οκτ окт жов кас",
    "nov lis marras kas noi lapkr aza noy studen νοε ноя ное нов лис ліс",
    "dec dez dic des dek pro gru joulu ara det dis gruod abe δεκ дек дец гру сне",
)
"""First letters of the names of each month, without accents, in some thirty languages; the longest that fits counts."""
_SHORT: Final[Mapping[str, int]] = {"ag": 8, "kol": 8, "stu": 11}
"""Abbreviations that are no first letters of others."""
_DOUBTFUL: Final[Mapping[str, str]] = {
    "lip": "July in Polish, June in Croatian",
    "srp": "August in Czech, July in Croatian",
    "lis": "November in Polish and Czech, October in Croatian",
}
"""First letters of names that mean two months: what they are read as, and what else they mean."""
_LETTERS: Final = str.maketrans({"ł": "l", "ø": "o", "ß": "ss", "ı": "i", "đ": "d", "æ": "ae"})
_LONGEST: Final = 14
"""Letters of the longest name of a month."""
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


@cache
def find_offset(text: str, *, is_offset: bool = False) -> float | None:
    """Return the offset from UTC that a text states, None where it states none. [s]

    Parameters
    ----------
    is_offset : bool
        Whether the text is known to be an offset, so that a number is one: of hours, minutes, or seconds.

    Examples
    --------
    >>> [find_offset(text) for text in ("GMT+01:00", "-0330", "CEST", "CST", "Z", "7200")]
    [3600.0, -12600.0, 7200.0, None, 0.0, None]
    >>> [find_offset(text, is_offset=True) for text in ("2", "-120", "7200", "5.5")]
    [7200.0, -7200.0, 7200.0, 19800.0]
    """
    plain = text.strip().strip("()")
    if plain.upper() in _NAMED:
        return _NAMED[plain.upper()] * 3600.0
    if is_offset and re.fullmatch(r"[+-]?\d+(\.\d+)?", plain) and not re.fullmatch(r"[+-]\d{4}", plain):
        number = float(plain)
        scale = next((unit for most, unit in ((14.0, 3600.0), (840.0, 60.0)) if abs(number) <= most), 1.0)
        seconds = number * scale
    else:
        found = _OFFSET.fullmatch(plain)
        if not found or (found[1] is None and not (is_offset and found[3])):
            return None
        seconds = (-1.0 if found[1] in {"-", "−"} else 1.0) * (int(found[2]) * 3600.0 + int(found[3] or 0) * 60.0)
    return seconds if abs(seconds) <= LARGEST else None


def spell_offset(seconds: float) -> str:
    """Return an offset from UTC as text.

    Examples
    --------
    >>> spell_offset(7200.0), spell_offset(-12600.0)
    ('+02:00', '-03:30')
    """
    minutes = round(abs(seconds) / 60.0)
    return f"{'-' if seconds < 0 else '+'}{minutes // 60:02}:{minutes % 60:02}"


@cache
def find_month(word: str) -> int | None:
    """Return the number of the month that a word names, None where it names none.

    Examples
    --------
    >>> [find_month(word) for word in ("ago.", "Mär", "DÉC.", "août", "červenec", "lunes")]
    [8, 3, 12, 8, 7, None]
    """
    plain = fold_word(word)
    if plain in _SHORT or len(plain) > _LONGEST:
        return _SHORT.get(plain)
    fits = [
        (len(stem), month)
        for month, stems in enumerate(_STEMS, start=1)
        for stem in stems.split()
        if plain.startswith(stem)
    ]
    return max(fits)[1] if fits else None


def describe_doubt(word: str) -> str:
    """Return what a month means in two languages, empty where it means the same in all.

    Examples
    --------
    >>> describe_doubt("lis."), describe_doubt("lug")
    ('November in Polish and Czech, October in Croatian', '')
    """
    plain = fold_word(word)
    return _DOUBTFUL.get(plain[:3], "") if plain in {*_DOUBTFUL, "listopad", "listopada"} else ""


def fold_word(word: str) -> str:
    """Return a word in small letters, without accents and points.

    Examples
    --------
    >>> fold_word("Févr.")
    'fevr'
    """
    apart = unicodedata.normalize("NFKD", word.casefold().translate(_LETTERS))
    return "".join(letter for letter in apart if letter.isalpha())


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
