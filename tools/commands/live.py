"""`socast live`: receive the telemetry of cars, publish forecasts and record messages."""

from pathlib import Path
from typing import Annotated

import typer

from socast.core.settings import Limits
from socast.core.wire.shard import By, parse_shard
from socast.stream.loop import REPORT_S
from socast.stream.structured_log import log_lines
from socast.stream.zenoh_session import LOOPBACK, Connection, Mode
from socast.tools.terminal.forecast_options import ForecastOptions, insert_forecast_options
from socast.tools.terminal.live_options import RecordingOptions, insert_limit_options, insert_recording_options
from socast.tools.terminal.live_service import LiveOptions, serve
from socast.tools.terminal.option_groups import insert_options
from socast.tools.terminal.output import EventsFile, make_console, refuse
from socast.tools.terminal.settings_file import SettingsFile
from socast.tools.terminal.time_zone import TimeZone, find_zone

MONITORING, SEVERAL = "Monitoring", "Several consumers"
"""Titles of options in the help text."""


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


@insert_recording_options
@insert_limit_options
@insert_forecast_options
@insert_connection_options
def live(
    *,
    connection: Connection,
    options: ForecastOptions,
    limits: Limits,
    recording: RecordingOptions,
    state: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Keep the state of every car here, and continue from it.")
    ] = None,
    watch: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Diagnose the first model every night on --record, and keep findings here."),
    ] = None,
    events: EventsFile = None,
    report: Annotated[
        float,
        typer.Option(
            metavar="S", help="Time between two log lines of counters.", min=0.001, max=1e6, rich_help_panel=MONITORING
        ),
    ] = REPORT_S,
    json_log: Annotated[
        bool, typer.Option("--json-log", help="Log JSON instead of key=value.", rich_help_panel=MONITORING)
    ] = False,
    metrics: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Serve /metrics, /livez and /readyz at a port on loopback, or at HOST:PORT.",
            rich_help_panel=MONITORING,
        ),
    ] = None,
    metrics_per_car: Annotated[
        bool, typer.Option("--metrics-per-car", help="Also serve metrics of each vehicle.", rich_help_panel=MONITORING)
    ] = False,
    standby: Annotated[
        bool,
        typer.Option(
            "--standby",
            help="Publish only while no other consumer with --standby does; needs --connect.",
            rich_help_panel=SEVERAL,
        ),
    ] = False,
    shard: Annotated[
        str | None,
        typer.Option(
            metavar="I/N",
            help="Serve only this share of the cars, such as 2/4; the others need a consumer.",
            rich_help_panel=SEVERAL,
        ),
    ] = None,
    shard_by: Annotated[
        By,
        typer.Option(
            metavar="WHAT",
            help="Divide by the end of the cars' name, or of the chunk before `fleet`.",
            rich_help_panel=SEVERAL,
        ),
    ] = "name",
    time_zone: TimeZone = None,
    settings_file: SettingsFile = None,  # noqa: ARG001 - its values arrive as those of the other options
) -> None:
    """Listen to cars over Zenoh, publish a forecast for each, and answer questions about their shifts.

    Without --connect a router opens in this process, on loopback. SIGINT or SIGTERM ends the consumer after it has
    forecast and recorded what has arrived. A terminal shows a table of cars; the log goes to standard error.

    Of several models the first makes the forecasts, and the error of each is published as rides end. --warm-up is
    ignored where the file of --state exists.

    With --watch, `socast diagnose` runs after every midnight UTC in a process of its own, on all recordings of
    --record. What it becomes sure of is logged, and published under findings/WHO/EFFECT. --events is read every night.

    Examples
    --------
    socast live --listen tcp/0.0.0.0:7447 --record kept --state fleet.state
    socast live --connect tcp/router.example:7447 --prefix montreal --json-log 2>live.log
    socast live --model fitted.json --model extended_physical --warm-up january.mcap
    socast live --model fitted.json --record kept --watch findings.json
    socast live --state fleet.state --record kept --metrics 9464
    socast live --settings deploy/socast.toml
    socast live --connect tcp/router.example:7447 --shard 2/4 --state shard-2.state --record shard-2
    """
    log_lines(as_json=json_log)
    refuse(
        (
            shard is None and shard_by != "name",
            "--shard-by says how --shard divides the fleet: give --shard I/N too",
        ),
        (
            metrics_per_car and metrics is None,
            "--metrics-per-car adds to what --metrics serves: give --metrics ADDRESS too",
        ),
    )
    of_fleet = None if shard is None else parse_shard(shard, shard_by)
    kept = connection, options.find_models(recording.folder), limits, recording, state, watch, events
    zone = find_zone(time_zone, make_console())
    serve(LiveOptions(*kept, report, metrics, metrics_per_car, standby, of_fleet, zone))
