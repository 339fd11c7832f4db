"""Routes that take and return JSON records: a path, a function, and whether it changes something."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from socast.core.errors import SocastError
from socast.tools.workbench.fleet.source import FleetSource
from socast.tools.workbench.fleet.tiles import TileFile
from socast.tools.workbench.jobs import Jobs


class NotFoundError(SocastError):
    """Report something that a path names and that does not exist."""


class JsonRequest(NamedTuple):
    """Hold what a page sends.

    Parameters
    ----------
    path : mapping of str to str
        Parts of the path that the route names in braces.
    body : mapping of str to Any
        JSON object of a POST; empty otherwise.
    """

    path: Mapping[str, str]
    parameters: Mapping[str, str]
    body: Mapping[str, Any]


@dataclass
class Workbench:
    """Hold what the routes use.

    Parameters
    ----------
    workspace : Any
        What was given on the command line.
    read_only : bool
        Whether requests that change something are refused.
    fleet : FleetSource, optional
        Player of recordings or observer of a live service; None without one.
    tiles : TileFile, optional
        Map beneath the fleet; None without one.
    time_zone : str
        Zone of the times on the pages; empty for that of the browser.
    """

    workspace: Any
    jobs: Jobs
    read_only: bool = False
    fleet: FleetSource | None = None
    tiles: TileFile | None = None
    time_zone: str = ""


Handler = Callable[[Workbench, JsonRequest], Any]
"""A function that returns a JSON record. It runs in a thread; a `SocastError` becomes one line for the page."""


class JsonRoute(NamedTuple):
    """Describe a route.

    Parameters
    ----------
    changes : bool
        Whether it changes something. It is then a POST, and `--read-only` refuses it; else it is a GET.
    """

    path: str
    handle: Handler
    changes: bool = False
