"""`socast fit`: fit a model to ride tables, write it to a file and print its coefficients."""

from collections.abc import Iterator, Sequence
from math import sqrt
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import msgspec
import typer
from msgspec import UNSET
from rich.console import Console

from socast.core import models
from socast.core.columns import ZERO_CELSIUS
from socast.core.errors import SettingsError, suggest_names
from socast.core.fit.pooled import adapt
from socast.core.fit.recipes import RECIPES, LinearRecipe, Recipe, get_recipe
from socast.core.fit.ride_blocks import RideParquet
from socast.core.fit.window_recipe import WindowRecipe
from socast.core.formatting import format_count, format_minus
from socast.core.models import ANY, LinearModel, Term
from socast.core.models.features import ACCESSORIES_COLUMN, EFFECT_PREFIX
from socast.core.models.plausibility import describe_implausible, get_plausible_ranges, is_within, list_implausible
from socast.core.stats.scores import Estimate
from socast.core.vehicles import AccessoryCurve
from socast.tools.cluster.dask_runner import ClusterPlace
from socast.tools.cluster.workers import open_workers
from socast.tools.terminal.cluster_option import insert_cluster_options
from socast.tools.terminal.elapsed_time import show_elapsed
from socast.tools.terminal.output import JsonFile, check_outputs, make_console, write_json
from socast.tools.terminal.rich_table import Column, make_table
from socast.tools.terminal.ride_source import WINDOWS, RideSource, insert_ride_source, place_source
from socast.tools.terminal.table_files import is_table, read

RECOMMENDED = "road_load"
"""The recommended first recipe: textbook physics with priors needs few rides, and what it lacks can be found."""

LEAST_PRIOR_FREEDOM = 4
"""Least degrees of freedom of an interval whose coefficient has a prior: the prior is known without any ride."""

CHOKE_POINTS = ("heating_full", "heating_off", "cooling_on", "cooling_full")
LEVELS = ("heating", "standby", "cooling")


@insert_cluster_options
@insert_ride_source
def fit(
    *,
    source: RideSource,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="MODEL.json", help="The model file to write.")],
    recipe_name: Annotated[
        str | None,
        typer.Option(
            "--recipe",
            metavar="NAME",
            help=f"One of {', '.join(RECIPES)}. In {' and '.join(models.BUILT_IN_MODELS)}, {models.HILLS_OF_BUILT_IN}.",
            show_default=False,
        ),
    ] = None,
    adapt_to: Annotated[
        Path | None,
        typer.Option(
            "--adapt",
            metavar="MODEL.json",
            help="Adapt this pooled model to the rides instead, such as those of a new car.",
        ),
    ] = None,
    place: ClusterPlace | None,
    json_file: JsonFile = None,
) -> None:
    """Fit a model to rides: one fit for each vehicle model, and one over all rides for any other.

    Rides that are unfit for training are left out, and the output counts them by reason.

    Examples
    --------
    socast tables recordings/shift.mcap --out tables
    socast fit tables --recipe road_load --out fitted.json
    socast fit recordings/shift.mcap --recipe road_load --out base.json
    socast fit new-car --adapt pooled.json --out adapted.json
    socast fit by-workers --recipe hybrid --out hybrid.json --cluster local:2
    """
    if (recipe_name is None) == (adapt_to is None):
        raise SettingsError(
            "give either --recipe NAME to fit a model or --adapt MODEL.json to adapt one to more rides; "
            f"start with --recipe {RECOMMENDED}, or choose from {', '.join(RECIPES)}"
        )
    if recipe_name is not None and recipe_name not in RECIPES:
        raise SettingsError(f"recipe {recipe_name!r} is unknown: {suggest_names(recipe_name, RECIPES)}")
    base = None if adapt_to is None else models.load(adapt_to)
    chosen = get_recipe(recipe_name or (base.recipe if base else ""))
    source.check()
    check_outputs(source.list_read_files(), out, json_file)
    _refuse_undivided(chosen, place, adapted=base is not None)
    with place_source(source, place if source.is_recorded else None).open_tables(always=True) as made:
        files = made.files
        if place and isinstance(chosen, LinearRecipe):
            model = _fit_by_workers(chosen, files, out, place)
        else:
            with show_elapsed("fitting"):
                model = _fitted(chosen, files) if base is None else adapt(base, RideParquet(tuple(files)).table())
    models.save(model, out)
    write_json(json_file, "fit", summary(model, chosen.title))
    console = make_console(json_file)
    show(model, chosen.title, console)
    message = f"{out}: {chosen.title}, version {model.version}; forecast with --model {out}"
    console.print(message, markup=False, highlight=False, soft_wrap=True)


