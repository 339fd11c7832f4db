"""Run the splits and recipes of an evaluation as tasks: every worker reads the tables once and plans the same runs."""

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from socast.core.evaluate.paper.protocol import EvaluationPlan, plan_evaluation, select_recipes, tabulate_runs
from socast.core.evaluate.paper.records import RecipeEvaluation
from socast.core.evaluate.paper.runs import call_in_one_thread
from socast.core.evaluate.paper.selection import MARGIN
from socast.core.vehicles import add_vehicles
from socast.tools.cluster.workers import Workers
from socast.tools.terminal.table_files import read
from socast.tools.terminal.vehicle_files import load_vehicle_file


@dataclass(frozen=True)
class EvaluationJob:
    """Describe an evaluation, the same for every task.

    Parameters
    ----------
    rides, windows : tuple of Path
        Files of the tables; no windows where a ride table has none beside it.
    recipes : str, optional
        Names of recipes, as on the command line.
    vehicle_files : tuple of Path
        Files that a worker loads before its first task.
    run : str
        What distinguishes this run from later ones over the same files, for workers that outlive it.
    """

    rides: tuple[Path, ...]
    windows: tuple[Path, ...]
    window_columns: tuple[str, ...]
    recipes: str | None
    seed: int
    repeats: int
    left_out_of_training: tuple[str, ...]
    removal_margin: float = MARGIN
    vehicle_files: tuple[Path, ...] = ()
    run: str = ""


def evaluate_by_workers(job: EvaluationJob, workers: Workers) -> RecipeEvaluation:
    """Return the whole evaluation of recipes; its runs are tasks."""
    plan, job = plan_job(job), replace(job, run=str(workers.scratch))
    tasks = [(job, key) for key in plan.calls]
    return tabulate_runs(plan, dict(zip(plan.calls, workers.run("run", run_call, tasks), strict=True)))


def plan_job(job: EvaluationJob) -> EvaluationPlan:
    """Read the tables and plan the runs."""
    windows = read(job.windows, job.window_columns) if job.windows else None
    return plan_evaluation(
        read(job.rides),
        select_recipes(job.recipes, windows, job.seed),
        seed=job.seed,
        repeats=job.repeats,
        left_out_of_training=job.left_out_of_training,
        removal_margin=job.removal_margin,
    )


def run_call(job: EvaluationJob, key: Any) -> Any:
    """Return the result of a run."""
    return call_in_one_thread(_load_plan(job).calls[key])


@lru_cache(maxsize=1)
def _load_plan(job: EvaluationJob) -> EvaluationPlan:
    """Return the plan of an evaluation, which a worker makes once."""
    for file in job.vehicle_files:
        add_vehicles(load_vehicle_file(file))
    return plan_job(job)
