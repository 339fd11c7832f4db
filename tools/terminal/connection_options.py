"""The options of `socast live` that say how it reaches its router."""

from pathlib import Path
from typing import Annotated

import typer

from socast.stream.zenoh_session import LOOPBACK, Connection, Mode
from socast.tools.terminal.option_groups import insert_options


def make_connection(
    *,
    connect: Annotated[
        list[str] | None, typer.Option(metavar="E", help="Join the router at E, such as tcp/10.0.0.5:7447; repeatable.")
    ] = None,
    listen: Annotated[
        list[str] | None,
        typer.Option(metavar="E", help=f"Listen at E; repeatable. [default: {LOOPBACK} without --connect]"),
    ] = None,
    mode: Annotated[
        Mode | None,
        typer.Option(metavar="MODE", help="client, peer or router. [default: client with --connect, else router]"),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(metavar="F.json5", help="Read Zenoh's own configuration: TLS, access control and the rest."),
    ] = None,
    recovery: Annotated[bool, typer.Option(help="Request missed samples from the publishers.")] = True,
) -> Connection:
    """Return the connection that the options describe, without a prefix."""
    return Connection(tuple(connect or ()), tuple(listen or ()), mode, config=config, recovery=recovery)


insert_connection_options = insert_options("connection", make_connection, "Connection")
"""Decorator that gives a command the options of a connection in place of its argument `connection`."""
