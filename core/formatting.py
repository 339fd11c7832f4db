"""Format numbers for people: rounded to their uncertainty, in everyday units, with a minus sign in tables."""

import re
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from math import floor, isfinite, log10
from types import MappingProxyType
from typing import Final

from socast.core.columns import KMH, ZERO_CELSIUS

_EVERYDAY: Final[Mapping[str, Callable[[float], str]]] = MappingProxyType(
    {
        "1": lambda value: f"{value:g}",
        "K": lambda value: f"{value - ZERO_CELSIUS:.4g} °C",
        "s": lambda value: f"{value / 60:.3g} min" if value >= 120 else f"{value:.3g} s",
        "m": lambda value: f"{value * 1000:.3g} mm" if value < 0.1 else f"{value:.3g} m",
        "m/s": lambda value: f"{value / KMH:.3g} km/h",
    }
)
SDS_95: Final = 1.96
"""Half of a 95 % interval over the standard deviation, of a normal distribution. [1]"""
_MINUS: Final = re.compile(r"(?<!\w)-(?=[\d.])")
_RANGE: Final = re.compile(r"^(\d+)-(\d+)$")
_SIGNED_ZERO: Final = re.compile(r"(?<![\w.])[-+](?=0(?:\.0*)?(?![\d.,eE]))")


def everyday(value: float, unit: str) -> str:
    """Return a quantity as text in its everyday unit.

    Examples
    --------
    >>> everyday(293.15, "K"), everyday(600.0, "s"), everyday(0.0003, "m"), everyday(0.9, "1"), everyday(3.0, "N")
    ('20 °C', '10 min', '0.3 mm', '0.9', '3 N')
    """
    say = _EVERYDAY.get(unit)
    return f"{value:.4g} {unit}" if say is None else say(value)


def rounded(value: float, half: float | None = None) -> str:
    """Return a number as text, rounded to its uncertainty, or to two digits without one.

    Examples
    --------
    >>> rounded(1.1349, 0.23), rounded(1.1349, 0.012), rounded(147.2, 23.0), rounded(0.0123), rounded(1234.5)
    ('1.1 ± 0.2', '1.135 ± 0.012', '150 ± 20', '0.012', '1200')
    """
    if half is None or not isfinite(half) or half <= 0.0:
        return _to(value, 2, abs(value))
    digits = 1 if half / 10.0 ** floor(log10(half)) >= 1.95 else 2
    return f"{_to(value, digits, half)} ± {_to(half, digits, half)}"


def format_count(count: int, noun: str, plural: str = "") -> str:
    """Return a number of things, with the singular after 1.

    Examples
    --------
    >>> format_count(1, "ride"), format_count(0, "ride"), format_count(1200, "ride"), format_count(2, "has", "have")
    ('1 ride', '0 rides', '1,200 rides', '2 have')
    """
    return f"{count:,} {noun if count == 1 else plural or f'{noun}s'}"


def format_time(time: float, timespec: str = "seconds") -> str:
    """Return a Unix time as ISO 8601 in UTC, for logs and files.

    Examples
    --------
    >>> format_time(1.7e9), format_time(1.7e9 + 0.25, "milliseconds")
    ('2023-11-14T22:13:20Z', '2023-11-14T22:13:20.250Z')
    """
    return datetime.fromtimestamp(time, UTC).isoformat(timespec=timespec).replace("+00:00", "Z")


def format_minus(text: str) -> str:
    """Return text whose negative numbers have the minus sign − (U+2212), as tables and figures show them.

    A number that is rounded to zero has no sign. JSON, logs and error messages keep the hyphen. So do exponents, ranges
    and names.

    Examples
    --------
    >>> format_minus("taxi-003: -0.5 (-1.2e-07 to 0.2)")
    'taxi-003: −0.5 (−1.2e-07 to 0.2)'
    >>> format_minus("-0.000 (+0.0 %), -0.001")
    '0.000 (0.0 %), −0.001'
    """
    return _MINUS.sub("−", _SIGNED_ZERO.sub("", text))


def format_range(text: str) -> str:
    """Return the name of a range for tables and figures: "0-5" as "0 to 5", and with minus signs.

    Parameters
    ----------
    text : str
        Name of a bin. A name that is no range of two numbers keeps its words.

    Examples
    --------
    >>> format_range("0-5"), format_range("-10 to -5"), format_range("taxi-003"), format_range("30+")
    ('0 to 5', '−10 to −5', 'taxi-003', '30+')
    """
    return format_minus(_RANGE.sub(r"\1 to \2", text))


def _to(value: float, digits: int, scale: float) -> str:
    """Return a number rounded to the decimal place at which `scale` has `digits` digits."""
    if not isfinite(value) or scale == 0.0:
        return f"{value:g}"
    places = digits - 1 - floor(log10(scale))
    return f"{round(value, places):.{max(places, 0)}f}"


def word_since(since: str, interval: tuple[str, str]) -> str:
    """Return the ISO date of a change in words, with the interval of it; years are told once.

    Examples
    --------
    >>> word_since("2018-11-14", ("2018-11-12", "2018-11-16"))
    'since 14 November 2018 (12 to 16 November)'
    >>> word_since("2018-11-14", ("2018-11-14", "2018-11-14"))
    'since 14 November 2018'
    """
    day, low, high = (datetime.fromisoformat(each) for each in (since, *interval))
    if low == high:
        return f"since {word_date(since)}"
    first = f"{low.day}" if (low.year, low.month) == (high.year, high.month) else _word_day(low, high)
    return f"since {word_date(since)} ({first} to {_word_day(high, day)})"


def _word_day(day: datetime, beside: datetime) -> str:
    """Return a date in words, without its year where that of another date is the same."""
    return f"{day.day} {day:%B}" + (f" {day.year}" if beside.year != day.year else "")


def word_date(text: str) -> str:
    """Return the day of an ISO date or time in words.

    Examples
    --------
    >>> word_date("2018-11-03")
    '3 November 2018'
    """
    day = datetime.fromisoformat(text)
    return f"{day.day} {day:%B %Y}"


def format_half_width(sd: float | None, digits: int) -> str:
    """Return half of the 95 % interval of a number by its standard deviation, as text behind it; empty if unknown.

    Examples
    --------
    >>> format_half_width(0.5, 1), format_half_width(None, 1)
    (' ± 1.0', '')
    """
    return "" if sd is None or not isfinite(sd) else f" ± {SDS_95 * sd:.{digits}f}"
