"""`socast router`: run a Zenoh router that cars, consumers and those who ask join."""

import logging
from pathlib import Path
from typing import Annotated

import typer

from socast.stream.structured_log import event_fields, log_lines
from socast.stream.zenoh_session import LOOPBACK, Connection, Node
from socast.tools.terminal.stop_signals import stop_on_signals

_log = logging.getLogger("socast.router")


def route(
    listen: Annotated[
        list[str] | None, typer.Option(metavar="E", help=f"Listen at E; repeatable. [default: {LOOPBACK}]")
    ] = None,
    connect: Annotated[list[str] | None, typer.Option(metavar="E", help="Join the router at E; repeatable.")] = None,
    config: Annotated[
        Path | None, typer.Option(metavar="F.json5", help="Zenoh's own configuration, such as router.json5.")
    ] = None,
    json_log: Annotated[bool, typer.Option("--json-log", help="Log JSON instead of key=value.")] = False,
) -> None:
    """Run a Zenoh router in a process of its own, until SIGINT or SIGTERM.

    It does what `zenohd` does without plugins. By default it listens on loopback only.

    Examples
    --------
    socast router
    socast router --listen tcp/0.0.0.0:7447 --config router.json5
    """
    log_lines(as_json=json_log)
    joined = Connection(tuple(connect or ()), tuple(listen or ()), "router", config=config)
    with stop_on_signals() as stop, Node(joined) as node:
        _log.info("listening", extra=event_fields(endpoints=",".join(node.endpoints)))
        stop.wait()