def _fitted(chosen: Recipe, files: Sequence[Path]) -> LinearModel:
    """Return the fitted model; use little memory if the recipe allows it."""
    if isinstance(chosen, LinearRecipe):
        return chosen.fit_parquet(*files)
    if isinstance(chosen, WindowRecipe):
        beside = [file.with_name(WINDOWS) for file in files]
        there = all(map(is_table, beside))
        return chosen.fit(read(files), read(beside) if there else None)
    return chosen.fit(RideParquet(tuple(files)).table())


def _refuse_undivided(chosen: Recipe, place: ClusterPlace | None, *, adapted: bool) -> None:
    """Refuse fits that workers cannot divide."""
    if place and (adapted or not isinstance(chosen, LinearRecipe)):
        divided = ", ".join(name for name, recipe in RECIPES.items() if isinstance(recipe, LinearRecipe))
        what = "--adapt needs" if adapted else f"recipe {chosen.name} needs"
        raise SettingsError(f"{what} all rides at once; leave out --cluster, which divides the fits of {divided}")


def _fit_by_workers(chosen: LinearRecipe, files: Sequence[Path], out: Path, place: ClusterPlace) -> LinearModel:
    """Return the fitted model; workers sum the blocks of rides."""
    with open_workers(place, out.resolve().parent, "fit") as workers:
        return chosen.fit_parquet(*(file.resolve() for file in files), run=workers.run)


class Coefficient(NamedTuple):
    """Hold a fitted coefficient with its 95 % interval.

    Parameters
    ----------
    half : float or None
        Half width of the interval; None if the fit has no covariance, or if the interval ends at a limit.
    low, high : float or None
        Ends of the interval; None if the fit has no covariance.
    limited : bool
        Whether the coefficient stopped at a limit.
    """

    term: Term
    value: float
    half: float | None
    low: float | None
    high: float | None
    limited: bool


def intervals(model: LinearModel, key: str) -> Iterator[Coefficient]:
    """Yield each coefficient of a fit with its 95 % interval.

    Yields
    ------
    Coefficient
        The width comes from Student's t distribution. A fit to windows excludes values beyond the plausible range, so
        the interval ends there.
    """
    fitted, ranges = model.fits[key], get_plausible_ranges(model, key)
    freedom = (fitted.clusters or fitted.rides) - 1
    bounded = isinstance(RECIPES.get(model.recipe), WindowRecipe)
    if bounded:
        freedom = max(freedom, LEAST_PRIOR_FREEDOM)
    for i, (term, coefficient) in enumerate(zip(model.terms, fitted.coefficients, strict=True)):
        limited = term.name in fitted.limited
        if fitted.covariance is None:
            yield Coefficient(term, coefficient, None, None, None, limited)
            continue
        estimate = Estimate(coefficient, sqrt(max(fitted.covariance[i][i], 0.0)), freedom)
        ends = low, high = estimate.interval
        if bounded and term.name in ranges:
            low, high = (min(max(end, ranges[term.name][0]), ranges[term.name][1]) for end in ends)
        whole = (low, high) == ends
        yield Coefficient(term, coefficient, estimate.ci95 if whole else None, low, high, limited)


def _celsius(curve: AccessoryCurve) -> dict[str, float]:
    """Return the seven parameters of a curve: choke points [°C] and levels [W]."""
    points = {f"{name}_c": getattr(curve, name) - ZERO_CELSIUS for name in CHOKE_POINTS}
    return points | {f"{name}_w": getattr(curve, name) for name in LEVELS}


