"""`socast demo`: forecast a recorded shift over Zenoh, as in live operation, in less than a minute."""

import logging
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from core import models
from core.errors import SettingsError, SocastError
from core.pipeline import Pipeline
from stream.latest_only_sink import LatestOnlySink
from stream.loop import PUBLISH_S, Tally, run, stop_on_signals
from stream.mcap_reader import McapSource
from stream.structured_log import log_lines
from stream.zenoh_pubsub import ZenohSink, ZenohSource
from stream.zenoh_session import Connection, Node
from tools.commands.info import describe_recording
from tools.commands.live import combine_watches
from tools.terminal.kernels import compile_kernels
from tools.terminal.live_table import LiveTable, add_predictions, make_ride_records, show_rides
from tools.terminal.model_comparison import DEFAULT_MODEL
from tools.terminal.output import JsonFile, ModelName, check_outputs, make_console, write_json

SHIFT = Path(__file__).parents[2] / "recordings" / "shift.mcap"
"""The recording that is part of socast."""
QUIET_S = 2.0
"""Time without messages, after the publisher has ended, after which the demonstration stops. [s]"""


def demo(
    recording: Annotated[
        Path,
        typer.Argument(
            metavar="[REC]",
            help="Recording to publish. [default: the shift that comes with socast]",
            show_default=False,
        ),
    ] = SHIFT,
    seconds: Annotated[float, typer.Option(min=1.0, metavar="S", help="Duration of the demonstration.")] = 35.0,
    model: ModelName = DEFAULT_MODEL,
    json_file: JsonFile = None,
) -> None:
    """Show a recorded shift as if it were live.

    A router opens on loopback, another process publishes the recording through it faster than real time, and the live
    consumer forecasts what arrives. The table at the end compares the prediction of each ride with the measured energy.

    Examples
    --------
    socast demo
    socast demo my-shift.mcap --seconds 60 --model basic_physical
    """
    log_lines(level=logging.WARNING)
    if recording == SHIFT and not SHIFT.exists():
        raise SettingsError(f"{SHIFT} does not exist; give a recording: socast demo REC, made by `socast simulate`")
    source_file = McapSource(recording)
    check_outputs([recording], json_file)
    about = describe_recording(source_file)
    console = make_console(json_file)
    chosen = models.load(model)

    def report(compiled: int, total: int) -> None:
        words = f"compiling kernels, once after installation: {compiled} of {total}"
        console.print(words, style="dim", highlight=False)

    compile_kernels(chosen, report=report)
    speed = max(1.0, about["duration_s"] / seconds)
    console.print(
        f"{recording.name}: {about['messages']:,} messages of {len(about['vehicles'])} cars over "
        f"{about['duration_s'] / 3600:.1f} h, published at {speed:.0f} times real time",
        highlight=False,
    )
    pipeline = Pipeline(chosen)
    with stop_on_signals() as stop, Node(Connection(listen=("tcp/127.0.0.1:0",), mode="router")) as node:
        source = ZenohSource(node, stop)
        command = [sys.executable, "-m", "socast", "replay", str(recording), "--connect", node.endpoints[0]]
        with (
            subprocess.Popen(  # noqa: S603 - our own command
                [*command, "--speed", f"{speed:g}"], stderr=subprocess.PIPE, text=True
            ) as publisher,
            LiveTable(pipeline, f"Live, {speed:.0f} times real time", console=console) as table,
        ):
            try:
                run(
                    source,
                    pipeline,
                    [LatestOnlySink(ZenohSink(node))],
                    publish_s=PUBLISH_S,
                    watch=combine_watches(table, _stop_at_end(publisher, about["messages"], stop.set)),
                )
            finally:
                publisher.terminate()
            failure = (publisher.communicate()[1] or "").strip() if publisher.wait() not in {0, -15} else ""
    if failure:
        raise SocastError(f"the publisher failed: {failure.splitlines()[-1]}")
    rides = add_predictions(pipeline.take_rides(), pipeline.shadows)
    write_json(json_file, "demo", {"rides": make_ride_records(rides)})
    show_rides(console, rides, pipeline.quality())
    console.print(f"{source.missed:,} of the messages sent were not received", highlight=False)


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
