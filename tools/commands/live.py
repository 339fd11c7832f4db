"""`socast live`: listen to cars, forecast, record."""

import logging
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from core.errors import SettingsError, SocastError
from core.models import Model
from core.pipeline import Pipeline
from core.settings import Settings
from core.wire.messages import Message, Telemetry, encode
from stream.latest_only_sink import Outbox
from stream.loop import PUBLISH_S, REPORT_S, Tally, run, stopping
from stream.query_service import Desk
from stream.recorder import FILE_BYTES, FILE_S, FLUSH_S, Recorder
from stream.structured_log import fields, flat, write_lines
from stream.zenoh_pubsub import ZenohSink, ZenohSource
from stream.zenoh_queryable import ZenohQueries
from stream.zenoh_session import LOOPBACK, Connection, Mode, Node
from tools.terminal.cleaning_options import cleaned
from tools.terminal.live_table import Screen, ride_records, with_predictions
from tools.terminal.model_comparison import ModelNames, line, loaded
from tools.terminal.output import EffectFiles
from tools.terminal.warm_up import History, learned

TAKE_S = 1.0
"""Time between two looks for rides that have ended. [s]"""
KEEP_S = 30.0
"""Time between two savings of the state. [s]"""

_log = logging.getLogger("socast.live")


@cleaned
def live(
    *,
    connect: Annotated[
        list[str] | None, typer.Option(metavar="E", help="Router to join, such as tcp/10.0.0.5:7447; may be repeated.")
    ] = None,
    listen: Annotated[
        list[str] | None,
        typer.Option(
            metavar="E", help=f"Where to be reached; may be repeated. [default: {LOOPBACK} without --connect]"
        ),
    ] = None,
    mode: Annotated[
        str | None, typer.Option(help="client, peer or router. [default: client with --connect, else router]")
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(metavar="F.json5", help="Zenoh's own configuration: TLS, access control and the rest."),
    ] = None,
    prefix: Annotated[str, typer.Option(metavar="P", help="Key chunks before `fleet`, such as montreal.")] = "",
    recovery: Annotated[bool, typer.Option(help="Ask advanced publishers for what was missed.")] = True,
    model: ModelNames = None,
    _: EffectFiles = None,
    settings: Settings,
    record: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Record every payload as it came, good or not.")
    ] = None,
    record_mb: Annotated[float, typer.Option(metavar="MB", help="Size at which the next file begins.")] = FILE_BYTES
    / 2**20,
    record_minutes: Annotated[float, typer.Option(metavar="MIN", help="Time that a file spans.")] = FILE_S / 60,
    flush: Annotated[
        float, typer.Option(metavar="S", help="Seconds after which what was received is on disk.")
    ] = FLUSH_S,
    state: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Keep the state of every car here, and go on from it.")
    ] = None,
    history: History = None,
    report: Annotated[float, typer.Option(metavar="S", help="Seconds between two lines of counters.")] = REPORT_S,
    json_log: Annotated[bool, typer.Option("--json-log", "--log-json", help="Log JSON, not key=value.")] = False,
) -> None:
    """Listen to cars, publish a forecast for each as it changes, and answer what is asked of their shifts.

    Without --connect a router is opened inside, on loopback. SIGINT or SIGTERM ends it: what has arrived is still
    forecast and recorded. On a terminal a table shows every car; the log goes to standard error. Of several models the
    first makes the forecasts, and how each fares is published as rides end. What --history holds is learned from
    unless there is a state to go on from.
    """
    write_lines(as_json=json_log)
    chosen, *shadows = loaded(model)
    warm_up(chosen, *shadows)
    known = state is not None and state.exists()
    earlier = None if known else learned(chosen, shadows, settings, history)
    recorder = Recorder(record, round(record_mb * 2**20), record_minutes * 60, flush) if record else None
    connection = Connection(tuple(connect or ()), tuple(listen or ()), _mode(mode), prefix, config, recovery)
    with stopping() as stop, Node(connection) as node, ZenohQueries(node) as queries:
        pipeline = Pipeline(chosen, settings, node.prefix, shadows=shadows)
        if earlier:
            pipeline.learn_from(earlier)
        keeper = Keeper(pipeline, state)
        desk = Desk(queries, pipeline)
        source = ZenohSource(node, stop)
        endpoints = ",".join(node.endpoints or connection.connect)
        beside = {"shadows": ",".join(shadow.name for shadow in shadows)} if shadows else {}
        _log.info("listening", extra=fields(endpoints=endpoints, model=chosen.name, **beside))
        with Screen(pipeline, "Live", silent=not sys.stdout.isatty()) as screen:
            watch = both(desk, keeper, screen)
            run(
                source,
                keeper if state else pipeline,
                [Outbox(ZenohSink(node))],
                recorder=recorder,
                publish_s=PUBLISH_S,
                watch=watch,
                report_s=report,
            )
        desk.end()
        keeper.end()


