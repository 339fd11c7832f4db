"""The live service: its parts, and how they start, run and stop."""

import logging
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from datetime import UTC, tzinfo
from pathlib import Path
from threading import Event
from typing import Final

from socast.core.columns import SECONDS_PER_DAY
from socast.core.errors import SettingsError
from socast.core.formatting import format_time
from socast.core.models import LinearModel
from socast.core.pipeline import Pipeline
from socast.core.settings import LIVE_KEY_RATE, Limits
from socast.core.wire.messages import Message
from socast.core.wire.shard import Shard
from socast.stream.checkpoints import Checkpoints
from socast.stream.idle_keys import IdleKeys
from socast.stream.loop import PUBLISH_S, REPORT_S, Watch, combine_watches, run
from socast.stream.query_service import QueryService
from socast.stream.recorder import Recorder
from socast.stream.recording_metadata import list_changed_settings
from socast.stream.service_monitor import ServiceMonitor
from socast.stream.service_snapshot import SnapshotTaker
from socast.stream.shard_rows import ShardSource
from socast.stream.source import Sink
from socast.stream.state_file import StateFile
from socast.stream.structured_log import event_fields, flatten_counts
from socast.stream.zenoh_overlap import OverlapWatch
from socast.stream.zenoh_queryable import ZenohQueryable
from socast.stream.zenoh_receiver import shares_batches
from socast.stream.zenoh_session import Connection, Node
from socast.stream.zenoh_sink import LatestOnlySink, ZenohSink
from socast.stream.zenoh_source import ZenohSource
from socast.stream.zenoh_standby import LEASE_S, FencedSink, Standby, StandbyQueryable, TakeoverSink
from socast.tools.terminal.forecast_options import ForecastOptions, describe_forecasts, make_pipeline
from socast.tools.terminal.kernels import compile_kernels
from socast.tools.terminal.live_options import LimitLog, RecordingOptions
from socast.tools.terminal.live_table import LiveTable, add_predictions, make_ride_records
from socast.tools.terminal.model_comparison import advise_fit, load_models, make_log_fields
from socast.tools.terminal.night_watch import check_watch, make_nightly_diagnosis
from socast.tools.terminal.output import refuse
from socast.tools.terminal.stop_signals import act_on_hangup, stop_on_signals

UNCOUNTED: Final = 2.0
"""Ratio to `--max-payload-bytes` above which Zenoh drops a payload, before the consumer could count it. [1]"""
_log = logging.getLogger("socast.live")

TAKE_S: Final = 1.0
"""Time between two checks for rides that have ended. [s]"""


class RideLog:
    """Log the rides that have ended, as a watch of the loop; their totals do not pile up in the pipeline.

    Parameters
    ----------
    clock : callable
        Function that returns monotonic time. [s]
    """

    def __init__(self, pipeline: Pipeline, clock: Callable[[], float] = time.monotonic) -> None:
        self._pipeline, self._clock = pipeline, clock
        self._take_s = clock() + TAKE_S
        self._verdicts = self._current_verdicts()

    def __call__(self, _: object) -> None:
        """Log rides and verdicts when they are due."""
        if (now := self._clock()) >= self._take_s:
            self._take_s = now + TAKE_S
            self._log_rides()

    def end(self) -> None:
        """Log the last rides and the errors of the models."""
        self._log_rides()
        if self._pipeline.shadows:
            for errors in self._pipeline.shadows.errors():
                _log.info("model", extra=event_fields(**make_log_fields(errors)))

    def _log_rides(self) -> None:
        """Log the rides that have ended and the verdicts that have changed, and drop the windows."""
        pipeline = self._pipeline
        pipeline.take_windows()
        for ride in make_ride_records(add_predictions(pipeline.take_rides(), pipeline.shadows)):
            shadows = flatten_counts({"shadows_kwh": ride.pop("shadows_kwh", {})})
            start = format_time(ride.pop("start_s"))
            known = {name: value for name, value in ride.items() if value is not None}
            _log.info("ride", extra=event_fields(start=start, **known, **shadows))
        before, self._verdicts = self._verdicts, self._current_verdicts()
        for errors in pipeline.shadows.errors():
            if before[errors.model] != self._verdicts[errors.model]:
                _log.info("verdict", extra=event_fields(**make_log_fields(errors)))

    def _current_verdicts(self) -> dict[str, str]:
        """Return the verdict on each model."""
        errors = self._pipeline.shadows.errors()
        return {model.model: model.overall.gain.verdict if model.overall.gain else "" for model in errors}


