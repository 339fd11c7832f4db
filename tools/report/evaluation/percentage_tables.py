"""Build the tables of errors in percent, over the noise floor, below the baselines, and beside the literature."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from operator import itemgetter
from types import MappingProxyType
from typing import Final

from socast.core.evaluate.literature import LITERATURE
from socast.core.evaluate.paper.published import AVERAGE
from socast.core.evaluate.paper.records import PercentageErrors, RecipeEvaluation
from socast.core.evaluate.records import EstimatedValue, RelativeErrors
from socast.core.fit.recipes import BASELINES
from socast.tools.report.evaluation.result import (
    compute_mean,
    find_least,
    get_new_vehicle_errors,
    get_recipes,
    get_title,
    list_vehicle_models,
)
from socast.tools.report.table import (
    FORMATS,
    UNKNOWN,
    Cell,
    ReportTable,
    format_energy,
    format_percent,
    keep_filled,
    tabulate,
    tabulate_records,
)

HELD_OUT: Final[Mapping[str, str]] = MappingProxyType(
    {"ride": "unseen rides", "vehicle": "unseen cars", "date": "unseen dates"}
)
"""Kind of split -> what the models have not seen."""
BASELINE_HEADS: Final[Mapping[str, str]] = MappingProxyType(
    {
        "basic_physical": "basic",
        "basic_rescaled": "basic, rescaled",
        "basic_rescaled_power": "basic, rescaled, with power",
        "telematics_regression": "telematics regression",
    }
)
"""Baseline -> heading of its column."""
BASELINE_NOTES: Final[Mapping[str, str]] = MappingProxyType(
    {
        "basic_physical": "Basic: no fitted number.",
        "basic_rescaled": "Basic, rescaled: one factor, fitted to the training rides of each vehicle model.",
        "basic_rescaled_power": "Basic, rescaled, with power: a factor and a constant power, fitted likewise.",
        "telematics_regression": "Telematics regression: distance, distance times squared speed, duration, and "
        "duration times the difference from 20 °C, after Geotab's model card.",
    }
)
"""Baseline -> sentence that explains it."""
PERCENT_NOTE: Final = (
    "wMAPE: sum of absolute errors over sum of measured energy, of all rides. MAPE: mean over rides of error over "
    "measured energy. ± is half of the 95 % interval."
)
FLOOR_NOTE: Final = (
    "Over noise: mean absolute error over the one that measurement noise alone causes; a perfect model has 1. Noise "
    "that all drives of a car share, such as an error of its capacity, is not counted."
)


def tabulate_percentages(result: RecipeEvaluation) -> list[ReportTable]:
    """Return the tables of reductions, of percentage errors by what was held out, and of the literature."""
    shown = keep_filled(
        tabulate_baseline_reductions(result),
        tabulate_baseline_reductions(result, new_vehicles=True),
        *(tabulate_percentages_of(result, kind) for kind in HELD_OUT),
    )
    return [*shown, tabulate_literature(result)] if result.percentage != PercentageErrors() else shown


def get_reductions(result: RecipeEvaluation, recipe: str) -> dict[str, float | None]:
    """Return by which share the average error of a model is below that of each baseline, None where unknown. [1]"""
    shares = {BASELINES[0]: result.reduction, **result.reduction_by_baseline}
    return {name: shares.get(name, {}).get(recipe, {}).get(AVERAGE) for name in BASELINES}


def get_new_vehicle_reductions(result: RecipeEvaluation, recipe: str) -> dict[str, float | None]:
    """Return the same shares on vehicle models that were left out of training, baselines included. [1]"""
    reductions: dict[str, float | None] = {}
    for name in BASELINES:
        pairs = [
            (get_new_vehicle_errors(result, recipe, key).mae, get_new_vehicle_errors(result, name, key).mae)
            for key in list_vehicle_models(result)
        ]
        reductions[name] = compute_mean(1.0 - error / base for error, base in pairs if error is not None and base)
    return reductions


def find_best_on_new_vehicles(result: RecipeEvaluation) -> str | None:
    """Return the recipe of least error below the basic model's on left-out vehicle models, None where none is known."""
    shares = {r: get_new_vehicle_reductions(result, r)[BASELINES[0]] for r in result.new_vehicle}
    known = {recipe: share for recipe, share in shares.items() if share is not None and recipe != BASELINES[0]}
    return max(known, key=known.__getitem__, default=None)


def tabulate_baseline_reductions(result: RecipeEvaluation, *, new_vehicles: bool = False) -> ReportTable:
    """Return by how much the error of each model is below that of each baseline. [%]

    Parameters
    ----------
    new_vehicles : bool
        Whether the errors are those on vehicle models left out of training, instead of those by ride.
    """
    reduce = get_new_vehicle_reductions if new_vehicles else get_reductions
    shares = [(recipe, reduce(result, recipe)) for recipe in get_recipes(result) if recipe != BASELINES[0]]
    where = "vehicle model unseen" if new_vehicles else "unseen rides"
    rows = [(get_title(result, recipe), (recipe, known)) for recipe, known in shares]
    return tabulate_below_baselines(f"Error below each baseline, {where}", rows)


