"""Run the whole evaluation: sections 3 to 5 of the paper on a ride table, and analyses beyond the paper.

`evaluate` draws the splits, runs every recipe on each of them in parallel, and returns the result. The same seed gives
the same result for any number of processes.
"""

from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pandas as pd
from msgspec.structs import replace

from socast.core.errors import ModelError, SettingsError, suggest_names
from socast.core.evaluate.paper import breakdown, new_vehicle, results, selection
from socast.core.evaluate.paper.breakdown import compute_figure_1
from socast.core.evaluate.paper.records import IntervalCoverage, RecipeEvaluation, RemovableTerms
from socast.core.evaluate.paper.results import (
    HeldOutPredictions,
    average_over_clusters,
    select_comparable,
    tabulate_estimates,
)
from socast.core.evaluate.paper.runs import EvaluatedRecipe, Prediction, Progress, plan_runs, run_in_parallel
from socast.core.evaluate.ride_filter import EvaluatedRides, filter_rides
from socast.core.fit.recipes import RECIPES
from socast.core.fit.segment_network import SegmentRecipe, build_segments
from socast.core.fit.window_recipe import WindowRecipe
from socast.core.models import BUILT_IN_MODELS, HILLS_OF_BUILT_IN
from socast.core.models.features import list_raw_columns
from socast.core.stats.scores import compute_band_shares, compute_bias, compute_coverage, compute_rmse, compute_widening
from socast.core.stats.splits import REPEATS, TEST_SHARE, Split, split_by_date, split_by_ride, split_by_vehicle

SEGMENTS: Final = "segment_network"
"""Name of the reference recipe that needs the window table."""
NO_OTHERS: Final = "no other vehicle model to train on: no error on a new vehicle model"
ONE_CAR: Final = "no vehicle model has two cars: no split by vehicle"
ONE_DATE: Final = "one date only: no split by date"
FEWEST_REPEATS: Final = 8
"""Fewest repeats whose intervals are at most half again as wide as those over many repeats."""

Kind = str
Run = tuple[Kind, Hashable, str]
"""Kind of split, key of the split, and recipe."""


def select_recipes(names: str | None, windows: pd.DataFrame | None, seed: int = 0) -> dict[str, EvaluatedRecipe]:
    """Return recipes by name.

    Parameters
    ----------
    windows : DataFrame, optional
        The window table, which the segment model needs, and to which the recipes of physical terms are fitted.
    """
    known: dict[str, EvaluatedRecipe] = dict(RECIPES)
    if windows is not None:
        for name, recipe in RECIPES.items():
            if isinstance(recipe, WindowRecipe):
                known[name] = recipe.bind(windows)
        known[SEGMENTS] = SegmentRecipe(build_segments(windows), seed)
    if names is None:
        return known
    wanted = dict.fromkeys(name.strip() for name in names.split(",") if name.strip())
    for name in wanted:
        if name == SEGMENTS and windows is None:
            raise SettingsError(f"{SEGMENTS} needs windows.parquet beside the ride table; give the folder that has it")
        if name not in known:
            raise SettingsError(f"recipe {name!r} is unknown; {suggest_names(name, known)}")
    if not wanted:
        raise SettingsError(f"no recipe is named; name some of {', '.join(known)}, with commas between them")
    return {name: known[name] for name in known if name in wanted}


@dataclass(frozen=True)
class EvaluationPlan:
    """Hold the runs of an evaluation; the same rides, recipes and seed give the same plan.

    Parameters
    ----------
    seed, repeats : int
        Seed of splits and draws, and number of splits by ride.
    untrained : collection of str
        Vehicle models whose rides train no model that predicts a new vehicle model.
    calls : dict
        Runs by key, independent of each other; the longest ones come first.
    """

    table: EvaluatedRides
    recipes: Mapping[str, EvaluatedRecipe]
    seed: int
    repeats: int
    untrained: Collection[str]
    splits: Mapping[Kind, Mapping[Any, Split]]
    calls: Mapping[Any, Callable[[], Any]]


def plan_evaluation(
    rides: pd.DataFrame,
    recipes: Mapping[str, EvaluatedRecipe],
    *,
    seed: int = 0,
    repeats: int = REPEATS,
    left_out_of_training: Collection[str] = (),
    removal_margin: float = selection.MARGIN,
) -> EvaluationPlan:
    """Return the runs of an evaluation, see `evaluate`."""
    table = filter_rides(rides)
    _check_columns(recipes, table)
    untrained = new_vehicle.select_untrained(left_out_of_training, table)
    splits = _make_splits(table, seed, repeats, untrained)
    calls: dict[Any, Callable[[], Any]] = {
        (kind, *run): call for kind, own in splits.items() for run, call in plan_runs(recipes, table, own).items()
    }
    few = new_vehicle.plan_learning_curves(new_vehicle.list_learners(recipes), table, splits["new"], seed)
    calls |= {("few", *key): call for key, call in few.items()}
    calls |= {
        ("selection", name): call
        for name, call in selection.plan_selection(table, recipes, seed, removal_margin).items()
    }
    return EvaluationPlan(table, recipes, seed, repeats, untrained, splits, calls)


