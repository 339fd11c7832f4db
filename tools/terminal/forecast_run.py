"""The function that passes recordings through the loop of live telemetry, with progress in the terminal."""

from collections.abc import Callable, Sequence
from datetime import UTC, tzinfo
from math import inf

from socast.core.pipeline import Pipeline
from socast.stream.loop import Tally, run
from socast.stream.mcap_reader import McapSource
from socast.stream.source import Sink, Source, merge_sources
from socast.tools.terminal.live_table import LiveTable
from socast.tools.terminal.recordings import show_progress


def run_forecasts(
    pipeline: Pipeline,
    sources: Sequence[McapSource],
    source: Source | None = None,
    rate: float = inf,
    sinks: Sequence[Sink] = (),
    also: Callable[[], None] = lambda: None,
    zone: tzinfo | None = UTC,
) -> Tally:
    """Pass recordings through the loop, with a progress bar at full speed and a table of cars at any other speed.

    Parameters
    ----------
    source : Source, optional
        Messages of the recordings, for example paced. By default they are merged in time order.
    """
    shown = LiveTable(pipeline, "Replay", silent=rate == inf, zone=zone)
    with show_progress(sources, shown=rate == inf) as step, shown as table:

        def watch(tally: Tally) -> None:
            step()
            also()
            table(tally)

        return run(merge_sources(sources) if source is None else source, pipeline, sinks, watch=watch)