@dataclass(frozen=True)
class LiveOptions:
    """Hold the values of the options of `socast live`.

    Parameters
    ----------
    connection : Connection
        How to reach the router, without a prefix.
    watch : Path, optional
        File of the findings of the nightly diagnosis.
    events : Path, optional
        File of the known events that this diagnosis reads.
    report_s : float
        Time between two log lines of counters. [s]
    metrics_per_car : bool
        Whether to serve metrics of each vehicle.
    standby : bool
        Whether to publish only while no other consumer does.
    shard : Shard, optional
        Share of the fleet to serve; all of it without a shard.
    zone : tzinfo, optional
        Time zone of the times on the terminal; None is that of the system.
    """

    connection: Connection
    forecast: ForecastOptions
    limits: Limits
    recording: RecordingOptions
    state: Path | None = None
    watch: Path | None = None
    events: Path | None = None
    report_s: float = REPORT_S
    metrics: str | None = None
    metrics_per_car: bool = False
    standby: bool = False
    shard: Shard | None = None
    zone: tzinfo | None = UTC


@dataclass(frozen=True)
class ServiceParts:
    """Hold the parts of a service that has started.

    Parameters
    ----------
    watches : list of callable
        What the loop calls after each list of messages.
    """

    monitor: ServiceMonitor
    source: ZenohSource | ShardSource
    pipeline: Pipeline
    sink: Sink
    queries: QueryService
    rides: RideLog
    recorder: Recorder | None
    checkpoints: Checkpoints | None
    watches: list[Watch] = field(default_factory=list)


def serve(options: LiveOptions) -> None:
    """Start the service, run it until a signal stops it, and save its state."""
    with ExitStack() as ending:
        parts = start_service(options, ending)
        with LiveTable(parts.pipeline, "Live", silent=not sys.stdout.isatty(), zone=options.zone) as table:
            run(
                parts.source,
                parts.pipeline,
                [parts.sink, *([parts.checkpoints] if parts.checkpoints else [])],
                recorder=parts.recorder,
                keep_open=parts.checkpoints is not None,
                publish_s=PUBLISH_S,
                watch=combine_watches(*parts.watches, table),
                report_s=options.report_s,
            )
        parts.monitor.announce_stop()
        parts.queries.end()
        parts.rides.end()
        if parts.checkpoints:
            parts.checkpoints.save()


def start_service(options: LiveOptions, ending: ExitStack) -> ServiceParts:
    """Take the locks, compile the kernels, load the state, and connect; return the parts."""
    check_watch(options.forecast, options.recording.folder, options.watch, options.events)
    connection = _make_connection(options)
    models = load_models(options.forecast.models)
    monitor = ending.enter_context(ServiceMonitor(options.metrics, str(options.shard or "")))
    state, recorder = _open_storage(options, models, ending)
    goes_on = state is not None and state.exists
    monitor.begin("compiling kernels")
    compile_kernels(*models)
    monitor.begin("loading the state" if goes_on else "learning from earlier recordings")
    pipeline = _make_pipeline(options, models, goes_on=goes_on)
    checkpoints = Checkpoints(pipeline, state, recorder) if state else None
    first = _restore(pipeline, checkpoints)
    _refuse_other_shard(options, pipeline)
    monitor.begin("connecting to Zenoh")
    stop = ending.enter_context(stop_on_signals())
    rotate = recorder.request_rotation if recorder else lambda: None
    act_on_hangup(stop.set if sys.stdout.isatty() else rotate)  # without a terminal, log rotation
    node = ending.enter_context(Node(connection))
    role = ending.enter_context(Standby(node)) if options.standby else None
    overlap = ending.enter_context(OverlapWatch(node, standby=options.standby))
    queryable, sink, watches = _open_outputs(node, ending, role, options.limits)
    source = ZenohSource(node, stop, options.limits.queue_bytes)
    own_rows = options.shard if shares_batches(node) else None
    received = ShardSource(source, own_rows, options.limits) if own_rows else source
    _log_start(node, pipeline, models, monitor, options.recording.folder)
    sink.put(first)
    parts = ServiceParts(
        monitor,
        received,
        pipeline,
        sink,
        QueryService(queryable, pipeline),
        RideLog(pipeline),
        recorder,
        checkpoints,
        watches,
    )
    _add_watches(parts, options, ending, role, overlap, stop)
    return parts


def _make_connection(options: LiveOptions) -> Connection:
    """Return the connection; refuse --standby without a router of its own."""
    given = options.connection
    is_alone = not (given.connect or given.config)
    refuse(
        (
            is_alone and options.shard and options.shard.count > 1,
            "--shard needs a router that all consumers join: give --connect or --config",
        ),
        (
            is_alone and options.standby,
            "--standby needs a router that outlives the consumers: give --connect or --config",
        ),
    )
    return replace(
        given,
        prefix=options.forecast.prefix,
        lease_s=LEASE_S if options.standby else None,
        largest_bytes=UNCOUNTED * options.limits.payload_bytes,
        shard=options.shard,
    )


