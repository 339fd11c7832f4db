"""Show an evaluation of recipes: its sections with their tables and figures, beside the figures of the paper."""

from collections.abc import Callable
from functools import partial
from typing import Any, Final

from rich.console import Console
from rich.text import Text

from socast.core.evaluate.paper import published
from socast.core.evaluate.paper.published import PHYSICAL
from socast.core.evaluate.paper.records import RecipeEvaluation
from socast.core.stats.multiple_testing import SIGNIFICANCE
from socast.tools.report.document import Illustration, Report, Section, print_report
from socast.tools.report.evaluation import figures, held_out, selection
from socast.tools.report.evaluation.held_out import tabulate_all_splits, tabulate_transfer
from socast.tools.report.evaluation.percentage_tables import (
    HELD_OUT,
    find_best_on_new_vehicles,
    get_new_vehicle_reductions,
    get_reductions,
    tabulate_below_baselines,
    tabulate_percentages,
)
from socast.tools.report.evaluation.result import (
    ALL,
    FITTED,
    INTERACTIONS,
    compute_overall_error,
    find_best,
    get_new_vehicle_errors,
    get_recipes,
    get_title,
    get_vehicle_name,
    list_vehicle_models,
    select_principal,
)
from socast.tools.report.evaluation.selection import tabulate_selection
from socast.tools.report.evaluation.tables import (
    tabulate_data,
    tabulate_differences,
    tabulate_errors,
    tabulate_summaries,
)
from socast.tools.report.evaluation.use_tables import AXES, MANY_BINS, list_bins, tabulate_places, tabulate_reserve
from socast.tools.report.table import (
    Cell,
    ReportTable,
    format_change,
    format_energy,
    format_percent,
    keep_filled,
    tabulate,
)

PAPER_CAPTION: Final = "The paper's figures are from other data (the rides of one company), for orientation only."
"""Sentence of captions of figures that also show the paper's figures."""


def show(result: RecipeEvaluation, console: Console) -> None:
    """Print the tables of an evaluation, with the principal figures last, where readers look first."""
    print_report(build_report(result), console, last="glance")
    console.print(Text(f"“The paper” is “{published.load_paper().title}”.", style="yellow"))


def build_report(result: RecipeEvaluation) -> Report:
    """Return the report of an evaluation."""
    about = result.about
    rides = "" if about.fit is None else f"{about.fit:,} rides. "
    lead = (
        f"{rides}Figures in parentheses and outlines are from “{published.load_paper().title}”. They are "
        "from other data (the rides of one company), for orientation only."
    )
    drawn = {key: partial(build_illustrations, section=key) for key in MAKERS}
    title, sections = "Evaluation of consumption models", build_sections(result)
    return Report("evaluate", "evaluate", title, sections, [lead], about.notes, result, drawn)


def build_sections(result: RecipeEvaluation) -> list[Section]:
    """Return the sections that have at least one table with a row."""
    sections = [
        Section("glance", "At a glance", "", [tabulate_headline(result), tabulate_overview(result)]),
        Section("data", "Rides", "Which rides are evaluated, and their energy.", tabulate_data(result)),
        Section(
            "summary",
            "The models side by side",
            "Average error of each model on each vehicle model, and which of them are better beyond chance.",
            tabulate_summaries(result),
        ),
        Section(
            "percentage",
            "Errors in percent, and below the baselines",
            "How much a model explains beyond one or two fitted numbers, and how near it is to the measurement noise.",
            tabulate_percentages(result),
        ),
        Section(
            "errors",
            "Errors by distance, model by model",
            "Each model is trained on a draw of the rides of every cluster and tested on the others, several times.",
            keep_filled(*(tabulate_errors(result, recipe) for recipe in get_recipes(result))),
        ),
        Section(
            "difference",
            "Which differences are beyond chance",
            "Models compared on the same test rides, pair by pair.",
            keep_filled(*(tabulate_differences(result, key) for key in (ALL, *list_vehicle_models(result)))),
            folded=True,
        ),
        Section(
            "places",
            "Errors by condition",
            "Errors by distance, outside temperature, season and driver.",
            tabulate_places(result),
        ),
        Section(
            "reserve",
            "Intervals and the dispatcher's reserve",
            "How often the measured energy is inside its interval, and the energy to keep in reserve.",
            tabulate_reserve(result),
        ),
        Section(
            "splits",
            "Hold-out by vehicle and by date",
            "A model may have learned a particular car or day. These are its errors on unseen cars and on later dates.",
            tabulate_all_splits(result),
        ),
        Section(
            "transfer",
            "New vehicle models",
            "A vehicle model is left out of training; then some of its rides are added.",
            tabulate_transfer(result),
        ),
        Section(
            "selection",
            "Terms that can be removed",
            "Recursive elimination of the hybrid model's terms.",
            tabulate_selection(result),
        ),
    ]
    return [section for section in sections if any(table.rows for table in section.tables)]


