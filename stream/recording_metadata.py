"""The metadata record of a recording: what wrote it, with which settings.

It holds nothing that depends on the machine or on the time of day, so that the same command gives the same bytes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import cache
from typing import Any, Final

import msgspec

INVENTED: Final = "invented"
"""Entry `dates` in the settings of a recording whose dates are invented."""


@cache
def find_version() -> str:
    """Return the version of socast."""
    from importlib.metadata import version  # noqa: PLC0415 - takes 40 ms to import

    return version("socast")


def make_metadata(
    command: str,
    *,
    prefix: str = "",
    models: Sequence[str] = (),
    settings: Mapping[str, Any] | None = None,
) -> dict[str, str]:
    """Return the entries of the metadata record; what is not given has no entry.

    Examples
    --------
    >>> make_metadata("simulate", settings={"seed": 7})
    {'command': 'simulate', 'settings': '{"seed":7}'}
    """
    entries = {
        "command": command,
        "prefix": prefix.strip("/"),
        "model": "".join(models[:1]),
        "shadows": ",".join(models[1:]),
        "settings": msgspec.json.encode(settings).decode() if settings else "",
    }
    return {name: text for name, text in entries.items() if text}


def list_changed_settings(value: Any, usual: Any) -> dict[str, Any]:
    """Return the fields of a record that differ from the usual ones; of a field that is a record, only its changes.

    Examples
    --------
    >>> from socast.core.settings import Settings
    >>> list_changed_settings(Settings(window=5), Settings())
    {'window': 5}
    """
    changes: dict[str, Any] = {}
    for name in _list_fields(value):
        now, before = getattr(value, name), getattr(usual, name)
        if now != before:
            changes[name] = (
                list_changed_settings(now, before) if _list_fields(now) and type(now) is type(before) else now
            )
    return changes


def _list_fields(value: Any) -> tuple[str, ...]:
    """Return the names of the fields of a record; none for anything else."""
    if is_dataclass(value):
        return tuple(each.name for each in fields(value))
    return tuple(getattr(value, "_fields", ()))