def evaluate(
    rides: pd.DataFrame,
    recipes: Mapping[str, EvaluatedRecipe],
    *,
    seed: int = 0,
    repeats: int = REPEATS,
    left_out_of_training: Collection[str] = (),
    removal_margin: float = selection.MARGIN,
    jobs: int = 1,
    progress: Progress | None = None,
) -> RecipeEvaluation:
    """Return the whole evaluation of recipes on a ride table.

    Parameters
    ----------
    left_out_of_training : collection of str
        Vehicle models whose rides train no model that predicts a new vehicle model (Tables 12 and 13, and the curves
        over a few rides). The paper leaves out the LEAF: `nissan-leaf`.
    removal_margin : float
        Loss by which removed terms may increase the error of the hybrid model, over this error. [1]
    """
    plan = plan_evaluation(
        rides,
        recipes,
        seed=seed,
        repeats=repeats,
        left_out_of_training=left_out_of_training,
        removal_margin=removal_margin,
    )
    return tabulate_runs(plan, run_in_parallel(plan.calls, jobs, progress))


def tabulate_runs(plan: EvaluationPlan, done: Mapping[Any, Any]) -> RecipeEvaluation:
    """Return the whole evaluation from the results of its runs."""
    table, recipes, splits = plan.table, plan.recipes, plan.splits
    held = {kind: _select_held_out(done, kind, splits[kind], recipes, table) for kind in ("ride", "vehicle", "date")}
    if not held["ride"].recipes:
        raise ModelError(f"no recipe can be evaluated: {held['ride'].notes[0]}")
    new = {name: _select_held_out(done, "new", {name: split}, recipes, table) for name, split in splits["new"].items()}
    curves, failed = new_vehicle.tabulate_learning_curves({key[1:]: done[key] for key in plan.calls if key[0] == "few"})
    about = results.describe_evaluation(table, plan.seed, plan.repeats, TEST_SHARE)
    return replace(
        _compute_tables(plan, held, new),
        about=replace(about, left_out_of_training=list(plan.untrained), notes=_list_notes(plan, held, new, failed)),
        recipes={name: recipe.title for name, recipe in recipes.items() if name in held["ride"].recipes},
        few_shot=curves,
        selection=next((done[key] for key in plan.calls if key[0] == "selection"), RemovableTerms()),
    )


def _check_columns(recipes: Mapping[str, EvaluatedRecipe], table: EvaluatedRides) -> None:
    """Refuse, before any run, a table that lacks a column of a recipe's terms."""
    for name, recipe in recipes.items():
        for term in getattr(recipe, "terms", ()):
            for column in (raw for read in term.columns for raw in list_raw_columns(read)):
                if column not in table.rides:
                    raise ModelError(
                        f"column {column!r} is missing in the ride table, and recipe {name} reads it: make the tables "
                        "again with `socast tables`, or name recipes that do not read it"
                    )


def _make_splits(
    table: EvaluatedRides, seed: int, repeats: int, untrained: Collection[str]
) -> dict[Kind, dict[Any, Split]]:
    """Return all splits, by kind."""
    rides = table.rides
    models, cars, dates = (rides[name].astype(str).tolist() for name in ("vehicle_model", "vehicle_id", "date"))
    return {
        "ride": dict(enumerate(split_by_ride(list(zip(models, table.cluster.tolist(), strict=True)), seed, repeats))),
        "vehicle": dict(enumerate(split_by_vehicle(models, cars, seed))),
        "date": dict(enumerate(split_by_date(dates))),
        "new": new_vehicle.split_by_vehicle_model(table, untrained),
    }


def _select_held_out(
    done: Mapping[Any, Prediction],
    kind: Kind,
    splits: Mapping[Hashable, Split],
    recipes: Mapping[str, EvaluatedRecipe],
    table: EvaluatedRides,
) -> HeldOutPredictions:
    """Return the predictions on the splits of a kind, with recipes in order."""
    return select_comparable({name: [done[kind, key, name] for key in splits] for name in recipes}, len(table.rides))