def in_sample(model: LinearModel) -> dict[str, float]:
    """Return the mean absolute error of each fit over the rides that it was fitted to. [kWh]

    Returns
    -------
    dict
        Errors by vehicle model; empty if the history of the model does not hold them.
    """
    return next((entry["mae_in_sample_kwh"] for entry in model.history if "mae_in_sample_kwh" in entry), {})


def summary(model: LinearModel, title: str) -> dict[str, Any]:
    """Return the fitted coefficients with their intervals and errors, for JSON."""
    training = msgspec.to_builtins(model.training)
    errors, rows = in_sample(model), (model.history or ({},))[0].get("rows", "rides")
    ranges = {key: get_plausible_ranges(model, key) for key in model.fits}
    fits = {
        key: {
            "rides": fitted.rides,
            "mae_in_sample_kwh": errors.get(key),
            "residual_sd_kwh": fitted.residual_sd_kwh,
            "clusters": fitted.clusters,
            "held": fitted.held,
            "dropped": fitted.dropped or (),
            "limit": None if fitted.limit is UNSET else msgspec.to_builtins(fitted.limit),
            "converged": fitted.converged,
            "limited": fitted.limited,
            "curve": None if fitted.curve is None else _celsius(fitted.curve),
            "coefficients": [
                {
                    "term": one.term.name,
                    "unit": one.term.unit,
                    "value": one.value,
                    "ci95": one.half,
                    "low": one.low,
                    "high": one.high,
                    "at_limit": one.limited,
                    "range": ranges[key].get(one.term.name),
                    "plausible": one.term.name not in ranges[key] or is_within(one.value, ranges[key][one.term.name]),
                }
                for one in intervals(model, key)
            ],
        }
        for key, fitted in model.fits.items()
    }
    head = {"recipe": model.recipe, "title": title, "version": model.version, "rows": rows}
    return {**head, "training": training, "fits": fits}


def show(model: LinearModel, title: str, console: Console) -> None:
    """Print the rides used, the errors of each fit, the coefficients and the accessory curves."""
    training = model.training
    if isinstance(RECIPES.get(model.recipe), WindowRecipe) and (model.history or ({},))[0].get("rows") == "rides":
        console.print(f"fitted to whole rides: no {WINDOWS} beside them, so intervals are wider", highlight=False)
    if training is not None:
        left = ", ".join(f"{n:,} {reason.replace('_', ' ')}" for reason, n in training.left_out.items())
        filled = ", ".join(f"{name} in {n:,}" for name, n in training.filled.items())
        rides = format_count(training.rides, "ride")
        console.print(f"{rides} from {training.first_date} to {training.last_date}", highlight=False)
        console.print(f"left out: {left or 'none'}", highlight=False, soft_wrap=True)
        console.print(f"unknown and filled with the mean: {filled or 'nothing'}", highlight=False, soft_wrap=True)
        for name, n in training.vehicle_models.items():
            if name not in model.fits:
                console.print(f"{name}: {n} rides are too few for a fit of its own", highlight=False, soft_wrap=True)
    errors = in_sample(model)
    numbers = ("rides", "MAE in sample, kWh", "residual SD, kWh")
    table = make_table([Column("vehicle model"), *(Column(head, number=True) for head in numbers)], title)
    for key, fitted in model.fits.items():
        left_sd = "" if fitted.residual_sd_kwh is None else f"{fitted.residual_sd_kwh:.3f}"
        error = f"{errors[key]:.3f}" if key in errors else ""
        table.add_row("any other (*)" if key == ANY else key, f"{fitted.rides:,}", error, left_sd)
    console.print(table)
    _show_coefficients(model, console)
    _show_dropped(model, console)
    _show_curves(model, console)
    parts = [
        f"factors of {format_count(len(model.cars), 'car')}" if model.cars else "",
        f"trees for {', '.join(model.correction)}" if model.correction else "",
        "prediction intervals" if model.interval else "",
    ]
    if any(parts):
        console.print(f"The model also has {', '.join(part for part in parts if part)}.", highlight=False)


