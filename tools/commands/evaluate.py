"""`socast evaluate`: evaluate every model on held-out rides, as the paper does and beyond the paper."""

import time
from collections.abc import Collection
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import joblib
import typer
from msgspec.structs import replace
from rich.progress import MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from socast.core.errors import SettingsError
from socast.core.evaluate.paper.protocol import SEGMENTS, tabulate_runs
from socast.core.evaluate.paper.records import RecipeEvaluation
from socast.core.evaluate.paper.runs import run_in_parallel
from socast.core.evaluate.paper.selection import MARGIN
from socast.core.fit import segment_network
from socast.core.fit.recipes import RECIPES
from socast.core.fit.window_recipe import WindowRecipe
from socast.core.stats.splits import REPEATS
from socast.tools.cluster.dask_runner import ClusterPlace
from socast.tools.cluster.evaluation import EvaluationJob, evaluate_by_workers, plan_job
from socast.tools.cluster.workers import open_workers
from socast.tools.terminal.cluster_option import insert_cluster_options
from socast.tools.terminal.output import HtmlFile, JsonFile, write_json
from socast.tools.terminal.progress import show_bar
from socast.tools.terminal.report_output import show_report
from socast.tools.terminal.ride_source import WINDOWS, RideSource, insert_ride_source
from socast.tools.terminal.table_files import KEY, is_table

LEAST_REPEATS = 2
"""Smallest number of repeats that gives an interval."""


@insert_cluster_options
@insert_ride_source
def evaluate_tables(
    *,
    source: RideSource,
    json_file: JsonFile = None,
    html_file: HtmlFile = None,
    seed: Annotated[int, typer.Option(help="Seed of splits and draws; the same seed gives the same result.")] = 0,
    repeats: Annotated[int, typer.Option(help="Number of splits by ride.")] = REPEATS,
    recipes: Annotated[
        str | None,
        typer.Option(metavar="A,B", help=f"Only these of {', '.join(RECIPES)}, {SEGMENTS}.", show_default=False),
    ] = None,
    leave_out_of_training: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KEY",
            help="Vehicle model that is never trained on to predict new vehicle models; give it again for more. "
            "The paper leaves out nissan-leaf.",
            show_default=False,
        ),
    ] = None,
    removal_margin: Annotated[
        float,
        typer.Option(
            metavar="PERCENT",
            min=0.0,
            max=100.0,
            help="Terms of the hybrid model count as removable while the error without them is shown to be larger by "
            "at most this share.",
        ),
    ] = 100.0 * MARGIN,
    jobs: Annotated[
        int | None, typer.Option(help="Number of processes; all cores by default.", show_default=False)
    ] = None,
    place: ClusterPlace | None,
) -> None:
    """Evaluate models on held-out rides of tables, as the paper does (Tables 2 to 13), and beyond the paper.

    Every model is trained and tested on the same splits by ride, by vehicle and by date, on vehicle models left out of
    training, and on a few rides of these. The segment model takes part where a window table is beside the rides.

    Examples
    --------
    socast evaluate tables --html report.html --json result.json
    socast evaluate tables --recipes fitted_physical,hybrid --repeats 5 --jobs 2
    socast evaluate tables --leave-out-of-training nissan-leaf
    socast evaluate tables --cluster tls://scheduler.example:8786
    """
    began = time.perf_counter()
    for name, value, least in (("--repeats", repeats, LEAST_REPEATS), ("--jobs", jobs, 1), ("--seed", seed, 0)):
        if value is not None and value < least:
            raise SettingsError(f"{name} is {value}; give {least} or more")
    source.check(json_file, html_file)
    named = RECIPES if recipes is None else [name.strip() for name in recipes.split(",")]
    with source.open_tables((), place if source.is_recorded else None, always=True) as made:
        files = made.files
        beside = [file.with_name(WINDOWS) for file in files]
        job = EvaluationJob(
            tuple(file.resolve() for file in files),
            tuple(file.resolve() for file in beside) if all(map(is_table, beside)) else (),
            tuple(window_columns(named)),
            recipes,
            seed,
            repeats,
            tuple(leave_out_of_training or ()),
            removal_margin / 100.0,
            tuple(file.resolve() for file in source.vehicle_files),
        )
        result = _evaluate(job, jobs, place)
    seconds = round(time.perf_counter() - began, 1)
    result = replace(result, about=replace(result.about, seconds=seconds))
    write_json(json_file, "evaluate", result.to_json())
    show_report("evaluation.page", result, html_file, json_file)


def window_columns(names: Collection[str] = ()) -> list[str]:
    """Return the columns of the window table that the evaluation reads."""
    of_segments = (name for product in segment_network.SEGMENT_FEATURES for name in product)
    chosen = (RECIPES[name] for name in names if name in RECIPES)
    of_recipes = (name for recipe in chosen if isinstance(recipe, WindowRecipe) for name in recipe.columns)
    return list(dict.fromkeys([KEY, "window", *of_segments, *of_recipes]))


def _evaluate(job: EvaluationJob, jobs: int | None, place: ClusterPlace | None) -> RecipeEvaluation:
    """Return the evaluation, by processes of this command or by workers."""
    if place is None:
        plan = plan_job(job)
        columns = (MofNCompleteColumn(), TextColumn("runs"), TimeElapsedColumn(), TimeRemainingColumn())
        with show_bar("evaluating", *columns, total=None) as step:
            return tabulate_runs(plan, run_in_parallel(plan.calls, jobs or joblib.cpu_count(), step))
    if jobs is not None:
        raise SettingsError("--jobs and --cluster both say how many processes work; give one of the two")
    with (
        TemporaryDirectory(prefix="evaluation-", dir=Path.cwd() if place.address else None) as folder,
        open_workers(place, Path(folder), "evaluation") as workers,
    ):
        return evaluate_by_workers(job, workers)
