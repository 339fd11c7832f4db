"""Derive the forms of `strptime` that a text may have, and read times by them, with months in any language."""

import re
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from itertools import permutations
from typing import Any, Final, NamedTuple
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from socast.core.batch import Floats
from socast.tools.importers.table.cells import encode_words
from socast.tools.importers.table.time_words import find_month, find_offset

_CLOCK: Final = re.compile(
    r"(?<!\d)(?P<H>\d{1,2})(?P<first>\s?[:hH]\s?)(?P<M>\d\d)"
    r"(?:(?P<second>\s?[:mM]\s?)(?P<S>\d\d)(?:(?P<mark>[.,:])(?P<f>\d{1,9}))?)?"
    r"(?P<gap>\s?)(?P<p>[AaPp]\.?\s?[Mm]\b\.?)?(?!\d)"
)
"""Time of day with colons, or with h and m."""
_POINTED: Final = re.compile(r"(?<=[\sT_,])(?P<H>\d\d)(?P<first>[.-])(?P<M>\d\d)(?P<second>[.-])(?P<S>\d\d)(?!\d)")
"""Time of day with points or dashes, after a date."""
_ZONE: Final = re.compile(r"(?:UTC|GMT)?[+-]\d{1,2}(?::?\d\d)?(?!\d)|[A-Z]{1,5}(?=\s|$)")
"""Zone after a time of day."""
_FILLERS: Final = frozenset(
    "t de del of um at kl klo a uhr den le el la em as alle ore om uur o i godz v d".split()  # noqa: SIM905
)
"""Words between the parts of a date that stay as they are."""
_TOKEN: Final = re.compile(r"\d+(?:st|nd|rd|th|er|º|ª)?|[^\W\d_]+\.?|[\W_]+")
_COMPACT: Final = re.compile(
    r"(?P<Y>20\d\d)(?:0\d|1[0-2])(?:[0-2]\d|3[01])(?P<T>[T _-]?)"
    r"(?:[01]\d|2[0-3])[0-5]\d(?P<S>[0-5]\d)?(?P<f>\.\d{1,9})?"
)
"""Date and time of day in digits without marks."""
_LAST_OF_ALPHABETS: Final = "\u2e80"
"""Letter before those that are words of their own, such as those for year, month and day."""
MOST_SHAPES: Final = 6
"""Shapes of texts from which forms are derived."""
_GROUPS: Final[Mapping[str, str]] = {
    "Y": r"\d{4}",
    "y": r"\d{2}",
    "m": r"\d{1,2}",
    "d": r"\d{1,2}",
    "b": r"\p{L}+\.?",
    "H": r"\d{1,2}",
    "I": r"\d{1,2}",
    "M": r"\d{1,2}",
    "S": r"\d{1,2}",
    "f": r"\d{1,9}",
    "p": r"[AaPp]\.?\s?[Mm]\.?|上午|下午|午前|午後|오전|오후",
    "z": r"(?:UTC|GMT)?[+-]\d{1,2}(?::?\d\d)?|[A-Z]{1,5}",
}
"""Directive -> the text that it stands for, as RE2 reads it."""
_SAME: Final = {"B": "b", "Z": "z"}
_ORDINAL: Final = r"(?:st|nd|rd|th|er|º|ª)?"
_AFTERNOON: Final = ("p", "下", "午後", "오후")
ISO_OFFSET: Final = r"\d[Tt ]\d.*(?:Z|[+-]\d\d:?(?:\d\d)?)$"
_STATED: Final = (
    r"(?:\d[^+-]*|^)(?P<zone>(?:UTC|GMT)[+-]\d{1,2}(?::?\d\d)?|[+-]\d\d:?\d\d|\bZ|\b[A-Z]{3,5})"
    r"(?:\s+\d{4}|\s*\([^)]*\))?\s*$"
)
"""Offset at the end of a time, or before a year at its end."""
MOST_WORDS: Final = 100
"""Different offsets that a column may state in a block."""


