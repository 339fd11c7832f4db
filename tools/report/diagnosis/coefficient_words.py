"""Describe the coefficient of an effect: its value, interval, unit, and whether it is plausible."""

from typing import Final

from socast.core.diagnose.records import EstimatedCoefficient
from socast.core.formatting import format_minus

SUPERSCRIPTS: Final = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")


def format_unit(unit: str) -> str:
    """Return a unit as it is printed: `m^2` is m², and `1` is empty.

    Examples
    --------
    >>> format_unit("m^2"), format_unit("W/K"), format_unit("1"), format_unit("s^-1 / m**2")
    ('m²', 'W/K', '', 's⁻¹ / m²')
    """
    head, *rest = unit.replace("**", "^").split("^")
    words = head
    for part in rest:
        digits = len(part) - len(part.lstrip("-0123456789"))
        words += part[:digits].translate(SUPERSCRIPTS) + part[digits:]
    return "" if words == "1" else words


def describe_coefficient(coefficient: EstimatedCoefficient) -> str:
    """Return a coefficient, its interval, and whether it is plausible."""
    value, limits = coefficient.value, coefficient.ci95
    if value is None:
        return ""
    unit = f" {format_unit(coefficient.unit)}".rstrip()
    interval = f", 95 % interval {limits[0]:.3g} to {limits[1]:.3g}" if limits else ""
    low, high = coefficient.low, coefficient.high
    words = f"coefficient {value:.3g}{unit}{interval}"
    if low is not None and high is not None:
        expected = f"range {low:g} to {high:g}{unit}"
        if not coefficient.plausible:
            words += f"; NOT plausible ({expected}): it may stand for another cause"
        else:
            words += f"; {'plausible' if low <= value <= high else 'plausible within its interval'} ({expected})"
    return format_minus(words)