def tabulate_headline(result: RecipeEvaluation) -> ReportTable:
    """Return by how much the errors of the principal models are below those of each baseline. [%]"""
    best = dict.fromkeys(recipe for recipe in (INTERACTIONS, find_best(result)) if recipe)
    unseen = dict.fromkeys(recipe for recipe in (FITTED, find_best_on_new_vehicles(result)) if recipe)
    statements = {INTERACTIONS: "reduction", FITTED: "new_vehicle_reduction"}

    def get_paper(recipe: str, baseline: str) -> str:
        if baseline != PHYSICAL or recipe not in statements:
            return ""
        return format_percent(published.get_statement(statements[recipe]).value, 2)

    rows = [(get_title(result, recipe), (recipe, get_reductions(result, recipe))) for recipe in best]
    for recipe in unseen:
        name = f"{get_title(result, recipe)}, vehicle model unseen"
        rows.append((name, (recipe, get_new_vehicle_reductions(result, recipe))))
    return tabulate_below_baselines("Error below each baseline, principal models", rows, get_paper)


def tabulate_overview(result: RecipeEvaluation) -> ReportTable:
    """Return a table of the principal figures that are known, with the paper's beside them."""
    best, of_paper = find_best(result) or "", get_title(result, INTERACTIONS)
    errors = [(unseen, result.percentage.get_split(kind).recipes.get(best)) for kind, unseen in HELD_OUT.items()]
    known = [
        f"{unseen} {format_percent(each.wmape)}" for unseen, each in errors if each and each.wmape.value is not None
    ]
    rows = [(f"Error over energy (wMAPE): {get_title(result, best)}", Cell(", ".join(known)))] if known else []
    reference = compute_overall_error(result, INTERACTIONS)
    if best not in {"", INTERACTIONS} and reference is not None:
        change = format_change(compute_overall_error(result, best), reference)
        rows.append((f"Average error of {get_title(result, best)} against {of_paper}", Cell(change)))
    if dominating := [result.dominates.get(key, []) for key in list_vehicle_models(result)]:
        names = [get_title(result, recipe) for recipe in dominating[0] if all(recipe in of for of in dominating)]
        unbeaten = Cell("; ".join(names) or "none", f"{of_paper}, or it and others")
        rows.append(("Dominates or co-dominates on every vehicle model", unbeaten))
    for cluster, statement in (("0-5", "relative_error_short"), ("20-25", "relative_error_long")):
        share = result.relative.get(INTERACTIONS, {}).get(cluster)
        if share is not None:
            name = f"Error over consumption, rides of {cluster.replace('-', '–')} km: {of_paper}"
            theirs = f"about {format_percent(published.get_statement(statement).value, 0)}"
            rows.append((name, Cell(format_percent(share), theirs)))
    if buffers := result.buffer_kwh.get(INTERACTIONS, {}):
        here = ", ".join(f"{format_energy(energy)} kWh for {share} % of rides" for share, energy in buffers.items())
        theirs = f"{published.get_statement('buffer').value:g} kWh, share not stated"
        rows.append((f"Buffer: {of_paper}", Cell(here, theirs)))
    rows += [
        (f"Rides inside their 90 % interval: {get_title(result, r)}", Cell(format_percent(result.coverage[r].overall)))
        for r in select_principal(result)
        if r in result.coverage
    ]
    return tabulate("At a glance", "figure", rows, [("here", lambda cell: cell)])


def build_illustrations(result: RecipeEvaluation, section: str) -> list[Illustration]:
    """Return the figures of a section that have something to show."""
    made = MAKERS.get(section)
    return [one for one in made(result) if any(_has_points(trace) for trace in one.figure.data)] if made else []


def _has_points(trace: Any) -> bool:
    """Return whether a trace has at least one visible point."""
    if trace.type == "heatmap":
        return any(value is not None for row in trace.z for value in row)
    return any(x is not None and y is not None for x, y in zip(trace.x, trace.y, strict=True))


def _data(result: RecipeEvaluation) -> list[Illustration]:
    """Return the accessory curves of all vehicle models."""
    return [
        Illustration(
            f"curve-{i}",
            f"{get_vehicle_name(key)}: accessory power against outside temperature (Figure 1)",
            "For a car whose accessory scale is 1. Open circles: mean of a bin of temperature, larger with more rides. "
            "Line: the fitted curve of five segments. Diamonds: its choke points, with their temperatures.",
            figures.draw_accessory_curve(result, key),
            small=True,
        )
        for i, key in enumerate(list_vehicle_models(result))
        if key in result.curve
    ]


def _summary(result: RecipeEvaluation) -> list[Illustration]:
    """Return the figures that compare all models."""
    winner = get_title(result, find_best(result) or "")
    return [
        Illustration(
            "average",
            "Average error of each model on each vehicle model (Figure 3)",
            "Filled: these rides, with 95 % confidence intervals. Outlines: the paper's. Least: "
            f"{winner}. {PAPER_CAPTION}",
            figures.draw_average_errors(result),
        ),
        Illustration(
            "relative",
            "Error over consumption against distance (Figure 2)",
            "All vehicle models together, weighted by their rides, on a logarithmic scale. Above: these "
            f"rides. Below, on the same scale: the paper's, computed from its tables. {PAPER_CAPTION}",
            figures.draw_relative_errors(result),
        ),
        Illustration(
            "bands",
            "Rides predicted within a band around their measured energy",
            "Share of rides whose error is within 5, 10 and 15 % of the measured energy; further right is better.",
            figures.draw_bands(result),
        ),
    ]