def list_forms(texts: Sequence[str]) -> list[str]:
    """Return the forms that texts may have, those of day before month first.

    Examples
    --------
    >>> list_forms(["05-ago.-2024 18:57:56.000"]), list_forms(["Mon Aug 05 18:57:56 GMT+01:00 2024"])
    (['%d-%b-%Y %H:%M:%S.%f'], ['%a %b %d %H:%M:%S %Z %Y'])
    >>> list_forms(["06/05/2024 2:03 PM"])
    ['%d/%m/%Y %I:%M %p', '%m/%d/%Y %I:%M %p']
    """
    shapes: dict[str, str] = {}
    for text in texts:
        shapes.setdefault(re.sub(r"\d", "0", text), text)
        if len(shapes) == MOST_SHAPES:
            break
    return list(dict.fromkeys(form for text in shapes.values() for form in _list_forms_of(text)))


def _list_forms_of(text: str) -> Iterator[str]:
    """Yield the forms that a text may have."""
    plain = re.sub(r"\s", " ", text.strip())
    if found := _COMPACT.fullmatch(plain):
        yield f"%Y%m%d{found['T']}%H%M{'%S' if found['S'] else ''}{'.%f' if found['f'] else ''}"
        return
    clock = _CLOCK.search(plain) or _POINTED.search(plain)
    if clock is None:
        return
    before, after = plain[: clock.start()], plain[clock.end() :]
    form = _write_clock(clock)
    if zone := _ZONE.match(after.lstrip()):
        form += after[: len(after) - len(after.lstrip())] + "%Z"
        after = re.sub(r"^\s*\([^)]*\)", "", after.lstrip()[zone.end() :])
    for head, tail in _write_dates(before, after):
        yield head + form + tail


def _write_clock(clock: re.Match[str]) -> str:
    """Return the form of a time of day."""
    found = clock.groupdict()
    is_half_day = found.get("p") is not None
    form = f"{'%I' if is_half_day else '%H'}{found['first']}%M"
    if found.get("S"):
        form += f"{found['second']}%S" + (f"{found['mark']}%f" if found.get("f") else "")
    return form + (f"{found['gap']}%p" if is_half_day else found.get("gap") or "")


def _write_dates(before: str, after: str) -> Iterator[tuple[str, str]]:
    """Yield the forms of what stands before and after the time of day."""
    tokens = [*_TOKEN.findall(before), "\0", *_TOKEN.findall(after)]
    numbers = [at for at, token in enumerate(tokens) if token[0].isdigit()]
    words = [at for at, token in enumerate(tokens) if token[0].isalpha()]
    months = [at for at in words if find_month(tokens[at]) is not None and len(tokens[at].strip(".")) > 1]
    month = months[-1] if months and months[-1] != 0 else months[0] if months else None
    if months and len(months) > 1 and months[0] == 0:
        month = months[1]
    for places in _list_orders([tokens[at] for at in numbers], month is not None):
        parts = list(tokens)
        for at, directive in zip(numbers, places, strict=True):
            parts[at] = directive
        for at in words:
            plain = tokens[at].strip(".").lower()
            if at == month:  # the pattern of a month reads its point
                parts[at] = "%b"
            elif plain not in _FILLERS and not (len(plain) == 1 and plain > _LAST_OF_ALPHABETS):
                parts[at] = "%a"
        head, _, tail = "".join(parts).partition("\0")
        yield head, tail


def _list_orders(numbers: Sequence[str], has_month: bool) -> Iterator[tuple[str, ...]]:
    """Yield the directives that the numbers of a date may have, in the order of the text."""
    lengths = [len(re.sub(r"\D", "", number)) for number in numbers]
    if lengths == [8] and not has_month:
        yield from [("%Y%m%d",)] if numbers[0].startswith(("19", "20")) else [("%d%m%Y",), ("%m%d%Y",)]
    elif lengths == [6] and not has_month:
        yield from [("%y%m%d",), ("%d%m%y",), ("%m%d%y",)]
    wanted = 2 if has_month else 3
    if len(numbers) != wanted or any(length > 2 and length != 4 for length in lengths) or lengths.count(4) > 1:
        return
    kinds = ["%d", *([] if has_month else ["%m"])]
    year = "%Y" if 4 in lengths else "%y"
    for order in permutations([*kinds, year]):
        if year == "%Y" and order.index("%Y") != lengths.index(4):
            continue
        if not has_month and (order[1] == year or (order[0] == year and order[1] == "%d")):
            continue
        yield order


Stamps = NDArray[np.datetime64]


