"""`socast live`: receive the telemetry of cars, publish forecasts and record messages."""

import logging
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from threading import Event
from typing import Annotated, Final

import typer

from core.errors import SettingsError
from core.models import Model
from core.pipeline import Pipeline
from core.settings import Limits
from stream.checkpoints import Checkpoints
from stream.latest_only_sink import LatestOnlySink
from stream.loop import PUBLISH_S, REPORT_S, Tally, act_on_hangup, run, stop_on_signals
from stream.nightly_diagnosis import NightlyDiagnosis
from stream.query_service import QueryService, QuerySource
from stream.recorder import FILE_BYTES, FILE_S, FLUSH_S, Recorder
from stream.service_monitor import ServiceMonitor
from stream.service_snapshot import SnapshotTaker
from stream.source import Sink
from stream.state_file import StateFile
from stream.structured_log import event_fields, log_lines
from stream.zenoh_pubsub import ZenohSink, ZenohSource
from stream.zenoh_queryable import ZenohQueryable
from stream.zenoh_session import LOOPBACK, Connection, Mode, Node, parse_prefix
from stream.zenoh_standby import LEASE_S, FencedSink, Standby, StandbyQueryable, TakeoverSink
from tools.terminal.diagnosis_process import DiagnosisProcess
from tools.terminal.findings_file import make_finding_fields, read_findings
from tools.terminal.forecast_options import ForecastOptions, insert_forecast_options, make_pipeline
from tools.terminal.kernels import compile_kernels
from tools.terminal.limit_options import LimitLog, insert_limit_options
from tools.terminal.live_table import LiveTable
from tools.terminal.model_comparison import DEFAULT_MODEL, load_models
from tools.terminal.output import check_outputs
from tools.terminal.ride_log import RideLog
from tools.terminal.settings_file import SettingsFile

UNCOUNTED: Final = 2.0
"""Ratio to `--max-payload-bytes` above which Zenoh drops a payload, before the consumer could count it. [1]"""
_log = logging.getLogger("socast.live")


@insert_limit_options
@insert_forecast_options
def live(
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
    options: ForecastOptions,
    limits: Limits,
    record: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Record every payload as it came, decodable or not.")
    ] = None,
    record_mb: Annotated[
        float, typer.Option(metavar="MB", help="Size at which the next file begins.", min=0.001, max=1e6)
    ] = FILE_BYTES / 2**20,
    record_minutes: Annotated[
        float, typer.Option(metavar="MIN", help="Time span of a file.", min=0.001, max=1e6)
    ] = FILE_S / 60,
    flush: Annotated[
        float,
        typer.Option(metavar="S", help="Longest time until a received message is synced to disk.", min=0.001, max=1e6),
    ] = FLUSH_S,
    state: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Keep the state of every car here, and continue from it.")
    ] = None,
    watch: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Diagnose the first model every night on --record, and keep findings here."),
    ] = None,
    report: Annotated[
        float, typer.Option(metavar="S", help="Time between two log lines of counters.", min=0.001, max=1e6)
    ] = REPORT_S,
    json_log: Annotated[bool, typer.Option("--json-log", help="Log JSON instead of key=value.")] = False,
    metrics: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS", help="Serve /metrics, /livez and /readyz at a port on loopback, or at HOST:PORT."
        ),
    ] = None,
    metrics_per_car: Annotated[
        bool, typer.Option("--metrics-per-car", help="Also serve metrics of each vehicle.")
    ] = False,
    standby: Annotated[
        bool,
        typer.Option("--standby", help="Publish only while no other consumer with --standby does; needs --connect."),
    ] = False,
    settings_file: SettingsFile = None,  # noqa: ARG001 - its values arrive as those of the other options
) -> None:
    """Listen to cars over Zenoh, publish a forecast for each, and answer questions about their shifts.

    Without --connect a router opens in this process, on loopback. SIGINT or SIGTERM ends the consumer after it has
    forecast and recorded what has arrived. A terminal shows a table of cars; the log goes to standard error.

    Of several models the first makes the forecasts, and the error of each is published as rides end. --warm-up is
    ignored where the file of --state exists.

    With --watch, `socast diagnose` runs after every midnight UTC in a process of its own, on all recordings of
    --record. What it becomes sure of is logged, and published under findings/WHO/EFFECT.

    Examples
    --------
    socast live --listen tcp/0.0.0.0:7447 --record kept --state fleet.state
    socast live --connect tcp/router.example:7447 --prefix montreal --json-log 2>live.log
    socast live --model fitted.json --model extended_physical --warm-up january.mcap
    socast live --model fitted.json --record kept --watch findings.json
    socast live --state fleet.state --record kept --metrics 9464
    socast live --settings deploy/socast.toml
    """
    log_lines(as_json=json_log)
    _check_watch(options, record, watch)
    if metrics_per_car and metrics is None:
        raise SettingsError("--metrics-per-car adds to what --metrics serves: give --metrics ADDRESS too")
    models = load_models(options.models)
    lease_s = _choose_lease(has_router=bool(connect or config), standby=standby)
    connection = Connection(
        tuple(connect or ()),
        tuple(listen or ()),
        mode,
        options.prefix,
        config,
        recovery,
        lease_s,
        largest_bytes=UNCOUNTED * limits.payload_bytes,
    )
    with ExitStack() as ending:
        monitor = ending.enter_context(ServiceMonitor(metrics))
        monitor.begin("compiling kernels")
        compile_kernels(*models)
        stop = ending.enter_context(stop_on_signals())
        file = ending.enter_context(StateFile(state)) if state else None
        restored = file is not None and file.exists
        if restored and options.warm_up:
            _log.warning(
                "--warm-up is ignored: the consumer continues from --state", extra=event_fields(state=str(state))
            )
        monitor.begin("loading the state" if restored else "learning from earlier recordings")
        pipeline = make_pipeline(options, models, limits, warm=not restored)
        recorder = Recorder(record, round(record_mb * 2**20), record_minutes * 60, flush) if record else None
        ending.enter_context(act_on_hangup(_choose_act(recorder, stop)))
        checkpoints = Checkpoints(pipeline, file, recorder) if file else None
        first = checkpoints.restore() if checkpoints else []
        if pipeline.cleaner.has_new_map:
            _log.warning("the state was made with another elevation map: elevation starts anew, all else continues")
        monitor.begin("connecting to Zenoh")
        node = ending.enter_context(Node(connection))
        role = ending.enter_context(Standby(node)) if standby else None
        queryable, sink, watches = _open_outputs(node, ending, role)
        service, rides = QueryService(queryable, pipeline), RideLog(pipeline)
        source = ZenohSource(node, stop, limits.queue_bytes)
        _log_start(node, pipeline, models, monitor)
        sink.put(first)
        watches += [service, rides, LimitLog(pipeline)]
        if checkpoints:
            watches.append(checkpoints)
        take = SnapshotTaker(pipeline, source, recorder, checkpoints, service, role, per_vehicle=metrics_per_car)
        watches += monitor.make_watches(take, stop)
        if record and watch:
            nightly = make_nightly_diagnosis(options, pipeline, sink, record, watch)
            ending.callback(nightly.end)
            watches.append(nightly)
        with LiveTable(pipeline, "Live", silent=not sys.stdout.isatty()) as table:
            run(
                source,
                pipeline,
                [sink],
                recorder=recorder,
                keep_open=checkpoints is not None,
                publish_s=PUBLISH_S,
                watch=combine_watches(*watches, table),
                report_s=report,
            )
        monitor.announce_stop()
        service.end()
        rides.end()
        if checkpoints:
            checkpoints.save()


