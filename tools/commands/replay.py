"""`socast replay`: pass recorded shifts through a model, or publish them to a router."""

import logging
import shutil
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass
from datetime import tzinfo
from math import inf
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event
from typing import Annotated, Any

import pandas as pd
import typer
from rich.console import Console

from socast.core.errors import SettingsError
from socast.core.files import replacing
from socast.core.forecast.forecast_table import FORECAST_COLUMNS
from socast.core.formatting import format_count
from socast.core.models import LinearModel
from socast.core.settings import Settings
from socast.core.wire.messages import ModelErrors
from socast.stream.mcap_reader import McapSource
from socast.stream.mcap_writer import replace_recording
from socast.stream.source import Sink, Source, merge_sources, pace_source, stop_source
from socast.stream.structured_log import log_lines
from socast.stream.zenoh_delivery import ZenohDelivery
from socast.stream.zenoh_session import Connection, Node, parse_prefix
from socast.tools.foxglove.topics import SCHEMAS, FoxgloveRecording
from socast.tools.terminal.cleaning_options import warn_outside
from socast.tools.terminal.forecast_options import (
    ForecastOptions,
    describe_forecasts,
    insert_forecast_options,
    make_pipeline,
    run_forecasts,
)
from socast.tools.terminal.live_table import add_predictions, make_ride_records, show_rides
from socast.tools.terminal.model_comparison import advise_fit, load_models, make_records, show_models
from socast.tools.terminal.output import (
    JsonFile,
    check_outputs,
    make_console,
    parse_speed,
    print_plain,
    refuse,
    write_json,
)
from socast.tools.terminal.recordings import (
    Recordings,
    open_recordings,
    refuse_unusable,
    show_progress,
    warn_of_loggers,
    warn_of_losses,
)
from socast.tools.terminal.shift_outcomes import ShiftOutcomes, show_outcomes
from socast.tools.terminal.stop_signals import stop_on_signals
from socast.tools.terminal.time_zone import TimeZone, find_zone
from socast.tools.testing.difference_report import make_record, show_comparison
from socast.tools.testing.golden_files import (
    NOTHING_COMMON,
    compare_forecasts,
    compare_recordings,
    compare_with_old,
    describe_update,
    read_expected,
    refuse_nothing,
    refuse_replacing,
)
from socast.tools.testing.table_differences import TableComparison
from socast.tools.testing.tolerances import Tolerances, parse_tolerances, resolve_tolerances

SUBSCRIBER_S = 10.0
"""Longest wait for a subscriber before publishing begins without one. [s]"""


