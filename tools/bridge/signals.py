"""Signals of other ecosystems: which field of a sample each one gives, in which unit and with which sign.

The presets of `socast import` say it; the same signals come from files there and live here.
"""

from collections.abc import Mapping
from typing import Final, NamedTuple

from socast.tools.importers.table.presets import get_preset
from socast.tools.importers.table.units import Conversion, find_conversion

FIX: Final = "fix"
"""Whether the receiver of positions has a fix; no field of a sample, but positions without one are left out."""
TRUE: Final = frozenset({"yes", "true", "on", "1"})
"""Words for true, in small letters."""
FALSE: Final = frozenset({"no", "false", "off", "0"})
"""Words for false, in small letters."""
FLAGS: Final = frozenset({"charging", FIX})
"""Fields that are true or false."""


class Signal(NamedTuple):
    """Describe the source of a field.

    Parameters
    ----------
    conversion : Conversion
        From the unit and the sign of the source to those of the wire contract.
    rank : int
        A source with a lower rank is preferred where several give the same field.
    """

    field: str
    conversion: Conversion = Conversion(1.0)
    rank: int = 0


def make_signal(field: str, unit: str, *, sign: int = 1, rank: int = 0) -> Signal:
    """Return a signal whose unit and sign are converted to those of the wire contract."""
    if field in FLAGS:
        return Signal(field, rank=rank)
    conversion = find_conversion(unit, field)
    return Signal(field, Conversion(sign * conversion.factor, sign * conversion.offset), rank)


def read_signals(preset: str) -> dict[str, Signal]:
    """Return the signals of an ecosystem as the preset for its exports describes them, with slashes for dots.

    Examples
    --------
    >>> read_signals("ovms")["v/p/gpsspeed"]
    Signal(field='speed_kmh', conversion=Conversion(factor=1.0, offset=0.0), rank=1)
    """
    return {
        (place.column or "").replace(".", "/"): make_signal(field, place.unit or "", sign=place.sign or 1, rank=rank)
        for field, places in get_preset(preset).fields.items()
        for rank, place in enumerate(places)
    }


def parse_number(signal: Signal, value: object) -> float | None:
    """Return a value in the unit of the wire contract; None if it is not a value of the signal.

    Examples
    --------
    >>> parse_number(make_signal("battery_current_a", "A", sign=-1), "12.5")
    -12.5
    >>> parse_number(make_signal("charging", ""), "yes"), parse_number(make_signal("soc_pct", "%"), "nan")
    (1.0, None)
    """
    if isinstance(value, str):
        word = value.strip().lower()
        if signal.field in FLAGS:
            return 1.0 if word in TRUE else 0.0 if word in FALSE else None
        try:
            value = float(word)
        except ValueError:
            return None
    if isinstance(value, bool) != (signal.field in FLAGS) or not isinstance(value, int | float):
        return None
    try:
        number = float(value) * signal.conversion.factor + signal.conversion.offset
    except OverflowError:
        return None
    return number if abs(number) < LARGEST else None


LARGEST: Final = 1e12
"""Largest value of a signal; larger ones, infinity and NaN are no values."""
Signals = Mapping[str, Signal]
"""Name of a signal in its ecosystem -> what it gives."""
