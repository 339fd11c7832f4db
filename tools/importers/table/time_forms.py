"""Derive the forms of `strptime` that a text in which somebody wrote a time may have."""

import re
from collections.abc import Iterator, Sequence
from itertools import permutations
from typing import Final

from socast.tools.importers.table.month_names import find_month

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