@insert_forecast_options
def replay(
    recordings: Recordings,
    *,
    pace: Annotated[
        str | None,
        typer.Option("--speed", metavar="N|max", help="Times real time. [default: max in process, 1 to a router]"),
    ] = None,
    connect: Annotated[
        str | None, typer.Option(metavar="E", help="Publish to the router at E, such as tcp/127.0.0.1:7447.")
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(metavar="F.json5", help="Publish with Zenoh's own configuration, such as taxi-1.json5."),
    ] = None,
    in_process: Annotated[bool, typer.Option("--in-process", help="Run the model here. [default]")] = False,
    options: ForecastOptions,
    longest_gap: Annotated[
        float, typer.Option(metavar="S", help="Shorten silences of the recording to this time.")
    ] = inf,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="F.mcap", help="Record the forecasts, and the errors of several models."),
    ] = None,
    foxglove: Annotated[
        bool,
        typer.Option(
            "--foxglove",
            help="Let --out also hold the replayed messages, and positions and warnings for the viewer Foxglove; write "
            "its layout F.layout.json.",
        ),
    ] = False,
    expect: Annotated[
        Path | None,
        typer.Option(metavar="F.mcap", help="Compare the forecasts with those in F.mcap; exit with 1 if they differ."),
    ] = None,
    tolerance: Annotated[
        list[str] | None,
        typer.Option(
            metavar="FIELD=D",
            help="Allow a field of --expect to differ by D, such as soc=0.1% or range_km=2%; may be repeated.",
        ),
    ] = None,
    update: Annotated[
        bool, typer.Option("--update", help="Write the file of --expect anew, and say what changes.")
    ] = False,
    time_zone: TimeZone = None,
    json_file: JsonFile = None,
) -> None:
    """Replay recordings, merged in time order, through a model or to a router.

    In this process they run through the same loop as live telemetry. The tables at the end compare predicted with
    measured energy, several models with each other, and forecasts of each shift's end with its outcome.

    With --connect or --config the recordings are published, and the listeners at the router make the forecasts.

    With --expect the command is a test: it passes if the forecasts are those of an earlier replay (--out or --update).
    A tolerance is in the unit of its field; % of a field that is not in % is relative to the expected value.

    With --foxglove the file of --out replays like the original: socast reads nothing that was added for the viewer.

    Examples
    --------
    socast replay recordings/shift.mcap
    socast replay recordings/shift.mcap --out viewed.mcap --foxglove
    socast replay recordings/shift.mcap --expect expected.mcap
    socast replay today.mcap --warm-up december.mcap --model fitted.json --json rides.json
    socast replay recordings/shift.mcap --connect tcp/127.0.0.1:7447 --speed 60
    """
    local = (
        in_process,
        out,
        foxglove,
        expect,
        json_file,
        options.models,
        options.effect_files,
        options.warm_up,
        options.elevation,
    )
    publishes = bool(connect or config)
    refuse(
        (
            publishes and (any(local) or options.settings != Settings()),
            (
                f"{'--connect' if connect else '--config'} only publishes and makes no forecasts; leave out "
                "--in-process, --out, --foxglove, --expect, --json, --model, --effects, --warm-up, --elevation and "
                "settings of cleaning"
            ),
        ),
        (foxglove and out is None, "--foxglove adds to what --out records: give --out F.mcap too"),
        (
            expect is None and (update or tolerance),
            "--update and --tolerance belong to --expect: give --expect F.mcap too",
        ),
    )
    expectation = _Expectation.prepare(expect, tolerance or (), update=update) if expect else None
    layout = out.with_suffix(".layout.json") if out and foxglove else None
    zone = find_zone(time_zone, make_console(json_file))
    prefix = parse_prefix(options.prefix)
    rate = parse_speed(pace or ("1" if publishes else "max"))
    sources = open_recordings(recordings)
    inputs = [source.path for source in sources]
    check_outputs([*inputs, *options.files], out, json_file, layout, *([expect] if update else []))
    differs = False
    with stop_on_signals() as stop:
        source = stop_source(pace_source(merge_sources(sources), rate, longest_gap_s=longest_gap), stop)
        if publishes:
            joined = Connection((connect,) if connect else (), mode="client", config=config)
            log_lines(level=logging.WARNING)
            with Node(joined) as node, ZenohDelivery(node, prefix) as delivery:
                _publish(source, delivery, sources, stop, connect or f"the router of {config}")
        elif expectation is None:
            report = _forecast(source, sources, rate, options, out, layout, zone)
            write_json(json_file, "replay", report.result)
            report.show(make_console(json_file), layout, zone)
        else:
            with expectation.open_replacement() as fresh, TemporaryDirectory() as folder:
                made = out or fresh or Path(folder) / "forecasts.mcap"
                report = _forecast(source, sources, rate, options, made, layout, zone)
                if stop.is_set():
                    raise SettingsError(f"stopped before the end: {expect} needs the whole replay and is as it was")
                comparison = expectation.compare(made)
                if fresh and out:
                    shutil.copyfile(out, fresh)
            write_json(json_file, "replay", report.result | make_record(comparison))
            expectation.show(comparison, make_console(json_file))
            differs = not (update or isinstance(comparison, str) or comparison.is_equal)
    warn_of_losses(sources)
    if differs:
        raise typer.Exit(1)


@dataclass(frozen=True)
class _Expectation:
    """Hold the file of --expect and what was read of it; nothing is read where the file is to be written."""

    file: Path
    tolerances: Tolerances
    wanted: pd.DataFrame | None

    @classmethod
    def prepare(cls, file: Path, tolerance: Sequence[str], *, update: bool) -> "_Expectation":
        """Report mistakes before the replay."""
        tolerances = parse_tolerances(tolerance)
        resolve_tolerances(tolerances, FORECAST_COLUMNS)
        if update:
            refuse_replacing(file)
            return cls(file, tolerances, None)
        if not file.is_file():
            raise SettingsError(f"{file}: does not exist; write it with --update")
        return cls(file, tolerances, read_expected(file, "--update"))

    def open_replacement(self) -> AbstractContextManager[Path | None]:
        """Return the context in which the file is written whole, if it is to be written."""
        return nullcontext() if self.wanted is not None else replacing(self.file)

    def compare(self, made: Path) -> TableComparison | str:
        """Return how the forecasts differ from those of the file, or why nothing can be compared."""
        if self.wanted is not None:
            return compare_forecasts(self.wanted, made, self.tolerances)
        refuse_nothing(made)
        return compare_with_old(self.file, lambda file: compare_recordings(file, made, self.tolerances))

    def show(self, comparison: TableComparison | str, console: Console) -> None:
        """Print whether forecasts are as expected, or what an update has changed."""
        if self.wanted is None or isinstance(comparison, str):
            print_plain(console, describe_update(self.file, comparison))
            return
        show_comparison(comparison, console)
        if not comparison.compared:
            console.print(NOTHING_COMMON, highlight=False, soft_wrap=True)


