"""Fields of a message: how each is declared once, with unit, meaning and live display.

The columns of the terminal, of the workbench and of its frames, the newest values that a state keeps, and the tables of
the reference are derived from the declaration in `socast.core.wire.messages`.
"""

import re
from functools import cache
from typing import Any, Final, NamedTuple, get_type_hints

import msgspec

_UNIT: Final = re.compile(r"(.*) \[([^][]+)\]", re.DOTALL)


class TerminalHead(NamedTuple):
    """Declare a column of the table of cars in a terminal.

    Parameters
    ----------
    head : str
        Heading, with the unit.
    digits : int
        Number of decimals.
    wide : bool
        Whether only a wide terminal has room for it.
    """

    head: str
    digits: int = 0
    wide: bool = False


class Packing(NamedTuple):
    """Declare how a frame of the workbench holds a field.

    Parameters
    ----------
    dtype : str
        Type of the number.
    step : float
        Value of one unit of the number.
    bounds : bool
        Whether the percentiles of an interval are packed beside its mean.
    """

    dtype: str
    step: float = 1.0
    bounds: bool = False


class LiveDisplay(NamedTuple):
    """Declare how live displays show a field.

    Parameters
    ----------
    title : str
        Head of its column in the workbench, empty for none.
    label : str
        Its name on the page of a car, empty where the page does not list it.
    digits : int
        Number of decimals in the workbench.
    narrow : bool
        Whether a narrow window shows the column, too.
    of_shift : bool
        Whether it tells of the rest of a shift, and is unknown once the shift is over.
    packing, terminal : None where neither frames nor the terminal have it.
    """

    title: str = ""
    label: str = ""
    digits: int = 0
    narrow: bool = False
    of_shift: bool = False
    packing: Packing | None = None
    terminal: TerminalHead | None = None


class LiveField(NamedTuple):
    """Describe a declared field of a message: a number, or an interval with its 5th and 95th percentile."""

    name: str
    unit: str
    is_interval: bool
    display: LiveDisplay

    @property
    def columns(self) -> tuple[str, ...]:
        """Return the names of its values: the number, or mean and percentiles."""
        return list_interval_columns(self.name) if self.is_interval else (self.name,)


def means(meaning: str, display: LiveDisplay | None = None) -> msgspec.Meta:
    """Return the declaration of a field: its meaning with the unit in brackets, and its live display, if it has one."""
    return msgspec.Meta(description=meaning, extra={"live": display} if display else None)


def list_interval_columns(name: str) -> tuple[str, str, str]:
    """Return the names of the columns of an interval: mean, 5th and 95th percentile."""
    return name, f"{name}_p05", f"{name}_p95"


def split_unit(meaning: str) -> tuple[str, str]:
    """Return a meaning without its unit, and the unit; empty for none, `1` for a pure number.

    Examples
    --------
    >>> split_unit("Ground speed. [km/h]"), split_unit("Identity of the driver.")
    (('Ground speed.', 'km/h'), ('Identity of the driver.', ''))
    """
    found = _UNIT.fullmatch(meaning)
    return (found[1], found[2]) if found else (meaning, "")


@cache
def list_live_fields(struct: type[msgspec.Struct]) -> tuple[LiveField, ...]:
    """Return the fields of a message that have a live display, in their order."""
    hints, plain = get_type_hints(struct, include_extras=True), get_type_hints(struct)
    out = []
    for name in struct.__struct_fields__:
        for note in getattr(hints[name], "__metadata__", ()):
            if isinstance(note, msgspec.Meta) and note.extra and "live" in note.extra:
                unit = split_unit(note.description or "")[1]
                out.append(LiveField(name, unit, find_struct(plain[name]) is not None, note.extra["live"]))
    return tuple(out)


def find_struct(kind: Any) -> type[msgspec.Struct] | None:
    """Return the struct that a field holds, if any, by the type of the field."""
    options = getattr(kind, "__args__", (kind,))
    structs = [each for each in options if isinstance(each, type) and issubclass(each, msgspec.Struct)]
    return structs[0] if structs else None