def _choose_lease(*, has_router: bool, standby: bool) -> float | None:
    """Return the lease of a consumer with --standby, which needs a router of its own."""
    if standby and not has_router:
        raise SettingsError("--standby needs a router that outlives the consumers: give --connect or --config")
    return LEASE_S if standby else None


def _open_outputs(
    node: Node, ending: ExitStack, role: Standby | None
) -> tuple[QuerySource, Sink, list[Callable[[Tally], None]]]:
    """Return the source of queries, the sink of what is published, and what the loop calls for them."""
    if role is None:
        return ending.enter_context(ZenohQueryable(node)), LatestOnlySink(ZenohSink(node)), []
    sink = TakeoverSink(LatestOnlySink(FencedSink(ZenohSink(node), role)), role)
    return ending.enter_context(StandbyQueryable(node, role)), sink, [sink]


def _choose_act(recorder: Recorder | None, stop: Event) -> Callable[[], None]:
    """Return what SIGHUP does: stop where a terminal has gone, else begin another file of the recording."""
    if sys.stdout.isatty():
        return stop.set
    return recorder.request_rotation if recorder else lambda: None


def _log_start(node: Node, pipeline: Pipeline, models: Sequence[Model], monitor: ServiceMonitor) -> None:
    """Log where the service listens and what it runs."""
    endpoints = ",".join(node.endpoints or node.connection.connect)
    beside = {"shadows": ",".join(shadow.name for shadow in models[1:])} if models[1:] else {}
    if elevation := pipeline.cleaner.map_lookup.identity:
        beside |= {"elevation_map": elevation}
    if monitor.server:
        beside |= {"metrics": str(monitor.server.address)}
    _log.info("listening", extra=event_fields(endpoints=endpoints, model=models[0].name, **beside))


def make_nightly_diagnosis(
    options: ForecastOptions, pipeline: Pipeline, sink: Sink, record: Path, file: Path
) -> NightlyDiagnosis:
    """Return the diagnosis of the first model after every midnight, on the recordings of a folder.

    Parameters
    ----------
    options : ForecastOptions
    pipeline : Pipeline
        Pipeline that detects the end of a day; it is not changed.
    sink : Sink
        Sink of what is published.
    record : Path
        Folder of the recordings.
    file : Path
        File that keeps the findings.
    """
    arguments = [str(record), "--model", options.models[0] if options.models else DEFAULT_MODEL]
    arguments += [word for path in options.effect_files for word in ("--effects", str(path))]
    arguments += ["--findings", str(file)]
    return NightlyDiagnosis(
        lambda: pipeline.day_rollover.midnight,
        lambda: DiagnosisProcess(arguments),
        lambda: read_findings(file),
        sink,
        make_finding_fields,
        parse_prefix(options.prefix),
    )


def combine_watches(*watches: Callable[[Tally], None]) -> Callable[[Tally], None]:
    """Return a watch that calls each of several watches."""

    def watch(tally: Tally) -> None:
        for each in watches:
            each(tally)

    return watch


def _check_watch(options: ForecastOptions, record: Path | None, watch: Path | None) -> None:
    """Refuse --watch without recordings, and a file that holds no findings or cannot be written."""
    if watch is None:
        return
    if record is None:
        raise SettingsError("--watch diagnoses what --record keeps: give --record DIR too")
    check_outputs(options.files, watch)
    read_findings(watch)
