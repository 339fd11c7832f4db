"""`socast live`: receive the telemetry of cars, publish forecasts and record messages."""

import logging
import os
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, get_args

import typer

from core.errors import SettingsError, SocastError
from core.models import Model
from core.pipeline import Pipeline
from core.wire.messages import Message, Telemetry, encode
from stream.latest_only_sink import LatestOnlySink
from stream.loop import PUBLISH_S, REPORT_S, Tally, run, stop_on_signals
from stream.nightly_diagnosis import NightlyDiagnosis
from stream.query_service import QueryService
from stream.recorder import FILE_BYTES, FILE_S, FLUSH_S, Recorder
from stream.source import Sink
from stream.structured_log import event_fields, flatten_counts, log_lines
from stream.zenoh_pubsub import ZenohSink, ZenohSource
from stream.zenoh_queryable import ZenohQueryable
from stream.zenoh_session import LOOPBACK, Connection, Mode, Node, parse_prefix
from tools.terminal.diagnosis_process import DiagnosisProcess
from tools.terminal.findings_file import make_finding_fields, read_findings
from tools.terminal.forecast_options import ForecastOptions, insert_forecast_options, make_pipeline
from tools.terminal.live_table import LiveTable, add_predictions, make_ride_records
from tools.terminal.model_comparison import DEFAULT_MODEL, load_models, make_log_fields
from tools.terminal.output import check_outputs

TAKE_S = 1.0
"""Time between two checks for rides that have ended. [s]"""
SAVE_S = 30.0
"""Time between two writes of the state. [s]"""