class ParsedTimes(NamedTuple):
    """Hold times that were read from texts.

    Parameters
    ----------
    stamps : (n,) datetime64
        Date and time as the text writes it, NaT where it cannot be read.
    offsets : (n,) float64
        Offset from UTC that the text states, NaN where it states none. [s]
    """

    stamps: Stamps
    offsets: Floats


def to_unix(stamps: Any) -> Floats:
    """Return dates as Unix times, as if they were UTC, NaN where unknown. [s]"""
    values = np.asarray(stamps).astype("datetime64[us]")
    return np.where(np.isnat(values), np.nan, values.astype("i8") / 1e6)


def parse_times(texts: pa.Array, form: str | None) -> ParsedTimes:
    """Return the times of texts."""
    pattern = None if form is None else _compile(form)
    if pattern is None:
        return _parse_by_pandas(texts, form)
    plain = pc.replace_substring_regex(texts, r"[\x{00a0}\x{202f}]", " ")
    if form is not None and "(" not in form and "z" in pattern.groups:  # the name of a zone beside its offset
        plain = pc.replace_substring_regex(plain, r"\s*\([^)]*\)$", "")
    found = pc.extract_regex(plain, pattern.text)
    parts = {name: pc.struct_field(found, name) for name in pattern.groups}
    offsets = _look_up(parts["z"], find_offset) if "z" in parts else np.full(len(texts), np.nan)
    return ParsedTimes(_assemble(parts, len(texts)), offsets)


class _Pattern(NamedTuple):
    """Hold a form as a pattern, and the directives that it holds."""

    text: str
    groups: tuple[str, ...]


@cache
def _compile(form: str) -> _Pattern | None:
    """Return the pattern of a form, None where it holds a directive that only pandas reads, or one twice."""
    parts = re.split(r"%(.)", form)
    groups: list[str] = []
    text = r"^\s*"
    for at, part in enumerate(parts):
        if at % 2 == 0:
            text += "".join(_escape(letter) for letter in re.sub(r"\s+", " ", part))
        elif part in {"a", "A"}:
            text += r"\p{L}+\.?"
        elif part == "%":
            text += "%"
        else:
            name = _SAME.get(part, part)
            if name not in _GROUPS or name in groups:
                return None
            groups.append(name)
            if name == "f" and text.endswith((r"\.", ",")):  # programs leave out a fraction of zero
                mark, text = text[-1], text.removesuffix(r"\.").removesuffix(",")
                text += rf"(?:[{mark}](?P<f>{_GROUPS[name]}))?"
            else:
                text += f"(?P<{name}>{_GROUPS[name]}){_ORDINAL if name == 'd' else ''}"
    return _Pattern(text + r"\s*$", tuple(groups)) if groups else None


def _escape(letter: str) -> str:
    """Return a letter of a form as RE2 reads it; months may be followed by a point."""
    if letter == " ":
        return r"\s+"
    return letter if letter.isalnum() or letter in "_," or ord(letter) > 127 else f"\\{letter}"


def _parse_by_pandas(texts: pa.Array, form: str | None) -> ParsedTimes:
    """Return the times of texts in ISO 8601, or in a form with rare directives."""
    series: Any = texts.to_pandas()
    stamps, offsets = np.full(len(series), "NaT", "datetime64[us]"), np.full(len(series), np.nan)
    if not len(series):
        return ParsedTimes(stamps, offsets)
    if form is None:
        zoned = pc.match_substring_regex(texts, ISO_OFFSET)
    else:
        zoned = pa.array(["%z" in form or "%Z" in form] * len(series))
    with_offset = np.asarray(pc.fill_null(zoned, False).to_numpy(zero_copy_only=False), bool)
    for chosen, is_utc in ((with_offset, True), (~with_offset, False)):
        if chosen.any():
            parsed = pd.to_datetime(series[chosen], format=form or "ISO8601", errors="coerce", utc=is_utc)
            plain = parsed.dt.tz_localize(None) if is_utc else parsed
            stamps[chosen] = plain.to_numpy().astype("datetime64[us]")
    offsets[with_offset] = 0.0
    return ParsedTimes(stamps, offsets)