def _open_storage(
    options: LiveOptions, models: Sequence[LinearModel], ending: ExitStack
) -> tuple[StateFile | None, Recorder | None]:
    """Take the locks of the state and of the recording, before anything slow begins."""
    state = ending.enter_context(StateFile(options.state)) if options.state else None
    changes = list_changed_settings(options.limits, Limits(key_rate=LIVE_KEY_RATE))
    recorder = options.recording.open_recorder(describe_forecasts("live", options.forecast, models, changes))
    return state, ending.enter_context(recorder) if recorder else None


def _make_pipeline(options: LiveOptions, models: Sequence[LinearModel], *, goes_on: bool) -> Pipeline:
    """Return the pipeline; it learns from --warm-up where there is no state."""
    if goes_on and options.forecast.warm_up:
        _log.warning(
            "--warm-up is ignored: the consumer continues from --state", extra=event_fields(state=str(options.state))
        )
    return make_pipeline(options.forecast, models, options.limits, warm=not goes_on, shard=options.shard)


def _restore(pipeline: Pipeline, checkpoints: Checkpoints | None) -> list[Message]:
    """Continue from the last state and the recording after it; return the newest forecast of each vehicle."""
    forecasts = checkpoints.restore() if checkpoints else []
    if pipeline.model_change:
        _log.warning(
            "the state was made with another model: running errors start anew where its name or version is another, "
            "and rides in progress have no prediction where an effect is new; all else continues",
            extra=event_fields(difference=pipeline.model_change),
        )
    if pipeline.totals.cleaner.has_new_map:
        _log.warning("the state was made with another elevation map: elevation starts anew, all else continues")
    return forecasts


def _refuse_other_shard(options: LiveOptions, pipeline: Pipeline) -> None:
    """Refuse a state with cars that this shard does not serve."""
    shard = options.shard
    if shard is None or shard.by != "name":
        return
    if strange := [name for name in pipeline.lanes.names if not shard.has(name)]:
        raise SettingsError(
            f"{options.state}: holds {strange[0]}, which shard {shard} does not serve: give the state of this shard, "
            "or start without one, with --warm-up"
        )


def _open_outputs(
    node: Node, ending: ExitStack, role: Standby | None, limits: Limits
) -> tuple[ZenohQueryable | StandbyQueryable, Sink, list[Watch]]:
    """Return the source of queries, the sink of what is published, and what the loop calls for them."""
    idle_s = limits.silent_days * SECONDS_PER_DAY
    publisher = ZenohSink(node, keys=IdleKeys(idle_s))
    if role is None:
        return ending.enter_context(ZenohQueryable(node)), LatestOnlySink(publisher), []
    sink = TakeoverSink(LatestOnlySink(FencedSink(publisher, role)), role, IdleKeys(idle_s))
    return ending.enter_context(StandbyQueryable(node, role)), sink, [sink]


def _add_watches(
    parts: ServiceParts,
    options: LiveOptions,
    ending: ExitStack,
    role: Standby | None,
    overlap: OverlapWatch,
    stop: Event,
) -> None:
    """Add what the loop calls after each list of messages."""
    parts.watches.extend([parts.queries, parts.rides, LimitLog(parts.pipeline), overlap])
    if parts.checkpoints:
        parts.watches.append(parts.checkpoints)
    nightly = None
    if options.recording.folder and options.watch:
        nightly = make_nightly_diagnosis(
            options.forecast, parts.pipeline, parts.sink, options.recording.folder, options.watch, options.events
        )
        ending.callback(nightly.end)
    take = SnapshotTaker(
        parts.pipeline,
        parts.source,
        parts.recorder,
        parts.checkpoints,
        parts.queries,
        role,
        overlap,
        shard=options.shard,
        per_vehicle=options.metrics_per_car,
        get_condition=lambda: nightly.condition if nightly else None,
    )
    parts.watches.extend(parts.monitor.make_watches(take, stop))
    if nightly:
        parts.watches.append(nightly)


def _log_start(
    node: Node, pipeline: Pipeline, models: Sequence[LinearModel], monitor: ServiceMonitor, recorded: Path | None
) -> None:
    """Log where the service listens and what it runs."""
    endpoints = ",".join(node.endpoints or node.routers)
    beside = {"shadows": ",".join(shadow.name for shadow in models[1:])} if models[1:] else {}
    if shard := node.connection.shard:
        beside |= {"shard": str(shard), "by": shard.by}
    if elevation := pipeline.totals.cleaner.map_lookup.identity:
        beside |= {"elevation_map": elevation}
    if monitor.server:
        beside |= {"metrics": str(monitor.server.address)}
    _log.info("listening", extra=event_fields(endpoints=endpoints, model=models[0].name, **beside))
    folder = recorded or Path("kept")
    if advice := advise_fit(models[0], str(folder), f"{folder}/"):
        remedy = advice if recorded else f"{advice}, after some rides with --record {folder}"
        _log.info("model not fitted", extra=event_fields(remedy=remedy))
