"""`socast demo`: a recorded shift over Zenoh, as in service, in under a minute."""

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
from stream.latest_only_sink import Outbox
from stream.loop import PUBLISH_S, Tally, run, stopping
from stream.mcap_writer import McapSource
from stream.structured_log import write_lines
from stream.zenoh_pubsub import ZenohSink, ZenohSource
from stream.zenoh_session import Connection, Node
from tools.commands.info import described
from tools.commands.live import both, warm_up
from tools.terminal.live_table import Screen, ride_records, show_rides, with_predictions
from tools.terminal.model_comparison import USUAL
from tools.terminal.output import JsonFile, ModelName, printer, writable, write_json

SHIFT = Path(__file__).parents[2] / "recordings" / "shift.mcap"
"""The recording that comes with the product."""
QUIET_S = 2.0
"""Silence after the publisher has ended that means nothing more will come. [s]"""


def demo(
    recording: Annotated[
        Path, typer.Argument(metavar="[REC]", help="Recording to publish. [default: the shift that comes with socast]")
    ] = SHIFT,
    seconds: Annotated[float, typer.Option(min=1.0, metavar="S", help="How long it shall take.")] = 35.0,
    model: ModelName = USUAL,
    json_file: JsonFile = None,
) -> None:
    """Watch a recorded shift as if it were live.

    A router opens on loopback, another process publishes the recording through it at a speed-up, and the live consumer
    forecasts what arrives. At the end, every ride's prediction is held against what the car measured.
    """
    write_lines(level=logging.WARNING)
    if recording == SHIFT and not SHIFT.exists():
        raise SettingsError(f"{SHIFT} is not there; give a recording: socast demo REC, made by `socast simulate`")
    source_file = McapSource(recording)
    writable([recording], json_file)
    about = described(source_file)
    console = printer()
    chosen = models.load(model)
    console.print("preparing: what is compiled is compiled once", style="dim", highlight=False)
    warm_up(chosen)
    speed = max(1.0, about["duration_s"] / seconds)
    console.print(
        f"{recording.name}: {about['messages']:,} messages of {len(about['vehicles'])} cars over "
        f"{about['duration_s'] / 3600:.1f} h, published at {speed:.0f} times real time",
        highlight=False,
    )
    pipeline = Pipeline(chosen)
    with stopping() as stop, Node(Connection(listen=("tcp/127.0.0.1:0",), mode="router")) as node:
        source = ZenohSource(node, stop)
        command = [sys.executable, "-m", "socast", "replay", str(recording), "--connect", node.endpoints[0]]
        with (
            subprocess.Popen(  # noqa: S603 - our own command
                [*command, "--speed", f"{speed:g}"], stderr=subprocess.PIPE, text=True
            ) as publisher,
            Screen(pipeline, f"Live, {speed:.0f} times real time", console=console) as screen,
        ):
            try:
                run(
                    source,
                    pipeline,
                    [Outbox(ZenohSink(node))],
                    publish_s=PUBLISH_S,
                    watch=both(screen, _ending(publisher, about["messages"], stop.set)),
                )
            finally:
                publisher.terminate()
            failure = (publisher.communicate()[1] or "").strip() if publisher.wait() not in {0, -15} else ""
    if failure:
        raise SocastError(f"the publisher failed: {failure.splitlines()[-1]}")
    rides = with_predictions(pipeline.take_rides(), pipeline.shadows)
    show_rides(console, rides, pipeline.quality())
    console.print(f"{source.missed:,} of the messages sent were missed on the way", highlight=False)
    write_json(json_file, ride_records(rides))


def _ending(publisher: subprocess.Popen[str], messages: int, stop: Callable[[], None]) -> Callable[[Tally], None]:
    """Return a watch that stops once all has come, or the publisher has ended and nothing has come for a while."""
    heard = [0, time.monotonic()]

    def watch(tally: Tally) -> None:
        if tally.received >= messages:
            stop()
        elif tally.received != heard[0]:
            heard[:] = [tally.received, time.monotonic()]
        elif publisher.poll() is not None and time.monotonic() - heard[1] > QUIET_S:
            stop()

    return watch
