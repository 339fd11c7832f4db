"""`socast demo`: forecast a recorded shift over Zenoh, as in live operation, in less than a minute."""

import logging
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Final

import typer
from rich.console import Console

from socast.core.errors import SettingsError, SocastError
from socast.core.models import LinearModel
from socast.core.pipeline import Pipeline
from socast.core.settings import Settings
from socast.stream.loop import PUBLISH_S, Tally, combine_watches, run
from socast.stream.mcap_reader import McapSource
from socast.stream.structured_log import log_lines
from socast.stream.zenoh_session import Connection, Node
from socast.stream.zenoh_sink import LatestOnlySink, ZenohSink
from socast.stream.zenoh_source import ZenohSource
from socast.tools.commands.info import describe_recording
from socast.tools.terminal.demo_verdict import (
    AlarmWatch,
    compute_errors_pct,
    list_next_commands,
    make_car_records,
    read_findings,
    show_cars,
    show_end,
    write_verdict,
)
from socast.tools.terminal.forecast_options import learn_from_recordings
from socast.tools.terminal.kernels import compile_kernels
from socast.tools.terminal.live_table import LiveTable, add_predictions, make_ride_records
from socast.tools.terminal.model_comparison import DEFAULT_MODEL, ModelNames, advise_fit, find_models, load_models
from socast.tools.terminal.output import JsonFile, check_outputs, make_console, write_json
from socast.tools.terminal.shift_outcomes import ShiftOutcomes
from socast.tools.terminal.stop_signals import stop_on_signals
from socast.tools.terminal.time_zone import TimeZone, find_zone

RECORDINGS: Final = Path(__file__).parents[2] / "recordings"
SHIFT: Final = RECORDINGS / "evening.mcap"
"""The shift that is part of socast; it ends badly for some of its cars."""
HISTORY: Final = RECORDINGS / "history.mcap"
"""Shifts of the same cars on the days before, from which the forecasts learn."""
TUTORIAL: Final = RECORDINGS / "autumn.mcap"
"""Recording with a hidden effect."""
QUIET_S: Final = 2.0
"""Time without messages, after the publisher has ended, after which the demonstration stops. [s]"""


