"""Name in a key the vehicle, station, model or finding that a message is about."""

import re
from collections.abc import Callable
from operator import attrgetter
from typing import Any, Final

from socast.core.wire.messages import OF_VEHICLES, Finding, ModelErrors, Weather, Wire


def identify_model(model: str) -> str:
    """Return name and version of a model as chunks of a key, with all other characters replaced.

    >>> identify_model("hybrid interactions/2")
    'hybrid_interactions/2'
    """
    name, _, version = model.rpartition("/")
    return join_chunks(name, version)


def join_chunks(*names: str) -> str:
    """Return names as chunks of a key, with all characters replaced that a name on the wire does not have.

    >>> join_chunks("depot north", "tyre_pressure")
    'depot_north/tyre_pressure'
    """
    return "/".join(re.sub(r"[^A-Za-z0-9_.-]", "_", name)[:64] or "_" for name in names)


def identity(value: Wire) -> str:
    """Return the vehicle, station, model or finding that a message is about, as its key names it."""
    named = _NAMES.get(type(value))
    if named is None:
        raise TypeError(f"{type(value).__name__} does not travel by itself")
    return named(value)


_NAMES: Final[dict[type[Wire], Callable[[Any], str]]] = {
    **dict.fromkeys(OF_VEHICLES.values(), attrgetter("vehicle_id")),
    Weather: attrgetter("station_id"),
    ModelErrors: lambda errors: identify_model(errors.model),
    Finding: lambda finding: join_chunks(finding.who, finding.effect),
}
"""Struct -> function that returns the identity in a message."""