def tabulate_below_baselines(
    title: str,
    rows: Sequence[tuple[str, tuple[str, Mapping[str, float | None]]]],
    paper: Callable[[str, str], str] = lambda _recipe, _baseline: "",
) -> ReportTable:
    """Return a table of the known reductions of recipes, a column for each baseline, and notes that explain these."""
    known = [(name, of) for name, of in rows if any(share is not None for share in of[1].values())]
    present = [name for name in BASELINES if any(shares[name] is not None for _, (_, shares) in known)]

    def make_cell(baseline: str, of: tuple[str, Mapping[str, float | None]]) -> Cell:
        recipe, shares = of
        return Cell("" if baseline == recipe else format_percent(shares[baseline]), paper(recipe, baseline))

    columns = [(f"below {BASELINE_HEADS[name]}", partial(make_cell, name)) for name in present]
    explained = " ".join(BASELINE_NOTES[name] for name in present)
    notes = ("Mean over vehicle models of the reduction of the average error.", explained)
    return tabulate(title, "model", known, columns, notes)


def tabulate_percentages_of(result: RecipeEvaluation, kind: str) -> ReportTable:
    """Return the errors of each model in kWh, in percent, and over the noise floor, for one kind of split."""
    figures, least_kwh = result.percentage.get_split(kind), result.percentage.least_energy_kwh
    rides = (
        f"Mean energy of a ride {format_energy(figures.energy_kwh)} kWh; measurement noise alone "
        f"{format_energy(figures.noise_floor_kwh)} kWh. MAPE leaves out rides below "
        f"{UNKNOWN if least_kwh is None else f'{least_kwh:g}'} kWh, {format_percent(figures.below_least)} of all, "
        "whose relative error has no bound."
    )
    errors = {recipe: figures.recipes[recipe] for recipe in get_recipes(result) if recipe in figures.recipes}
    least = min((each.mae_kwh.value for each in errors.values() if each.mae_kwh.value is not None), default=None)
    return tabulate_records(
        f"Errors on {HELD_OUT[kind]}, in percent",
        errors,
        RelativeErrors,
        corner="model",
        label=partial(get_title, result),
        notes=(PERCENT_NOTE, rides, FLOOR_NOTE),
        strong=lambda name, _, value: name == "mae_kwh" and value.value is not None and value.value == least,
        formats={**FORMATS, "share": format_share, "ratio": format_ratio},
    )


def tabulate_literature(result: RecipeEvaluation) -> ReportTable:
    """Return the errors that other work published, above the best model here."""
    rows = [(each.setting, (format_percent(each.share), each.measure, each.source)) for each in LITERATURE]
    for kind, unseen in HELD_OUT.items():
        errors = result.percentage.get_split(kind).recipes
        if (best := find_least({recipe: each.wmape.value for recipe, each in errors.items()})) is not None:
            text = f"{format_percent(errors[best].wmape)} / {format_percent(errors[best].mape)}"
            rows.append((f"here, {unseen}", (text, "wMAPE / MAPE", get_title(result, best))))
    note = (
        "Other fleets, trips and measures than these, for orientation only. Longer trips have smaller relative errors; "
        "errors on a simulated fleet are smaller than on a real one."
    )
    columns = [(head, itemgetter(i)) for i, head in enumerate(("error", "measure", "source, or model"))]
    sources = dict.fromkeys(f"{entry.source}: {entry.publication}, {entry.link}." for entry in LITERATURE)
    totals = [f"here, {unseen}" for unseen in HELD_OUT.values()]
    return tabulate("Beside the literature", "vehicles", rows, columns, (note, *sources), totals=totals)


def format_share(estimate: EstimatedValue) -> str:
    """Return a share in percent, with its interval where it has one.

    Examples
    --------
    >>> format_share(EstimatedValue(value=0.0712, ci95=0.0041)), format_share(EstimatedValue(value=0.5))
    ('7.1 ± 0.4 %', '50.0 %')
    """
    if estimate.value is None or estimate.ci95 is None:
        return format_percent(estimate.value)
    return f"{100.0 * estimate.value:.1f} ± {100.0 * estimate.ci95:.1f} %"


def format_ratio(value: float | None) -> str:
    """Return a ratio with a multiplication sign.

    Examples
    --------
    >>> format_ratio(1.634), format_ratio(None)
    ('1.63 ×', '–')
    """
    return UNKNOWN if value is None else f"{value:.2f} ×"