_log = logging.getLogger("socast.live")


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
        str | None,
        typer.Option(metavar="MODE", help="client, peer or router. [default: client with --connect, else router]"),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(metavar="F.json5", help="Read Zenoh's own configuration: TLS, access control and the rest."),
    ] = None,
    recovery: Annotated[bool, typer.Option(help="Request missed samples from the publishers.")] = True,
    options: ForecastOptions,
    record: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Record every payload as it came, decodable or not.")
    ] = None,
    record_mb: Annotated[float, typer.Option(metavar="MB", help="Size at which the next file begins.")] = FILE_BYTES
    / 2**20,
    record_minutes: Annotated[float, typer.Option(metavar="MIN", help="Time span of a file.")] = FILE_S / 60,
    flush: Annotated[
        float, typer.Option(metavar="S", help="Longest time until a received message is on disk.")
    ] = FLUSH_S,
    state: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Keep the state of every car here, and continue from it.")
    ] = None,
    watch: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Diagnose the first model every night on --record, and keep findings here."),
    ] = None,
    report: Annotated[float, typer.Option(metavar="S", help="Time between two log lines of counters.")] = REPORT_S,
    json_log: Annotated[bool, typer.Option("--json-log", help="Log JSON instead of key=value.")] = False,
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
    """
    log_lines(as_json=json_log)
    _check_watch(options, record, watch)
    models = load_models(options.models)
    compile_kernels(*models)
    restored = state is not None and state.exists()
    if restored and options.warm_up:
        _log.warning("--warm-up is ignored: the consumer continues from --state", extra=event_fields(state=str(state)))
    pipeline = make_pipeline(options, models, warm=not restored)
    recorder = Recorder(record, round(record_mb * 2**20), record_minutes * 60, flush) if record else None
    connection = Connection(
        tuple(connect or ()), tuple(listen or ()), _parse_mode(mode), options.prefix, config, recovery
    )
    with stop_on_signals() as stop, Node(connection) as node, ZenohQueryable(node) as queryable:
        keeper = StateKeeper(pipeline, state)
        service = QueryService(queryable, pipeline)
        source = ZenohSource(node, stop)
        endpoints = ",".join(node.endpoints or connection.connect)
        beside = {"shadows": ",".join(shadow.name for shadow in models[1:])} if models[1:] else {}
        beside |= {"elevation_map": pipeline.cleaner.map_lookup.identity} if options.elevation else {}
        _log.info("listening", extra=event_fields(endpoints=endpoints, model=models[0].name, **beside))
        sink = LatestOnlySink(ZenohSink(node))
        nightly = make_nightly_diagnosis(options, pipeline, sink, record, watch) if record and watch else None
        with LiveTable(pipeline, "Live", silent=not sys.stdout.isatty()) as table, ExitStack() as ending:
            if nightly:
                ending.callback(nightly.end)
            run(
                source,
                keeper if state else pipeline,
                [sink],
                recorder=recorder,
                publish_s=PUBLISH_S,
                watch=combine_watches(service, keeper, table, *([nightly] if nightly else [])),
                report_s=report,
            )
        service.end()
        keeper.end()


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


def compile_kernels(*models: Model) -> None:
    """Compile the numba kernels of a pipeline with these models, so that telemetry does not wait for the compiler."""
    first, *shadows = models
    pipeline = Pipeline(first, shadows=shadows)
    samples = [Telemetry("compile", 1.7e9 + 3 * i, speed_kmh=30.0) for i in range(3)]
    pipeline.push([Message("fleet/compile/telemetry", encode(sample), 0) for sample in samples])


class StateKeeper:
    """Log rides as they end and verdicts as they change, and keep the state of every car in a file.

    If a state file is given, the loop calls the keeper in place of the pipeline. Rides in progress then stay open at
    the end, and they continue when the consumer starts again.

    Parameters
    ----------
    pipeline : Pipeline
        Pipeline that holds the state of the cars.
    file : Path, optional
        State file. The keeper restores an existing state.
    clock : callable
        Monotonic time. [s]

    Raises
    ------
    SocastError
        Where the file is no state of this version and model.
    SettingsError
        If the file cannot be read, or cannot be written at the start or at the end. The keeper only logs a failure in
        between, and the consumer continues.
    """

    def __init__(
        self, pipeline: Pipeline, file: Path | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._pipeline, self._file, self._clock = pipeline, file, clock
        self._take_s = clock() + TAKE_S
        self._save_s = clock() + SAVE_S
        self.take = pipeline.take
        self.forecasts = pipeline.forecasts
        self.model_errors = pipeline.model_errors
        self.quality = pipeline.quality
        if file is not None and file.exists():
            try:
                pipeline.restore(file.read_bytes())
            except OSError as error:
                raise SettingsError(f"{file} cannot be read: {error.strerror}") from error
            except SocastError as error:
                raise SocastError(f"{file}: {error}") from error
            _log.info("restored", extra=event_fields(file=str(file), vehicles=pipeline.quality()["vehicles"]))
            if pipeline.cleaner.has_new_map:
                _log.warning("the state was made with another elevation map: elevation starts anew, all else continues")
        self._verdicts = self._current_verdicts()
        self._save()

    def __call__(self, _: Tally) -> None:
        """Log rides and save the state when they are due."""
        now = self._clock()
        if now >= self._take_s:
            self._take_s = now + TAKE_S
            self._log_rides()
        if now >= self._save_s:
            self._save_s = now + SAVE_S
            try:
                self._save()
            except SettingsError as error:
                _log.error("state not kept: %s", error)

    def finish(self) -> list[Message]:
        """Return no forecasts, and leave rides in progress open, because the state holds them."""
        return []

    def end(self) -> None:
        """Log the last rides and the errors of the models, and save the state."""
        self._log_rides()
        if self._pipeline.shadows:
            for errors in self._pipeline.shadows.errors():
                _log.info("model", extra=event_fields(**make_log_fields(errors)))
        self._save()

    def _log_rides(self) -> None:
        """Log the rides that have ended and the verdicts that have changed, and drop the windows."""
        pipeline = self._pipeline
        pipeline.take_windows()
        for ride in make_ride_records(add_predictions(pipeline.take_rides(), pipeline.shadows)):
            shadows = flatten_counts({"shadows_kwh": ride.pop("shadows_kwh", {})})
            known = {name: value for name, value in ride.items() if value is not None}
            _log.info("ride", extra=event_fields(**known, **shadows))
        before, self._verdicts = self._verdicts, self._current_verdicts()
        for errors in pipeline.shadows.errors():
            if before[errors.model] != self._verdicts[errors.model]:
                _log.info("verdict", extra=event_fields(**make_log_fields(errors)))

    def _current_verdicts(self) -> dict[str, str]:
        """Return the verdict on each model."""
        errors = self._pipeline.shadows.errors()
        return {model.model: model.overall.gain.verdict if model.overall.gain else "" for model in errors}

    def _save(self) -> None:
        """Replace the state file atomically, so that a complete file exists at any time."""
        if self._file is None:
            return
        fresh = self._file.with_name(f".{self._file.name}.new")
        try:
            with fresh.open("wb") as file:
                file.write(self._pipeline.snapshot())
                file.flush()
                os.fsync(file.fileno())
            fresh.replace(self._file)
        except OSError as error:
            raise SettingsError(f"{self._file} cannot be written: {error.strerror}; choose another file") from error


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


def _parse_mode(text: str | None) -> Mode | None:
    """Return a mode of Zenoh, or raise `SettingsError`."""
    known: dict[str | None, Mode | None] = {None: None, **{mode: mode for mode in get_args(Mode)}}
    if text not in known:
        raise SettingsError(f"--mode is '{text}'; give client, peer or router")
    return known[text]
