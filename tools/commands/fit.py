"""`socast fit`: fit a model to ride tables, write it to a file and print its coefficients."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Annotated

import pandas as pd
import typer
from rich.console import Console

from socast.core import models
from socast.core.errors import SettingsError, suggest_names
from socast.core.fit.determination import LEVEL_PREFIX
from socast.core.fit.model_summary import summarise_model
from socast.core.fit.pooled import adapt
from socast.core.fit.recipes import FIRST_RECIPE, RECIPES, LinearRecipe, Recipe, get_recipe
from socast.core.fit.records import (
    Determination,
    FitSummary,
    FittedCoefficient,
    FittedCurve,
    VehicleModelFit,
    find_fit_step,
)
from socast.core.fit.ride_blocks import RideParquet
from socast.core.fit.window_recipe import WindowRecipe
from socast.core.formatting import format_count, format_minus
from socast.core.models import ANY, LinearModel
from socast.core.models.features import ACCESSORIES_COLUMN, EFFECT_PREFIX
from socast.core.models.linear import Training
from socast.core.models.plausibility import describe_implausible
from socast.core.records import list_shown
from socast.tools.cluster.dask_runner import ClusterPlace
from socast.tools.cluster.workers import open_workers
from socast.tools.terminal.cluster_option import insert_cluster_options
from socast.tools.terminal.output import JsonFile, make_console, print_plain, write_json
from socast.tools.terminal.progress import show_elapsed
from socast.tools.terminal.rich_table import Column, make_table
from socast.tools.terminal.ride_source import WINDOWS, RideSource, insert_ride_source
from socast.tools.terminal.table_files import is_table, read

BASE_RECIPE = "road_load"
"""The recipe from which a diagnosis begins: textbook physics with priors, whose missing effects can be found."""


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
            f"start with --recipe {FIRST_RECIPE} for forecasts, --recipe {BASE_RECIPE} for a diagnosis, or choose from "
            f"{', '.join(RECIPES)}"
        )
    if recipe_name is not None and recipe_name not in RECIPES:
        raise SettingsError(f"recipe {recipe_name!r} is unknown: {suggest_names(recipe_name, RECIPES)}")
    base = None if adapt_to is None else models.load(adapt_to)
    chosen = get_recipe(recipe_name or (base.recipe if base else ""))
    source.check(out, json_file)
    _refuse_undivided(chosen, place, adapted=base is not None)
    with source.open_tables((), place if source.is_recorded else None, always=True) as made:
        files = made.files
        determined: dict[str, list[Determination]] = {}
        if place and isinstance(chosen, LinearRecipe):
            with open_workers(place, out.resolve().parent, "fit") as workers:  # which sum the blocks of rides
                model = chosen.fit_parquet(*(file.resolve() for file in files), run=workers.run)
        else:
            with show_elapsed("fitting"):
                if base is not None:
                    model = adapt(base, RideParquet(tuple(files)).table())
                elif isinstance(chosen, WindowRecipe):
                    model, determined = chosen.determine(*_read_tables(files))
                elif isinstance(chosen, LinearRecipe):  # which needs little memory
                    model = chosen.fit_parquet(*files)
                else:
                    model = chosen.fit(RideParquet(tuple(files)).table())
    models.save(model, out)
    fitted = summarise_model(model, determined)
    write_json(json_file, "fit", fitted.to_json())
    console = make_console(json_file)
    show(fitted, model, console)
    print_plain(
        console,
        f"{out}: {chosen.title}, version {model.version}; forecast with --model {out}",
    )


def _read_tables(files: Sequence[Path]) -> tuple[pd.DataFrame, pd.DataFrame | None]:
    """Return the rides, and the windows where each file has them beside it."""
    beside = [file.with_name(WINDOWS) for file in files]
    there = all(map(is_table, beside))
    return read(files), read(beside) if there else None


def _refuse_undivided(chosen: Recipe, place: ClusterPlace | None, *, adapted: bool) -> None:
    """Refuse fits that workers cannot divide."""
    if place and (adapted or not isinstance(chosen, LinearRecipe)):
        divided = ", ".join(name for name, recipe in RECIPES.items() if isinstance(recipe, LinearRecipe))
        what = "--adapt needs" if adapted else f"recipe {chosen.name} needs"
        raise SettingsError(f"{what} all rides at once; leave out --cluster, which divides the fits of {divided}")


def show(made: FitSummary, model: LinearModel, console: Console) -> None:
    """Print the rides used, the errors of each fit, the coefficients and the accessory curves."""
    if isinstance(RECIPES.get(made.recipe), WindowRecipe) and find_fit_step(model).rows == "rides":
        console.print(f"fitted to whole rides: no {WINDOWS} beside them, so intervals are wider", highlight=False)
    if made.training is not None:
        _show_training(made.training, made.fits, console)
    numbers = ("rides", "MAE in sample, kWh", "residual SD, kWh")
    columns = [Column("vehicle model"), *(Column(head, number=True) for head in numbers)]
    rows = [
        (
            "any other (*)" if key == ANY else key,
            f"{fit.rides:,}",
            *("" if error is None else f"{error:.3f}" for error in (fit.mae_in_sample_kwh, fit.residual_sd_kwh)),
        )
        for key, fit in made.fits.items()
    ]
    console.print(make_table(columns, made.title, rows=rows))
    _show_coefficients(made, model, console)
    for key, fit in made.fits.items():
        if fit.dropped:
            print_plain(
                console,
                f"dropped for {key}, as its column does not vary beyond rounding: {', '.join(fit.dropped)}",
            )
    _show_curves(made.fits, console)
    parts = [
        f"factors of {format_count(len(model.cars), 'car')}" if model.cars else "",
        f"trees for {', '.join(model.correction)}" if model.correction else "",
        "prediction intervals" if model.interval else "",
    ]
    if any(parts):
        console.print(f"The model also has {', '.join(part for part in parts if part)}.", highlight=False)


def _show_training(training: Training, fits: Mapping[str, VehicleModelFit], console: Console) -> None:
    """Print which rides a model was fitted to, and which were left out."""
    left = ", ".join(f"{n:,} {reason.replace('_', ' ')}" for reason, n in training.left_out.items())
    filled = ", ".join(f"{name} in {n:,}" for name, n in training.filled.items())
    rides = format_count(training.rides, "ride")
    console.print(f"{rides} from {training.first_date} to {training.last_date}", highlight=False)
    console.print(f"left out: {left or 'none'}", highlight=False, soft_wrap=True)
    console.print(f"unknown and filled with the mean: {filled or 'nothing'}", highlight=False, soft_wrap=True)
    for name, n in training.vehicle_models.items():
        if name not in fits:
            console.print(f"{name}: {n} rides are too few for a fit of its own", highlight=False, soft_wrap=True)


def _show_coefficients(made: FitSummary, model: LinearModel, console: Console) -> None:
    """Print the coefficients of physical terms with their 95 % intervals; the JSON files hold the others."""
    if not any(fit.covariance for fit in model.fits.values()):
        return
    physical = (EFFECT_PREFIX, ACCESSORIES_COLUMN)  # terms whose coefficient is 1 if the physics holds
    shown = [i for i, term in enumerate(model.terms) if term.columns and term.columns[0].startswith(physical)]
    shown = shown or list(range(len(model.terms)))[:12]
    columns = [Column("coefficient"), Column("unit"), *(Column(key, number=True) for key in made.fits)]
    rows = [
        (
            model.terms[i].name,
            model.terms[i].unit,
            *(_format_coefficient(fit.coefficients[i], fit.held) for fit in made.fits.values()),
        )
        for i in shown
    ]
    console.print(make_table(columns, "Coefficients with 95 % intervals", rows=rows))
    others = len(model.terms) - len(shown)
    notes = [f"{others} other coefficients are in the model file"] if others else []
    if any(fit.held for fit in made.fits.values()):
        notes.append("(held): the data do not determine it, so it is fixed by its prior")
    if any(fit.limited for fit in made.fits.values()):
        notes.append("(at its limit): the data alone would put it beyond its plausible range, so it stops at the end")
    if model.fits.get(ANY) and model.fits[ANY].noise_kwh is not None:
        notes.append("interval of *: for a vehicle model without rides, about the mean of the others")
    if notes:
        print_plain(console, "; ".join(notes))
    for key in (key for key, fit in made.fits.items() if not fit.converged):
        print_plain(
            console,
            f"NOT converged: the fit of {key} ended before its coefficients were the most probable ones",
        )
    _show_determined(made.fits, console)
    for line in describe_implausible(model):
        print_plain(console, f"NOT plausible: {line}")


def _show_determined(fits: Mapping[str, VehicleModelFit], console: Console) -> None:
    """Print which coefficients the rides do not determine, and what would; once where `*` repeats the only fit."""
    for key, fit in fits.items():
        if key == ANY and any(fit.determined == other.determined for name, other in fits.items() if name != ANY):
            continue
        rest = [each for each in fit.determined if not each.determined]
        ways: dict[str, list[str]] = {}
        for each in rest:
            ways.setdefault(_advise(each), []).append(f"{each.name} ({100 * each.sd_over_prior:.0f} % left)")
        if rest:
            told = f"{len(fit.determined) - len(rest)} of {_count_numbers(fit.determined)}"
            who = "any other (*)" if key == ANY else key
            print_plain(
                console,
                f"{who}: the rides determine {told}. The others rest mostly on what was assumed before any ride. How "
                "much of the uncertainty of that assumption is left, and what would bring it to half:",
                wraps=True,
            )
        print_plain(console, *(f"  {', '.join(names)}: {way}" for way, names in ways.items()), wraps=True)


def _count_numbers(determined: Sequence[Determination]) -> str:
    """Return the number of coefficients, and of levels of the accessory curve, in words."""
    levels = sum(each.name.startswith(LEVEL_PREFIX) for each in determined)
    coefficients = format_count(len(determined) - levels, "coefficient")
    if not levels:
        return coefficients
    return f"{len(determined)} numbers, {coefficients} and {levels} powers of accessories"


def _advise(one: Determination) -> str:
    """Return what would determine a coefficient."""
    if one.missing:
        return (
            f"the rides have no {one.missing}; give recordings with elevation_m, or with positions and a map of "
            "--elevation (see `socast elevation`)"
        )
    ways = [f"{format_count(one.drives, 'drive')} of 30 min {one.drive}"] if one.drives else []
    ways += [f"{format_count(one.days, 'more day')} like these"] if one.days else []
    return " or ".join(ways) or "more such days and usual drives would not"


def _format_coefficient(one: FittedCoefficient, held: Collection[str]) -> str:
    """Return the text of a coefficient and its interval, and its marks."""
    text = f"{one.value:.4g}"
    if one.ci95 is not None:
        text += f" ± {one.ci95:.2g}"
    elif one.low is not None:
        text += f", {one.low:.3g} to {one.high:.3g}"
    marks = {" (held)": one.term in held, " (at its limit)": one.at_limit, " (NOT plausible)": not one.plausible}
    return format_minus(text + "".join(mark for mark, set_ in marks.items() if set_))


def _show_curves(fits: Mapping[str, VehicleModelFit], console: Console) -> None:
    """Print the accessory curves."""
    curves = {key: fit.curve for key, fit in fits.items() if fit.curve is not None}
    if not curves:
        return
    shown = list_shown(FittedCurve)
    columns = [Column("vehicle model"), *(Column(each.head, number=True) for each in shown.values())]
    table = make_table(columns, "Accessory power: choke points in °C, levels in W")
    for key, curve in curves.items():
        cells = {name.rpartition("_")[0]: (getattr(curve, name), each.format) for name, each in shown.items()}
        texts = [
            format_minus(f"{value:,.0f}" if form == "count" else f"{value:.1f}")
            + (" (at its limit)" if name in fits[key].limited else "")
            for name, (value, form) in cells.items()
        ]
        table.add_row(key, *texts)
    console.print(table)
