"""`socast serve`: show the fleet and its models in a browser."""

import logging
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer

from socast.core.errors import SettingsError
from socast.core.pipeline import Pipeline
from socast.core.settings import Limits
from socast.core.wire.shard import By, Shard
from socast.stream.mcap_reader import McapSource
from socast.stream.structured_log import log_lines
from socast.stream.zenoh_session import LOOPBACK, Connection
from socast.tools.terminal.forecast_options import ForecastOptions, insert_forecast_options, make_pipeline
from socast.tools.terminal.kernels import compile_kernels
from socast.tools.terminal.model_comparison import advise_fit, load_models
from socast.tools.terminal.output import EventsFile, refuse
from socast.tools.terminal.progress import show_elapsed
from socast.tools.terminal.ride_source import RideSource
from socast.tools.terminal.time_zone import parse_zone
from socast.tools.workbench.fleet.board import Board
from socast.tools.workbench.fleet.observer import Observer
from socast.tools.workbench.fleet.player import Player
from socast.tools.workbench.fleet.source import FleetSource

PORT = 8137
"""Port of the workbench if the command line names none."""
SERVICE, SERVER = "Live service", "Web server"
"""Titles of options in the help text."""


@insert_forecast_options
def serve(
    given: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[REC or TABLES]...", help="Recordings, or folders of tables.", show_default=False),
    ] = None,
    *,
    options: ForecastOptions,
    folder: Annotated[
        Path | None,
        typer.Option("--models", metavar="DIR", help="Folder in which the models are kept. Default: a temporary one."),
    ] = None,
    live: Annotated[
        bool, typer.Option("--live", help="Show what a live service receives and publishes, instead of a replay.")
    ] = False,
    connect: Annotated[
        list[str] | None,
        typer.Option(
            metavar="E",
            help=f"With --live: the router of the service; repeatable. [default: {LOOPBACK}]",
            rich_help_panel=SERVICE,
        ),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(
            metavar="F.json5", help="With --live: Zenoh's own configuration, such as TLS.", rich_help_panel=SERVICE
        ),
    ] = None,
    shard_by: Annotated[
        By,
        typer.Option(
            metavar="WHAT", help="With --live: `chunk` where consumers have --shard-by chunk.", rich_help_panel=SERVICE
        ),
    ] = "name",
    events: EventsFile = None,
    tiles: Annotated[
        Path | None, typer.Option(metavar="F.pmtiles", help="Draw the raster tiles of this file beneath the fleet.")
    ] = None,
    port: Annotated[
        int, typer.Option(metavar="P", help="Port; 0 for any free one.", min=0, max=65535, rich_help_panel=SERVER)
    ] = PORT,
    host: Annotated[
        str, typer.Option(metavar="H", help="Host at which to listen.", rich_help_panel=SERVER)
    ] = "127.0.0.1",
    read_only: Annotated[
        bool, typer.Option("--read-only", help="Refuse every request that changes something.", rich_help_panel=SERVER)
    ] = False,
    time_zone: Annotated[
        str,
        typer.Option(
            metavar="ZONE",
            help="Time zone of the times on the pages, such as America/Montreal. Default: that of the browser.",
        ),
    ] = "",
    no_browser: Annotated[
        bool, typer.Option("--no-browser", help="Print the address only, and open no browser.", rich_help_panel=SERVER)
    ] = False,
) -> None:
    """Show the fleet and its models in a browser, on this machine.

    The pages replay recordings, or show what a live service receives and publishes. They compare predictions with
    measurements, show where the model fails, and add the effect that it lacks.

    The printed address works for one browser, once. Ctrl-C stops the workbench.

    Examples
    --------
    socast serve recordings/shift.mcap
    socast serve recordings/autumn.mcap --model fitted.json --read-only --no-browser
    socast serve --live --connect tcp/router.example:7447 --prefix montreal
    """
    try:
        from socast.tools.workbench.fleet.tiles import TileFile  # noqa: PLC0415 - an extra
        from socast.tools.workbench.jobs import Jobs  # noqa: PLC0415 - an extra
        from socast.tools.workbench.json_routes import Workbench  # noqa: PLC0415 - an extra
        from socast.tools.workbench.server import WorkbenchServer, make_announcer  # noqa: PLC0415 - an extra
        from socast.tools.workbench.workspace import Given, Workspace  # noqa: PLC0415 - an extra
    except ModuleNotFoundError as error:
        raise SettingsError(
            f"socast serve needs the package {error.name}; install it with: pip install 'socast[workbench]'"
        ) from error
    log_lines(level=logging.WARNING)
    of_live = connect or config or shard_by != "name"
    refuse((of_live and not live, "--connect, --config and --shard-by belong to --live: add it, or leave them out"))
    router = ", ".join(connect or [LOOPBACK]) if live else None
    source = RideSource(
        tuple(given or ()), options.settings, options.elevation, options.effect_files, options.vehicle_files
    )
    workspace = Workspace(Given(source, tuple(options.models), folder, router, events))
    if time_zone:
        parse_zone(time_zone)
    drawn = TileFile(tiles) if tiles else None
    workbench = Workbench(workspace, Jobs(), read_only=read_only, tiles=drawn, time_zone=time_zone)
    with ExitStack() as ending:
        ending.callback(workspace.close)
        ending.callback(workbench.jobs.end)
        if live:
            all_chunks = Shard(1, 1, shard_by) if shard_by == "chunk" else None
            ends = tuple(connect or ())
            connection = Connection(
                ends,
                mode="client",
                prefix=options.prefix,
                config=config,
                shard=all_chunks,
                largest_bytes=Limits().payload_bytes,
            )
            workbench.fleet = observer = Observer(connection, Board())
            observer.start()
        elif workspace.recordings:
            workbench.fleet = _replay(workspace.recordings, source, options)
        if workbench.fleet is not None:
            ending.callback(workbench.fleet.close)
        server = WorkbenchServer(workbench, host, port, make_announcer(opens_browser=not no_browser))
        workbench.jobs.start("reading the rides", workspace.open)
        server.run()


def _replay(recordings: list[Path], source: RideSource, options: ForecastOptions) -> FleetSource:
    """Return the running player of recordings."""
    options = options.find_models(recordings[0].parent)
    models = load_models(options.models)
    with show_elapsed("preparing the models"):
        compile_kernels(*models)
    sources = [McapSource(path) for path in recordings]

    def make(warm: bool) -> Pipeline:
        return make_pipeline(options, models, replayed=sources, warm=warm)

    words = ["socast", "replay", *source.list_words()]
    words += [word for model in options.models for word in ("--model", model)]
    words += [word for path in options.warm_up for word in ("--warm-up", str(path))]
    advice = advise_fit(models[0], " ".join(map(str, recordings))) or ""
    player = Player(recordings, make, Board(), words, advice)
    player.start()
    return player
