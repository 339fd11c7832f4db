"""`socast evaluate-soc`: forecasts of the state of charge at the shift's end against what it became."""

from math import inf
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from core import effects, models
from core.evaluate.results import plain
from core.evaluate.soc import evaluate_soc
from core.pipeline import Pipeline
from stream.mcap_io import McapSource
from stream.source import merged
from tools.cleaning import (
    LEAST_DISTANCE_KM,
    PERIOD_S,
    SMOOTHING,
    SPEED_LIMIT_KMH,
    LeastDistance,
    Period,
    Smoothing,
    SpeedLimit,
    cleaning,
)
from tools.output import (
    EffectFiles,
    JsonFile,
    ModelName,
    Recordings,
    model_files,
    printer,
    warn_of_losses,
    writable,
    write_json,
)
from tools.replay import forecast
from tools.standings import USUAL


def evaluate_recordings(
    recordings: Recordings,
    model: ModelName = USUAL,
    effects_file: EffectFiles = None,
    speed_limit_kmh: SpeedLimit = SPEED_LIMIT_KMH,
    period_s: Period = PERIOD_S,
    smoothing: Smoothing = SMOOTHING,
    least_distance_km: LeastDistance = LEAST_DISTANCE_KM,
    json_file: JsonFile = None,
    html_file: Annotated[
        Path | None, typer.Option("--html", metavar="FILE", help="Write a report with figures.")
    ] = None,
) -> None:
    """Judge forecasts of the state of charge at the shift's end by what it became, and by what a person would expect.

    Recordings go through the same loop as live telemetry does, merged in time order. What is learned of the fleet is
    learned on the way, so each forecast rests on nothing that came after it.
    """
    settings = cleaning(speed_limit_kmh, period_s, smoothing, least_distance_km)
    sources = [McapSource(path) for path in recordings]
    writable([*recordings, *model_files([model]), *(effects_file or ())], json_file, html_file)
    for path in effects_file or ():
        effects.load_file(path)
    pipeline = Pipeline(models.load(model), settings, keep_tables=False, keep_outlooks=True)
    forecast(merged(sources), pipeline, sources, inf)
    warn_of_losses(sources, Console(stderr=True))
    result = plain(evaluate_soc(pipeline.take_outlooks(), pipeline.take_shifts()))
    write_json(json_file, result)
    _report(result, html_file)


def _report(result: dict[str, Any], html_file: Path | None) -> None:
    """Print the tables, and write the page."""
    from tools.report import soc  # noqa: PLC0415 - figures take seconds to import

    console = printer()
    soc.show(result, console)
    if html_file:
        soc.write(result, html_file)
        console.print(f"report in {html_file}", markup=False, highlight=False, soft_wrap=True)