def _physical(term: Term) -> bool:
    """Return whether a term is a physical one, whose coefficient is 1 if the physics holds."""
    return bool(term.columns) and term.columns[0].startswith((EFFECT_PREFIX, ACCESSORIES_COLUMN))


def _show_coefficients(model: LinearModel, console: Console) -> None:
    """Print the coefficients of physical terms with their 95 % intervals; the JSON files hold the others."""
    if not any(fitted.covariance for fitted in model.fits.values()):
        return
    shown = [term for term in model.terms if _physical(term)] or list(model.terms[:12])
    columns = [Column("coefficient"), Column("unit"), *(Column(key, number=True) for key in model.fits)]
    table = make_table(columns, "Coefficients with 95 % intervals")
    cells = {key: {one.term.name: one for one in intervals(model, key)} for key in model.fits}
    outside = list_implausible(model)
    for term in shown:
        row = [
            _cell(cells[key][term.name], held=term.name in fitted.held, marked=term.name in outside.get(key, ()))
            for key, fitted in model.fits.items()
        ]
        table.add_row(term.name, term.unit, *row)
    console.print(table)
    others = len(model.terms) - len(shown)
    notes = [f"{others} other coefficients are in the model file"] if others else []
    if any(fitted.held for fitted in model.fits.values()):
        notes.append("(held): the data do not determine it, so it is fixed by its prior")
    if any(fitted.limited for fitted in model.fits.values()):
        notes.append("(at its limit): the data alone would put it beyond its plausible range, so it stops at the end")
    if model.fits.get(ANY) and model.fits[ANY].noise_kwh is not None:
        notes.append("interval of *: for a vehicle model without rides, about the mean of the others")
    if notes:
        console.print("; ".join(notes), markup=False, highlight=False, soft_wrap=True)
    for key in (key for key, fitted in model.fits.items() if not fitted.converged):
        line = f"NOT converged: the fit of {key} ended before its coefficients were the most probable ones"
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    for line in describe_implausible(model):
        console.print(f"NOT plausible: {line}", markup=False, highlight=False, soft_wrap=True)


def _show_dropped(model: LinearModel, console: Console) -> None:
    """Print the terms of each fit whose column had no content."""
    for key, fitted in model.fits.items():
        if fitted.dropped:
            line = f"dropped for {key}, as its column does not vary beyond rounding: {', '.join(fitted.dropped)}"
            console.print(line, markup=False, highlight=False, soft_wrap=True)


def _cell(one: Coefficient, *, held: bool, marked: bool) -> str:
    """Return the text of a coefficient and its interval, and its marks."""
    text = f"{one.value:.4g}"
    if one.half is not None:
        text += f" ± {one.half:.2g}"
    elif one.low is not None:
        text += f", {one.low:.3g} to {one.high:.3g}"
    marks = {" (held)": held, " (at its limit)": one.limited, " (NOT plausible)": marked}
    return format_minus(text + "".join(mark for mark, set_ in marks.items() if set_))


def _show_curves(model: LinearModel, console: Console) -> None:
    """Print the accessory curves."""
    curves = {key: fitted.curve for key, fitted in model.fits.items() if fitted.curve is not None}
    if not curves:
        return
    heads = [name.replace("_", " ") for name in (*CHOKE_POINTS, *LEVELS)]
    columns = [Column("vehicle model"), *(Column(head, number=True) for head in heads)]
    table = make_table(columns, "Accessory power: choke points in °C, levels in W")
    for key, curve in curves.items():
        numbers = _celsius(curve)
        cells = {name: format_minus(f"{numbers[f'{name}_c']:.1f}") for name in CHOKE_POINTS}
        cells |= {name: f"{numbers[f'{name}_w']:,.0f}" for name in LEVELS}
        limited = model.fits[key].limited
        table.add_row(key, *(f"{text} (at its limit)" if name in limited else text for name, text in cells.items()))
    console.print(table)