def warm_up(model: Model, *shadows: Model) -> None:
    """Compile what is compiled at its first use, before anybody waits for it."""
    pipeline = Pipeline(model, shadows=shadows)
    samples = [Telemetry("warm-up", 1.7e9 + 3 * i, speed_kmh=30.0) for i in range(3)]
    pipeline.push([Message("fleet/warm-up/telemetry", encode(sample), 0) for sample in samples])


class Keeper:
    """Logs rides as they end and what is told of shadows, and keeps the state of every car in a file.

    It stands before the pipeline where a state is kept: rides in progress are then not closed at the end, but go on
    when the consumer is started again.

    Parameters
    ----------
    pipeline : Pipeline
    file : Path, optional
        Where the state is kept; taken up from there, if it is there.
    clock : callable
        Monotonic time. [s]

    Raises
    ------
    SocastError
        Where the file is no state of this version and model.
    SettingsError
        Where it cannot be read, or not be written at the start or at the end. In between that is logged, and the cars
        are served on.
    """

    def __init__(
        self, pipeline: Pipeline, file: Path | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._pipeline, self._file, self._clock = pipeline, file, clock
        self._take_s = clock() + TAKE_S
        self._keep_s = clock() + KEEP_S
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
            _log.info("restored", extra=fields(file=str(file), vehicles=pipeline.quality()["vehicles"]))
        self._verdicts = self._judged()
        self._save()

    def __call__(self, _: Tally) -> None:
        """Do what is due."""
        now = self._clock()
        if now >= self._take_s:
            self._take_s = now + TAKE_S
            self._tell()
        if now >= self._keep_s:
            self._keep_s = now + KEEP_S
            try:
                self._save()
            except SettingsError as error:
                _log.error("state not kept: %s", error)

    def finish(self) -> list[Message]:
        """Leave rides in progress open; the state has them."""
        return []

    def end(self) -> None:
        """Log the last rides and how models fare, and save the state."""
        self._tell()
        if self._pipeline.shadows:
            for told in self._pipeline.shadows.errors():
                _log.info("model", extra=fields(**line(told)))
        self._save()

    def _tell(self) -> None:
        """Log the rides that have ended and verdicts that have changed, and let the windows go."""
        pipeline = self._pipeline
        pipeline.take_windows()
        for ride in ride_records(with_predictions(pipeline.take_rides(), pipeline.shadows)):
            shadows = flat({"shadows_kwh": ride.pop("shadows_kwh", {})})
            known = {name: value for name, value in ride.items() if value is not None}
            _log.info("ride", extra=fields(**known, **shadows))
        before, self._verdicts = self._verdicts, self._judged()
        for told in pipeline.shadows.errors():
            if before[told.model] != self._verdicts[told.model]:
                _log.info("verdict", extra=fields(**line(told)))

    def _judged(self) -> dict[str, str]:
        """Return the verdict on each model."""
        told = self._pipeline.shadows.errors()
        return {model.model: model.overall.gain.verdict if model.overall.gain else "" for model in told}

    def _save(self) -> None:
        """Replace the state file, so that there is a whole one at any time."""
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


def both(*watches: Callable[[Tally], None]) -> Callable[[Tally], None]:
    """Return what calls each of several watches."""

    def watch(tally: Tally) -> None:
        for one in watches:
            one(tally)

    return watch


def _mode(text: str | None) -> Mode | None:
    """Return a mode, or raise `SettingsError`."""
    for known in ("client", "peer", "router"):
        if text == known:
            return known
    if text is None:
        return None
    raise SettingsError(f"--mode is '{text}'; give client, peer or router")