def _assemble(parts: Mapping[str, Any], count: int) -> Stamps:
    """Return the date and time that the parts of texts give."""

    def take(name: str, usual: float) -> Floats:
        if name not in parts:
            return np.full(count, usual)
        cells = pc.if_else(pc.equal(parts[name], ""), None, parts[name])
        return np.asarray(pc.cast(cells, pa.float64()).to_numpy(zero_copy_only=False), "f8")

    year, month, day = take("Y", 1900.0), take("m", 1.0), take("d", 1.0)
    if "y" in parts:
        short = take("y", 0.0)
        year = short + np.where(short < 69, 2000.0, 1900.0)
    if "b" in parts:
        month = _look_up(parts["b"], find_month)
    hour, minute, second = take("H", 0.0), take("M", 0.0), take("S", 0.0)
    if "I" in parts:
        hour = take("I", 0.0)
        valid = (hour >= 1) & (hour <= 12)
        hour = np.where(valid, hour % 12 + 12 * _look_up(parts["p"], _is_afternoon), np.nan) if "p" in parts else hour
    micros = np.zeros(count)
    if "f" in parts:
        padded = pc.utf8_slice_codeunits(pc.utf8_rpad(parts["f"], 6, "0"), 0, 6)
        micros = np.asarray(pc.cast(padded, pa.float64()).to_numpy(zero_copy_only=False), "f8")
    fits = (month >= 1) & (month <= 12) & (day >= 1) & (hour < 24) & (minute < 60) & (second < 61) & np.isfinite(year)
    months = (np.where(fits, (year - 1970) * 12 + month - 1, 0)).astype("i8").astype("datetime64[M]")
    days = months.astype("datetime64[D]") + np.where(fits, day - 1, 0).astype("i8")
    fits &= days.astype("datetime64[M]") == months
    rest = np.where(fits, ((hour * 60 + minute) * 60 + second) * 1e6 + micros, 0.0)
    stamps: Stamps = days.astype("datetime64[us]") + np.nan_to_num(rest).astype("i8")
    stamps[~fits | np.isnan(rest)] = np.datetime64("NaT")
    return stamps


def _is_afternoon(text: str) -> float:
    """Return 1 for a word that means after noon, else 0."""
    return float(text.strip().lower().startswith(_AFTERNOON))


def _look_up(cells: Any, find: Any) -> Floats:
    """Return what a function makes of each text, NaN where it is None."""
    words, places = encode_words(cells)
    found = [*map(find, words), None]
    known: Floats = np.array([np.nan if each is None else float(each) for each in found])[places]
    return known


def read_offsets(cells: pa.Array, stamps: Stamps) -> Floats:
    """Return the offset from UTC that each cell states, NaN where it states none. [s]

    Parameters
    ----------
    stamps : (n,) datetime64
        Local time of each row, by which the offset of a named time zone follows.
    """
    texts = pc.utf8_trim_whitespace(pc.cast(cells, pa.string()))
    stated = pc.struct_field(pc.extract_regex(texts, _STATED), "zone")
    words, places = encode_words(pc.coalesce(stated, texts))
    if len(words) > MOST_WORDS:  # times without an offset
        return np.full(len(texts), np.nan)
    stated_offsets = [find_offset(word, is_offset=True) for word in words]
    values = np.array([np.nan if each is None else each for each in [*stated_offsets, None]])
    offsets: Floats = values[places]
    for place in np.flatnonzero(np.isnan(values[:-1])).tolist():
        if (zone := _find_zone(words[place])) is not None:
            chosen = places == place
            offsets[chosen] = _measure(stamps[chosen], zone)
    return offsets


def _find_zone(word: str) -> ZoneInfo | None:
    """Return the time zone of a name such as `Europe/Berlin`."""
    try:
        return ZoneInfo(word) if "/" in word else None
    except (ZoneInfoNotFoundError, ValueError, OSError):
        return None


def _measure(stamps: Stamps, zone: ZoneInfo) -> Floats:
    """Return the offsets of local times in a zone, NaN where the clock repeats or skips them. [s]"""
    local: Any = pd.Series(stamps).dt.tz_localize(zone, ambiguous="NaT", nonexistent="NaT")
    offsets: Floats = to_unix(stamps) - to_unix(local.dt.tz_convert("UTC").dt.tz_localize(None))
    return offsets
