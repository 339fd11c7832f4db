"""Build the tables of removable terms of the hybrid model, section 5.2 of the paper."""

from collections.abc import Sequence
from typing import Final

from socast.core.evaluate.paper import published
from socast.core.evaluate.paper.records import EliminationStep, RecipeEvaluation
from socast.tools.report.cells import Cell, ReportTable, Row, format_difference
from socast.tools.report.record_table import FORMATS, tabulate_records

BEYOND: Final = 3
"""Number of terms that are listed after the last removable one."""


def tabulate_selection(result: RecipeEvaluation) -> list[ReportTable]:
    """Return the tables of removed terms, and of the loss as terms are removed one after the other."""
    return [table for table in (tabulate_removed_terms(result), tabulate_steps(result)) if table.rows]


def tabulate_removed_terms(result: RecipeEvaluation) -> ReportTable:
    """Return the terms that recursive elimination removed, with cross-validation (RFECV) and without (RFE). [kWh]"""
    selection = result.selection
    rows: list[Row] = []
    if selection.constant:
        rows.append(Row("constant columns", (Cell(format_terms(selection.constant)), Cell(""))))
    share = (selection.margin.share if selection.margin else None) or 0.0
    for name, label, elimination in (
        ("margin", f"With a margin: error shown to be at most {100.0 * share:g} % larger", selection.margin),
        ("rfecv", "RFECV: least cross-validated error", selection.rfecv),
        ("rfe", "RFE: no significant loss", selection.rfe),
    ):
        if elimination is not None:
            theirs = format_terms(
                [term.replace("_", " ") for finding in published.get_findings(name) for term in finding.terms]
            )
            removed, loss = format_terms(elimination.removed), format_difference(elimination.loss, 4)
            rows.append(Row(label, (Cell(removed, theirs), Cell(loss))))
    note = (
        "Half of the rides choose the terms. The other half show the increase of the mean absolute error without them. "
        "RFE removes terms while no loss is significant, and few rides show hardly any. The margin asks that the "
        "one-sided 95 % interval of the loss lies below it, and takes the terms of physics last."
    )
    heads = ("terms removed", "loss, kWh")
    return ReportTable(
        "Terms that can be removed (sections 5.2.1 and 5.2.2)", "elimination", heads, tuple(rows), (note,)
    )


def tabulate_steps(result: RecipeEvaluation) -> ReportTable:
    """Return the loss as terms are removed one after the other, up to `BEYOND` terms after the last removable one."""
    shown = next((each for each in (result.selection.margin, result.selection.rfe) if each and each.steps), None)
    steps = (shown.steps or [])[: len(shown.removed) + BEYOND] if shown else []
    return tabulate_records(
        "Order in which terms are removed",
        {f"{i}  {step.term}": step for i, step in enumerate(steps, start=1)},
        EliminationStep,
        corner="term",
        fields=("loss", "p"),
        notes=("Loss: increase of the mean absolute error when this term and all above it are removed.",),
        formats={**FORMATS, "loss": lambda loss: format_difference(loss, 4)},
    )


def format_terms(names: Sequence[str]) -> str:
    """Return names of terms separated by commas, `none` where there is none."""
    return ", ".join(names) or "none"