def _compute_tables(
    plan: EvaluationPlan, held: Mapping[Kind, HeldOutPredictions], new: Mapping[Any, HeldOutPredictions]
) -> RecipeEvaluation:
    """Return the tables that follow from predictions on the splits of `held`, and on `new` vehicle models."""
    table, ride = plan.table, held["ride"]
    used = results.estimate_held_out(ride, table, [table.energy[rows] for rows in ride.rows])
    errors = {
        recipe: results.estimate_held_out(ride, table, results.compute_absolute_errors(ride, table, recipe))
        for recipe in ride.recipes
    }
    averages = {recipe: [mean.value for mean in average_over_clusters(cells)] for recipe, cells in errors.items()}
    pooled = {
        kind: {recipe: results.compute_pooled_average(held[kind], table, recipe) for recipe in held[kind].recipes}
        for kind in ("vehicle", "date")
    }
    return RecipeEvaluation(
        rides=results.count_rides(table),
        consumption=results.compute_consumption(table),
        test_consumption=tabulate_estimates(used, table),
        mae={recipe: tabulate_estimates(cells, table) for recipe, cells in errors.items()},
        relative=results.compute_errors_over_consumption(errors, used, table),
        reduction=results.compute_reductions(averages, table.vehicle_models),
        reduction_by_baseline=breakdown.compute_reductions_by_baseline(averages, table.vehicle_models),
        **results.compare_recipes(ride, table)._asdict(),
        bias=breakdown.compute_errors_by_vehicle_model(ride, table, compute_bias),
        rmse=breakdown.compute_errors_by_vehicle_model(ride, table, compute_rmse),
        bands=ride.measure(table, compute_band_shares),
        buffer_kwh=ride.measure(table, breakdown.compute_buffers),
        buffer_by_cluster=breakdown.compute_buffers_by_cluster(ride, table),
        by=breakdown.compute_errors_by_bin(ride, table),
        coverage=_compute_coverage(table, held, new),
        splits={
            kind: {recipe: dict(zip(table.vehicle_models, row, strict=True)) for recipe, row in rows.items()}
            for kind, rows in ({"ride": averages} | pooled).items()
        },
        percentage=breakdown.compute_percentage_errors(held, table),
        new_vehicle=new_vehicle.compute_tables_12_and_13(new, table),
        curve=compute_figure_1(table),
    )


def _compute_coverage(
    table: EvaluatedRides, held: Mapping[Kind, HeldOutPredictions], new: Mapping[Any, HeldOutPredictions]
) -> dict[str, IntervalCoverage]:
    """Return the coverage of intervals on unseen rides, and over all rides where cars, dates or models are unseen."""
    coverage = breakdown.compute_interval_coverage(held["ride"], table)
    unseen = {"by_vehicle": held["vehicle"], "by_date": held["date"], "new_vehicle": concatenate_held_out(new)}
    for name, predictions in unseen.items():
        energy = table.energy[predictions.pooled]
        for recipe in predictions.bounds:
            share = compute_coverage(energy, *predictions.all_bounds(recipe))
            coverage[recipe] = replace(coverage.get(recipe, IntervalCoverage()), **{name: share})
    return coverage


def concatenate_held_out(parts: Mapping[Any, HeldOutPredictions]) -> HeldOutPredictions:
    """Return the predictions of several sets as one, for the recipes that are in all of them."""
    held = list(parts.values())
    recipes = tuple(r for r in held[0].recipes if all(r in h.recipes for h in held)) if held else ()
    return HeldOutPredictions(
        recipes=recipes,
        rows=tuple(rows for h in held for rows in h.rows),
        energy={r: tuple(energy for h in held for energy in h.energy[r]) for r in recipes},
        bounds={r: tuple(b for h in held for b in h.bounds[r]) for r in recipes if all(r in h.bounds for h in held)},
        overlap=np.nan,
        notes=tuple(note for h in held for note in h.notes),
    )


def _list_notes(
    plan: EvaluationPlan,
    held: Mapping[Kind, HeldOutPredictions],
    new: Mapping[Any, HeldOutPredictions],
    failed: Sequence[str],
) -> list[str]:
    """Return what was left out and why, and what else a reader must know; a recipe left out everywhere comes once."""
    notes, ride, tested = [], held["ride"], plan.splits["new"]
    if plan.repeats < FEWEST_REPEATS:
        notes.append(
            f"intervals by ride are {compute_widening(plan.repeats, ride.overlap):.1f} times as wide over "
            f"{plan.repeats} repeats as over many: give --repeats {FEWEST_REPEATS} or more"
        )
    missing = {"vehicle": ONE_CAR, "date": ONE_DATE, "new": NO_OTHERS}
    notes += [*(why for kind, why in missing.items() if not plan.splits[kind]), *ride.notes]
    others = {f"split by {kind}": held_out for kind, held_out in held.items() if kind != "ride"}
    others |= {f"without {name}": held_out for name, held_out in new.items()}
    notes += [
        f"{note} ({where})"
        for where, held_out in others.items()
        for note in held_out.notes
        if note.partition(":")[0] in ride.recipes
    ]
    notes += [
        f"{name}: not tested as a new vehicle model, for want of rides to test or of others to train on"
        for name in plan.table.vehicle_models
        if tested and name not in tested
    ]
    unfitted = [name for name in BUILT_IN_MODELS if name in ride.recipes]
    return [*notes, *failed, *([f"{', '.join(unfitted)}: {HILLS_OF_BUILT_IN}"] if unfitted else [])]
