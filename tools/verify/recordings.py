"""Run recordings through the pipeline, and compare its filters with filterpy's on the way."""

from collections.abc import Callable, Sequence
from pathlib import Path

from socast.core.models import Model
from socast.core.pipeline import Pipeline
from socast.core.settings import Settings
from socast.stream.elevation_files import open_elevation
from socast.stream.loop import collect_garbage_rarely, feed
from socast.stream.mcap_reader import McapSource
from socast.stream.source import merge_sources
from socast.tools.terminal.recordings import refuse_unusable
from socast.tools.verify.elevation_steps import ElevationSteps
from socast.tools.verify.records import GOAL, FilterDifference, Verification
from socast.tools.verify.soc_steps import SocSteps


@collect_garbage_rarely()
def verify_filters(
    sources: Sequence[McapSource],
    model: Model,
    settings: Settings,
    elevation: Sequence[Path],
    step: Callable[[], None] = lambda: None,
) -> Verification:
    """Return how far the filters are from filterpy's, with the forecasts of a model and the elevation of tables."""
    filters = (
        verify_soc(sources, model, settings, elevation, step),
        verify_elevation(sources, settings, elevation, step),
    )
    return Verification(goal=GOAL, filters=list(filters))


def verify_soc(
    sources: Sequence[McapSource],
    model: Model,
    settings: Settings,
    elevation: Sequence[Path],
    step: Callable[[], None],
) -> FilterDifference:
    """Return how far the filter of the state of charge is from filterpy's."""
    pipeline = Pipeline(model, settings, keep_tables=False, elevation_map=open_elevation(elevation))
    steps = SocSteps(pipeline.lanes)
    pipeline.engine.filter_events = steps.filter_events
    for _ in feed(merge_sources(sources), pipeline):
        pipeline.forecasts(newest_only=True)
        step()
    refuse_unusable(sources, sum(pipeline.quality()["received"].values()))
    return steps.tallies.summarise("state of charge")


def verify_elevation(
    sources: Sequence[McapSource], settings: Settings, elevation: Sequence[Path], step: Callable[[], None]
) -> FilterDifference:
    """Return how far the smoother of the elevation of rides is from filterpy's."""
    pipeline = Pipeline(
        settings=settings,
        keep_forecasts=False,
        keep_tables=False,
        two_sided=True,
        elevation_map=open_elevation(elevation),
    )
    steps, deferred = ElevationSteps(pipeline.lanes), pipeline.totals.deferred
    assert deferred is not None  # of a pipeline for tables
    deferred.smooth_elevation = steps.smooth_elevation
    for _ in feed(merge_sources(sources), pipeline):
        step()
    return steps.tallies.summarise("elevation of rides")