def _difference(result: RecipeEvaluation) -> list[Illustration]:
    """Return the difference scores of all vehicle models together and of each."""
    return [
        Illustration(
            f"difference-{i}",
            f"{get_vehicle_name(key)}: difference score",
            "Row's error less column's in Wh, mean over the same test rides: negative where the row is better. "
            f"* p < {SIGNIFICANCE}, adjusted for the number of pairs. {_dominating(result, key)}",
            selection.draw_difference_matrix(result, key),
        )
        for i, key in enumerate((ALL, *list_vehicle_models(result)))
        if result.difference.get(key)
    ]


def _dominating(result: RecipeEvaluation, key: str) -> str:
    """Return a sentence that names the models that dominate a vehicle model."""
    names = [get_title(result, recipe) for recipe in result.dominates.get(key, ())]
    if not names:
        return ""
    return f"{names[0]} dominates." if len(names) == 1 else f"{' and '.join(names)} co-dominate."


def _places(result: RecipeEvaluation) -> list[Illustration]:
    """Return the errors by distance, temperature, season and driver, ranked where there are many bins."""
    panels = "Above: mean absolute error. Below: bias, positive where too much is predicted."
    ranked = "Each curve is sorted from least to most."
    return [
        Illustration(
            f"by-{axis}",
            f"Errors by {AXES[axis]}",
            f"{ranked if len(list_bins(result, axis)) > MANY_BINS else panels} Click a name in the legend to show a "
            "further model.",
            figures.draw_errors_by(result, axis),
        )
        for axis in AXES
        if result.by.get(axis)
    ]


def _reserve(result: RecipeEvaluation) -> list[Illustration]:
    """Return the coverage of intervals, and the buffers above the reserve."""
    return [
        Illustration(
            "coverage",
            "Rides inside their 90 % prediction interval",
            "Dashed: the nominal 90 %, and the 85 % that no cluster or season should fall below.",
            figures.draw_coverage(result),
        ),
        Illustration(
            "buffers",
            "Buffer that keeps rides above their reserve",
            "Energy to keep in reserve so that 95 % or 99 % of rides take no more than the prediction "
            "plus this reserve. Dashed: the company in the paper, which does not state the share of "
            f"rides. {PAPER_CAPTION}",
            figures.draw_buffers(result),
        ),
    ]


def _splits(result: RecipeEvaluation) -> list[Illustration]:
    """Return the errors by what was held out."""
    return [
        Illustration(
            "splits",
            "Average error by what is held out",
            "Mean over vehicle models. The further apart the three markers of a model, the more it "
            "depends on the cars and days of its training rides.",
            figures.draw_splits(result),
        )
    ]


def _transfer(result: RecipeEvaluation) -> list[Illustration]:
    """Return the errors on vehicle models left out of training, and after some of their rides."""
    keys = list_vehicle_models(result)
    beside = any(published.get_new_vehicle_mae(FITTED, key) for key in keys)
    left_out = [
        Illustration(
            f"new-vehicle-{i}",
            f"{get_vehicle_name(key)} left out of training (Table 12)",
            "Bars: these rides. Dashed: the fitted physical model, the reference. "
            + (f"Open diamonds: the paper's. {PAPER_CAPTION}" if beside else ""),
            held_out.draw_new_vehicle(result, key),
            small=True,
        )
        for i, key in enumerate(keys)
        if any(get_new_vehicle_errors(result, recipe, key).mae is not None for recipe in result.new_vehicle)
    ]
    few = [
        Illustration(
            f"few-shot-{i}",
            f"{get_vehicle_name(key)}: error after some of its rides",
            "From no ride of the new vehicle model to many, on a logarithmic axis, with 95 % confidence intervals. "
            "Thick: the fitted physical model, the reference.",
            held_out.draw_few_shot(result, key),
            small=True,
        )
        for i, key in enumerate(result.few_shot)
    ]
    return left_out + few


def _selection(result: RecipeEvaluation) -> list[Illustration]:
    """Return the errors as terms are eliminated."""
    return [
        Illustration(
            "elimination",
            "Errors as terms are removed",
            "Above: cross-validated error of the hybrid model by the number of terms left, on the rides "
            "used to choose them. Below: increase of the error as terms are removed one by one, on the "
            "other rides, with 95 % confidence intervals.",
            selection.draw_elimination(result),
        )
    ]


MAKERS: Final[dict[str, Callable[[RecipeEvaluation], list[Illustration]]]] = {
    "data": _data,
    "summary": _summary,
    "difference": _difference,
    "places": _places,
    "reserve": _reserve,
    "splits": _splits,
    "transfer": _transfer,
    "selection": _selection,
}
"""Keys of sections -> functions that build their figures."""
