"""Guess from the words of a column in which rows a car is parked, and in which it charges."""

import re
from collections.abc import Sequence
from typing import Final

_PARKED: Final = re.compile(
    r"p|park(ed|ing)?|asleep|sleep(ing)?|offline|off|inactive|suspended|standby|stopped|standstill|idle|completed?"
    r"|plugged(in)?|chargecomplete"
)
_CHARGES: Final = re.compile(r"(ac|dc|fast|quick|super|starting)?charg(e|ing)(ac|dc)?")
_DRIVES: Final = re.compile(
    r"[drnb]|driv(e|ing)|reverse|neutral|(in)?motion|moving|trip|ride|online|on|active|awake|ready|running"
)


def find_parked(words: Sequence[str]) -> tuple[str, ...]:
    """Return the words of a column for a parked or charging car, none where other words are not known.

    Examples
    --------
    >>> find_parked(["Driving", "Parked", "Charging (AC)"]), find_parked(["Parked", "blue"])
    (('Parked', 'Charging (AC)'), ())
    """
    if not all(_matches(word, _PARKED, _CHARGES, _DRIVES) for word in words):
        return ()
    return tuple(word for word in words if _matches(word, _PARKED, _CHARGES))


def find_charging(words: Sequence[str]) -> tuple[str, ...]:
    """Return the words of a column for a charging car."""
    return tuple(word for word in words if _matches(word, _CHARGES))


def _matches(word: str, *patterns: re.Pattern[str]) -> bool:
    """Return whether the letters of a word match one of some patterns."""
    letters = "".join(letter for letter in word.lower() if letter.isalpha())
    return any(pattern.fullmatch(letters) for pattern in patterns)
