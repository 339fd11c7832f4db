"""The time zone of the times that a person reads on a terminal; files and messages hold UTC."""

from datetime import UTC, datetime, tzinfo
from typing import Annotated, Final
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import typer
from rich.console import Console

from socast.core.errors import SettingsError

SYSTEM: Final = None
"""The zone of the system, which TZ names: `datetime.astimezone` takes None for it."""
TimeZone = Annotated[
    str | None,
    typer.Option(
        "--time-zone",
        metavar="ZONE",
        help="Time zone of the times shown, such as America/Montreal. [default: that of the system on a terminal, UTC "
        "elsewhere]",
    ),
]


def find_zone(name: str | None, console: Console) -> tzinfo | None:
    """Return the time zone of a name; without a name that of the system on a terminal, and UTC elsewhere."""
    if name is None:
        return SYSTEM if console.is_terminal else UTC
    return parse_zone(name)


def parse_zone(name: str) -> tzinfo:
    """Return the time zone of a name; `SettingsError` if there is no such zone."""
    try:
        return UTC if name == "UTC" else ZoneInfo(name)
    except (ZoneInfoNotFoundError, ValueError, OSError) as error:
        raise SettingsError(
            f"--time-zone is '{name}', which is no time zone; give one such as Europe/Berlin or UTC"
        ) from error


def format_local(time_s: float, form: str, zone: tzinfo | None) -> str:
    """Return a Unix time as text in a zone.

    Examples
    --------
    >>> format_local(1.7e9, "%H:%M", UTC), format_local(1.7e9, "%d %H:%M", ZoneInfo("Europe/Berlin"))
    ('22:13', '14 23:13')
    """
    return f"{datetime.fromtimestamp(time_s, UTC).astimezone(zone):{form}}"


def name_zone(times: list[float], zone: tzinfo | None) -> str:
    """Return the names that a zone has at some times, such as `EST`, or `EST, EDT` where the clock was changed.

    Examples
    --------
    >>> name_zone([1.7e9], UTC), name_zone([1.7e9, 1.69e9], ZoneInfo("Europe/Berlin"))
    ('UTC', 'CET, CEST')
    """
    return ", ".join(dict.fromkeys(format_local(each, "%Z", zone) for each in times or [0.0]))
