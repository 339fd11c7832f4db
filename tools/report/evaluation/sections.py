"""Arrange a report: the order of its sections, their texts and their tables."""

from typing import NamedTuple

from socast.core.evaluate.paper import published
from socast.core.evaluate.paper.published import PHYSICAL, PaperStatement
from socast.core.evaluate.paper.records import RecipeEvaluation
from socast.tools.report.cells import Cell, ReportTable, Row, format_change, format_energy, format_percent
from socast.tools.report.evaluation.data_tables import tabulate_data
from socast.tools.report.evaluation.error_tables import tabulate_all_errors, tabulate_differences, tabulate_summaries
from socast.tools.report.evaluation.percentage_tables import (
    HELD_OUT,
    find_best_on_new_vehicles,
    get_new_vehicle_reductions,
    get_reductions,
    list_known_baselines,
    make_baseline_table,
    tabulate_percentages,
)
from socast.tools.report.evaluation.result import (
    ALL,
    FITTED,
    INTERACTIONS,
    compute_overall_error,
    find_best,
    get_title,
    list_vehicle_models,
    select_principal,
)
from socast.tools.report.evaluation.selection_tables import tabulate_selection
from socast.tools.report.evaluation.split_tables import tabulate_all_splits
from socast.tools.report.evaluation.transfer_tables import tabulate_transfer
from socast.tools.report.evaluation.use_tables import tabulate_places, tabulate_reserve


class Section(NamedTuple):
    """Hold a section of a report.

    Parameters
    ----------
    key : str
        Key of its figures, also used in links to it.
    folded : bool
        Whether its figures show the same as its tables. The page folds such tables away, the terminal leaves them out.
    closed : bool
        Whether the page folds the whole section away until a reader opens it.
    """

    key: str
    title: str
    text: str
    tables: list[ReportTable]
    folded: bool = False
    closed: bool = False


def build_sections(result: RecipeEvaluation) -> list[Section]:
    """Return the sections that have at least one table with a row."""
    matrices = [tabulate_differences(result, key) for key in (ALL, *list_vehicle_models(result))]
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
            tabulate_all_errors(result),
        ),
        Section(
            "difference",
            "Which differences are beyond chance",
            "Models compared on the same test rides, pair by pair.",
            [table for table in matrices if table.rows],
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
    paper = {INTERACTIONS: "reduction", FITTED: "new_vehicle_reduction"}
    statements = {recipe: published.get_statement(name) for recipe, name in paper.items()}
    shares = [("", recipe, get_reductions(result, recipe)) for recipe in best]
    shares += [(", vehicle model unseen", recipe, get_new_vehicle_reductions(result, recipe)) for recipe in unseen]
    present = list_known_baselines(known for _, _, known in shares)
    rows = tuple(
        Row(
            f"{get_title(result, recipe)}{where}",
            tuple(
                Cell(
                    "" if name == recipe else format_percent(known[name]),
                    _percent(statements.get(recipe)) if name == PHYSICAL else "",
                )
                for name in present
            ),
        )
        for where, recipe, known in shares
        if list_known_baselines([known])
    )
    return make_baseline_table("Error below each baseline, principal models", present, rows)


def _percent(statement: PaperStatement | None) -> str:
    """Return a share of the paper in percent, empty text where there is none."""
    return "" if statement is None else format_percent(statement.value, 2)


def tabulate_overview(result: RecipeEvaluation) -> ReportTable:
    """Return a table of the principal figures, with the paper's beside them."""
    rows = [
        _percentage(result),
        _beyond_the_paper(result),
        _unbeaten(result),
        _relative(result, "0-5", published.get_statement("relative_error_short")),
        _relative(result, "20-25", published.get_statement("relative_error_long")),
        _buffer(result),
        *(
            _row(
                f"Rides inside their 90 % interval: {get_title(result, recipe)}",
                format_percent(result.coverage[recipe].overall),
            )
            for recipe in select_principal(result)
            if recipe in result.coverage
        ),
    ]
    return ReportTable("At a glance", "figure", ("here",), tuple(row for row in rows if row is not None))


def _row(name: str, here: str, paper: str = "") -> Row:
    """Return a row with a figure of this evaluation and one of the paper."""
    return Row(name, (Cell(here, paper),))


def _percentage(result: RecipeEvaluation) -> Row | None:
    """Return a row with the percentage errors of the best model on unseen rides, cars and dates."""
    best = find_best(result) or ""
    errors = {unseen: result.percentage.get_split(kind).recipes.get(best) for kind, unseen in HELD_OUT.items()}
    known = {unseen: each.wmape for unseen, each in errors.items() if each and each.wmape.value is not None}
    here = ", ".join(f"{unseen} {format_percent(share)}" for unseen, share in known.items())
    return _row(f"Error over energy (wMAPE): {get_title(result, best)}", here) if here else None


def _beyond_the_paper(result: RecipeEvaluation) -> Row | None:
    """Return a row that compares the best model with the best model of the paper, None where they are the same."""
    winner, reference = find_best(result), compute_overall_error(result, INTERACTIONS)
    if winner is None or winner == INTERACTIONS or reference is None:
        return None
    label = f"Average error of {get_title(result, winner)} against {get_title(result, INTERACTIONS)}"
    return _row(label, format_change(compute_overall_error(result, winner), reference))


def _unbeaten(result: RecipeEvaluation) -> Row | None:
    """Return a row with the models that dominate or co-dominate on every vehicle model."""
    dominating = [result.dominates.get(key, []) for key in list_vehicle_models(result)]
    names = [get_title(result, r) for r in (dominating[0] if dominating else ()) if all(r in of for of in dominating)]
    paper = f"{get_title(result, INTERACTIONS)}, or it and others"
    return (
        _row("Dominates or co-dominates on every vehicle model", "; ".join(names) or "none", paper)
        if dominating
        else None
    )


def _relative(result: RecipeEvaluation, cluster: str, statement: PaperStatement) -> Row | None:
    """Return a row with error over consumption in a cluster of distance."""
    share = result.relative.get(INTERACTIONS, {}).get(cluster)
    label = f"Error over consumption, rides of {cluster.replace('-', '–')} km: {get_title(result, INTERACTIONS)}"
    return None if share is None else _row(label, format_percent(share), f"about {format_percent(statement.value, 0)}")


def _buffer(result: RecipeEvaluation) -> Row | None:
    """Return a row with the buffers that the best model of the paper needs."""
    buffers = result.buffer_kwh.get(INTERACTIONS, {})
    if not buffers:
        return None
    here = ", ".join(f"{format_energy(energy)} kWh for {share} % of rides" for share, energy in buffers.items())
    statement = published.get_statement("buffer")
    return _row(f"Buffer: {get_title(result, INTERACTIONS)}", here, f"{statement.value:g} kWh, share not stated")
