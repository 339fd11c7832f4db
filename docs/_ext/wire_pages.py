"""The fields of the messages, read from their structs."""  # noqa: INP001

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any, Final, Literal, get_args, get_origin, get_type_hints

import msgspec
from markdown_text import code, table

from socast.core.wire import messages
from socast.core.wire.live_fields import find_struct, split_unit
from socast.core.wire.messages import Interval, LegOutlook, Outlook, Wire

UNITS: Final = {"Unix s": "Unix s, UTC", "deg": "°", "degC": "°C", "m2": "m²", "W/m2": "W/m²"}
"""Unit of a declaration -> unit of the page."""

OF_OUTLOOK: Final = (Outlook, LegOutlook)
"""Structs that the page of the outlook query describes; the wire page describes all others."""


def generators() -> Mapping[str, Callable[[], str]]:
    """Return a generator of the table of each message and each part of one."""
    structs = [
        each
        for each in vars(messages).values()
        if isinstance(each, type) and issubclass(each, Wire) and each is not Wire
    ]
    return {f"wire/{each.__name__}": partial(fields, each) for each in structs}


def fields(struct: type[Wire]) -> str:
    """Return the table of the fields of a struct."""
    return table(["field", "unit", "meaning"], _rows(struct))


def _rows(struct: type[Wire]) -> Iterator[list[str]]:
    """Yield name, unit and meaning of each field."""
    declared, plain = get_type_hints(struct, include_extras=True), get_type_hints(struct)
    for name in struct.__struct_fields__:
        notes = [note for note in declared[name].__metadata__ if isinstance(note, msgspec.Meta) and note.description]
        meaning, unit = split_unit(notes[0].description or "")
        yield [code(name), _form(plain[name], UNITS.get(unit, unit), struct), meaning.removesuffix(".")]


def _form(kind: Any, unit: str, struct: type[Wire]) -> str:
    """Return what a field holds: a number in a unit, an interval, one of some words, or another struct."""
    options = [each for each in get_args(kind) or (kind,) if each is not type(None)]
    if get_origin(kind) is Literal:
        return ", ".join(map(code, get_args(kind)))
    if get_origin(kind) is list:
        return f"list of {_form(options[0], unit, struct)}"
    if (part := find_struct(kind)) is not None:
        page = "reference/wire.md" if struct in OF_OUTLOOK and part not in OF_OUTLOOK else ""
        link = f"[{part.__name__}]({page}#{part.__name__.lower()})"
        return f"{link}, {unit}" if part is Interval else link
    words = {str: "text", bool: "true, false", int: "1"}
    return unit or next((words[each] for each in options if each in words), "of the quantity")