def demo(
    recording: Annotated[
        Path | None,
        typer.Argument(
            metavar="[REC]",
            help="Recording to publish. [default: the shift that comes with socast, with its history]",
            show_default=False,
        ),
    ] = None,
    seconds: Annotated[float, typer.Option(min=1.0, metavar="S", help="Duration of the demonstration.")] = 35.0,
    model: ModelNames = None,
    time_zone: TimeZone = None,
    json_file: JsonFile = None,
) -> None:
    """Show a recorded shift as if it were live.

    A router opens on loopback, another process publishes the recording through it faster than real time, and the live
    consumer forecasts what arrives. The end compares forecasts and models with what the cars measured, and names three
    commands to go on with.

    Examples
    --------
    socast demo
    socast demo my-shift.mcap --seconds 60 --model basic_physical
    """
    log_lines(level=logging.WARNING)
    own = recording is not None
    shift = recording or SHIFT
    if not own and (missing := [file for file in (SHIFT, HISTORY) if not file.exists()]):
        raise SettingsError(
            f"{missing[0]} does not exist; give a recording: socast demo REC, made by `socast simulate`"
        )
    source_file = McapSource(shift)
    check_outputs([shift], json_file)
    about = describe_recording(source_file)
    console = make_console(json_file)
    zone = find_zone(time_zone, console)
    chosen = load_models(model or [*find_models(None, shift.parent), DEFAULT_MODEL])

    def report(compiled: int, total: int) -> None:
        words = f"compiling kernels, once after installation: {compiled} of {total}"
        console.print(words, style="dim", highlight=False)

    compile_kernels(*chosen, report=report)
    speed = max(1.0, about["duration_s"] / seconds)
    pipeline = Pipeline(chosen[0], shadows=chosen[1:], keep_outlooks=True)
    if not own and (earlier := learn_from_recordings(chosen[0], chosen[1:], Settings(), [HISTORY])):
        pipeline.learn_from(earlier)
    hours, cars = about["duration_s"] / 3600, len(about["vehicles"])
    title = f"{shift.name}: {hours:.1f} h of {cars} cars, {speed:.0f} times real time"
    table = LiveTable(pipeline, title, console=console, zone=zone, shows_models=False)
    alarms = AlarmWatch(pipeline, about["messages"] // 2)
    missed = _run(pipeline, shift, about["messages"], speed, table, alarms)
    _show_results(console, pipeline, chosen, shift, missed, json_file, alarms.list_sentences(zone))


def _run(pipeline: Pipeline, shift: Path, messages: int, speed: float, table: LiveTable, alarms: AlarmWatch) -> int:
    """Publish a recording in another process, receive it, and return the number of messages that were missed."""
    with stop_on_signals() as stop, Node(Connection(listen=("tcp/127.0.0.1:0",), mode="router")) as node:
        source = ZenohSource(node, stop)
        command = [sys.executable, "-m", "socast", "replay", str(shift), "--connect", node.endpoints[0]]
        with (
            subprocess.Popen(  # noqa: S603 - our own command
                [*command, "--speed", f"{speed:g}"], stderr=subprocess.PIPE, text=True
            ) as publisher,
            table,
        ):
            try:
                run(
                    source,
                    pipeline,
                    [LatestOnlySink(ZenohSink(node))],
                    publish_s=PUBLISH_S,
                    watch=combine_watches(table, alarms, _stop_at_end(publisher, messages, stop.set)),
                )
            finally:
                publisher.terminate()
            failure = (publisher.communicate()[1] or "").strip() if publisher.wait() not in {0, 130, -15} else ""
    if failure:
        raise SocastError(f"the publisher failed: {failure.splitlines()[-1]}")
    return source.missed or 0


def _show_results(
    console: Console,
    pipeline: Pipeline,
    chosen: Sequence[LinearModel],
    shift: Path,
    missed: int,
    json_file: Path | None,
    alarms: Sequence[str],
) -> None:
    """Print how the cars fared, the alarms, the verdict and the next commands."""
    rides, outcomes = add_predictions(pipeline.take_rides(), pipeline.shadows), ShiftOutcomes(pipeline)
    labels = [monitor.label for monitor in pipeline.shadows.monitors] or [chosen[0].name]
    shifts = outcomes.records()
    cars = make_car_records(rides, shifts, labels)
    write_json(json_file, "demo", {"rides": make_ride_records(rides), "cars": cars, "missed": missed})
    if cars:
        show_cars(console, cars, labels)
        verdict = write_verdict(
            cars, compute_errors_pct(rides, labels), chosen[0], pipeline.quality() | {"missed": missed}
        )
    else:
        verdict = ["Energy: no ride ended that is fit for training."]
    recording, tutorial, history = (Path(os.path.relpath(each.resolve())) for each in (shift, TUTORIAL, HISTORY))
    learned = history if shift == SHIFT else None
    commands = list_next_commands(recording, tutorial, learned, has_workbench=find_spec("uvicorn") is not None)
    if advice := advise_fit(chosen[0], str(recording)):
        verdict.append(f"Model: {advice}.")
    show_end(console, [*alarms, *read_findings(McapSource(shift)), *verdict], commands)


def _stop_at_end(publisher: subprocess.Popen[str], messages: int, stop: Callable[[], None]) -> Callable[[Tally], None]:
    """Return a watch that stops the loop after the last message, or `QUIET_S` after the publisher has ended."""
    received, since = 0, time.monotonic()

    def watch(tally: Tally) -> None:
        nonlocal received, since
        if tally.received >= messages:
            stop()
        elif tally.received != received:
            received, since = tally.received, time.monotonic()
        elif publisher.poll() is not None and time.monotonic() - since > QUIET_S:
            stop()

    return watch
