"""Read offsets from UTC: `+02:00`, `GMT+2`, numbers of hours, minutes or seconds, and abbreviations of one meaning."""

import re
from collections.abc import Mapping
from datetime import timedelta, timezone
from functools import cache
from typing import Final

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


def make_zone(seconds: float) -> timezone:
    """Return the time zone of an offset."""
    return timezone(timedelta(seconds=seconds))
