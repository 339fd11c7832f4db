"""Recordings through the same loop as live telemetry, with progress in the terminal."""

from collections.abc import Callable, Sequence
from math import inf

from core.pipeline import Pipeline
from stream.loop import Tally, run
from stream.mcap_reader import McapSource
from stream.source import Sink, Source, merge_sources
from tools.terminal.live_table import LiveTable
from tools.terminal.recordings import show_progress


def run_forecasts(
    pipeline: Pipeline,
    sources: Sequence[McapSource],
    source: Source | None = None,
    rate: float = inf,
    sinks: Sequence[Sink] = (),
    also: Callable[[], None] = lambda: None,
) -> Tally:
    """Run recordings through the loop, with a progress bar at full speed and a table of cars at any other.

    Parameters
    ----------
    pipeline : Pipeline
        It holds the rides afterwards.
    sources : sequence of McapSource
        The recordings.
    source : Source, optional
        Their messages, where they are more than merged in time order: paced, for example.
    rate : float
        Speed of the replay in times real time; `inf` is as fast as possible.
    sinks : sequence of Sink
        Take the forecasts.
    also : callable
        Called after each list of messages.

    Returns
    -------
    Tally
        Counts of what went through.
    """
    with show_progress(sources, shown=rate == inf) as step, LiveTable(pipeline, "Replay", silent=rate == inf) as table:

        def watch(tally: Tally) -> None:
            step()
            also()
            table(tally)

        return run(merge_sources(sources) if source is None else source, pipeline, sinks, watch=watch)
