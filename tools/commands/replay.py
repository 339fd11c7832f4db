"""`socast replay`: recorded shifts once more, through the model or to a router."""

import time
from collections.abc import Sequence
from math import inf
from pathlib import Path
from threading import Event
from typing import Annotated

import typer
from rich.console import Console

from core.errors import SettingsError
from core.pipeline import Pipeline
from core.settings import Settings
from stream.loop import stopping
from stream.mcap_writer import McapSink, McapSource
from stream.source import Source, merged, paced, until
from stream.zenoh_pubsub import ZenohSink
from stream.zenoh_session import Connection, Node, key_prefix
from tools.terminal.cleaning_options import cleaned
from tools.terminal.live_table import ride_records, show_rides, with_predictions
from tools.terminal.model_comparison import ModelNames, loaded, records, show_models
from tools.terminal.output import EffectFiles, JsonFile, model_files, printer, speed, writable, write_json
from tools.terminal.recordings import Recordings, forecast, opened, reading, warn_of_losses
from tools.terminal.shift_outcomes import Outcomes, show_outcomes
from tools.terminal.warm_up import History, learned

HEARD_S = 10.0
"""How long to wait for somebody to subscribe before publishing all the same. [s]"""


@cleaned
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
    in_process: Annotated[bool, typer.Option("--in-process", help="Run the model here. [default]")] = False,
    model: ModelNames = None,
    effects_file: EffectFiles = None,
    settings: Settings,
    prefix: Annotated[
        str, typer.Option(metavar="P", help="Key chunks to put before the recorded keys, or the forecasts'.")
    ] = "",
    longest_gap: Annotated[
        float, typer.Option(metavar="S", help="Shorten silences of the recording to this many seconds.")
    ] = inf,
    out: Annotated[
        Path | None, typer.Option(metavar="F.mcap", help="Record the forecasts, and how several models fare.")
    ] = None,
    history: History = None,
    json_file: JsonFile = None,
) -> None:
    """Replay recordings, merged in time order.

    In process, they go through the same loop as live telemetry does, and the ride table compares predicted with
    measured energy; of several models the first makes the forecasts, and how each fared is told below. Then comes what
    was forecast of each shift's end, and what became of it. With --connect they are published, and whoever listens at
    the router makes the forecasts.
    """
    if connect and (in_process or out or json_file or effects_file or history or settings != Settings()):
        raise SettingsError(
            "--connect publishes, forecasts nothing; leave out --in-process, --out, --json, --effects, --history "
            "and the settings of cleaning"
        )
    before = key_prefix(prefix)
    rate = speed(pace or ("1" if connect else "max"))
    sources = opened(recordings)
    writable([*recordings, *(history or ()), *model_files(model or ()), *(effects_file or ())], out, json_file)
    console = printer()
    with stopping() as stop:
        source = until(paced(merged(sources), rate, longest_gap_s=longest_gap), stop)
        if connect:
            with Node(Connection(connect=(connect,))) as node:
                sink = ZenohSink(node, before)
                _publish(source, sink, sources, stop, connect)
        else:
            chosen, *shadows = known = loaded(model)
            pipeline = Pipeline(chosen, settings, before, shadows=shadows, keep_outlooks=True)
            if earlier := learned(chosen, shadows, settings, history, replayed=sources):
                pipeline.learn_from(earlier)
            outcomes = Outcomes(pipeline)
            forecast(pipeline, sources, source, rate, [McapSink(out)] if out else [], outcomes)
            rides = with_predictions(pipeline.take_rides(), pipeline.shadows)
            result = {"rides": ride_records(rides), "shifts": outcomes.records()}
            show_rides(console, rides, pipeline.quality())
            if shadows:
                told = pipeline.shadows.errors()
                show_models(console, told, known, rides)
                result["models"] = records(told)
            show_outcomes(console, result["shifts"])
            write_json(json_file, result)
    warn_of_losses(sources)


def _publish(source: Source, sink: ZenohSink, sources: Sequence[McapSource], stop: Event, endpoint: str) -> None:
    """Publish recordings, once somebody listens."""
    console = Console(stderr=True)
    deadline = time.monotonic() + HEARD_S
    while not (heard := sink.heard()) and not stop.is_set():
        if time.monotonic() > deadline:
            console.print(f"nobody listens at {endpoint}; publishing all the same", style="yellow", highlight=False)
            break
        time.sleep(0.05)
    count = 0
    began = time.monotonic()
    with reading(sources) as step:
        for messages in source:
            sink.put(messages)
            count += len(messages)
            step()
    if heard and not sink.heard():
        console.print(
            f"whoever listened at {endpoint} has gone; what was published since is lost to them",
            style="yellow",
            highlight=False,
        )
    sink.close()
    console.print(f"published {count:,} messages in {time.monotonic() - began:.1f} s", highlight=False)