@dataclass(frozen=True)
class _Report:
    """Hold the result of a replay for JSON, and what its tables show beside it."""

    result: dict[str, Any]
    rides: pd.DataFrame
    quality: dict[str, Any]
    errors: Sequence[ModelErrors]
    models: Sequence[LinearModel]
    advice: str | None

    def show(self, console: Console, layout: Path | None, zone: tzinfo | None) -> None:
        """Print the tables of rides, models and shifts, and what was wrong with the telemetry."""
        show_rides(console, self.rides, self.quality, zone)
        if self.errors:
            show_models(console, self.errors, self.models, self.rides)
        show_outcomes(console, self.result["shifts"], zone)
        if self.advice:
            print_plain(console, self.advice, wraps=True)
        if layout:
            print_plain(console, f"layout for Foxglove in {layout}")
        warn_outside(self.quality)
        warn_of_loggers(self.quality)


def _forecast(
    source: Source,
    sources: Sequence[McapSource],
    rate: float,
    options: ForecastOptions,
    out: Path | None,
    layout: Path | None,
    zone: tzinfo | None,
) -> _Report:
    """Pass recordings through the models, and return the report."""
    models = load_models(options.models)
    pipeline = make_pipeline(options, models, replayed=sources, keep_outlooks=True)
    outcomes = ShiftOutcomes(pipeline)
    sinks: list[Sink] = []
    viewed: FoxgloveRecording | None = None
    with ExitStack() as writing:
        if out:
            metadata, schemas = describe_forecasts("replay", options, models), SCHEMAS if layout else {}
            sink = writing.enter_context(replace_recording(out, metadata=metadata, viewer_schemas=schemas))
            if layout:
                viewed = FoxgloveRecording(sink)
                source = viewed.record_source(source)
            sinks.append(viewed or sink)
        run_forecasts(pipeline, sources, source, rate, sinks, outcomes, zone)
    if layout and viewed:
        viewed.write_layout(layout)
    quality = pipeline.quality()
    refuse_unusable(sources, sum(quality["received"].values()))
    rides = add_predictions(pipeline.take_rides(), pipeline.shadows)
    result: dict[str, Any] = {"rides": make_ride_records(rides), "shifts": outcomes.records()}
    errors = pipeline.shadows.errors() if len(models) > 1 else []
    if errors:
        result["models"] = make_records(errors)
    advice = advise_fit(models[0], " ".join(str(source.path) for source in sources))
    return _Report(result, rides, quality, errors, models, advice)


def _publish(
    source: Source, delivery: ZenohDelivery, sources: Sequence[McapSource], stop: Event, endpoint: str
) -> None:
    """Publish recordings as soon as there is a subscriber, or after `SUBSCRIBER_S` without one."""
    console = Console(stderr=True)
    deadline = time.monotonic() + SUBSCRIBER_S
    while not (subscribed := delivery.has_subscriber()) and not stop.is_set():
        if time.monotonic() > deadline:
            console.print(f"no subscriber at {endpoint}; publishing anyway", style="yellow", highlight=False)
            break
        time.sleep(0.05)
    count = 0
    began = time.monotonic()
    with show_progress(sources) as step:
        for messages in source:
            if messages and not delivery.deliver(messages, stop):
                break
            count += len(messages)
            step()
    if subscribed and not stop.is_set() and not delivery.has_subscriber():
        console.print(
            f"the subscriber at {endpoint} is gone and missed the last messages", style="yellow", highlight=False
        )
    refuse_unusable(sources, count)
    console.print(f"published {format_count(count, 'message')} in {time.monotonic() - began:.1f} s", highlight=False)
