"""Build the tables of removable terms of the hybrid model, section 5.2 of the paper."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

from socast.core.evaluate.paper import published
from socast.tools.report.cells import UNKNOWN, Cell, ReportTable, Row, format_signed
from socast.tools.report.evaluation.result import Result, get_mapping, get_number, get_part

BEYOND: Final = 3
"""Number of terms that are listed after the last removable one."""


def tabulate_selection(result: Result) -> list[ReportTable]:
    """Return the tables of removed terms, and of the loss as terms are removed one after the other."""
    return [table for table in (tabulate_removed_terms(result), tabulate_steps(result)) if table.rows]


def tabulate_removed_terms(result: Result) -> ReportTable:
    """Return the terms that recursive elimination removed, with cross-validation (RFECV) and without (RFE).

    Units: returns [kWh].
    """
    selection = get_mapping(result, "selection")
    rows: list[Row] = []
    if selection.get("constant"):
        rows.append(Row("constant columns", (Cell(format_terms(selection["constant"])), Cell(""))))
    share = get_number(get_part(selection, "margin", "share"))
    for name, label in (
        ("margin", f"With a margin: error shown to be at most {100.0 * (share or 0.0):g} % larger"),
        ("rfecv", "RFECV: least cross-validated error"),
        ("rfe", "RFE: no significant loss"),
    ):
        if get_mapping(selection, name):
            theirs = format_terms(
                [term.replace("_", " ") for finding in published.get_findings(name) for term in finding.terms]
            )
            cells = (
                Cell(format_terms(get_part(selection, name, "removed") or ()), theirs),
                Cell(_loss(get_part(selection, name, "loss"))),
            )
            rows.append(Row(label, cells))
    note = (
        "Half of the rides choose the terms. The other half show the increase of the mean absolute error without them. "
        "RFE removes terms while no loss is significant, and few rides show hardly any. The margin asks that the "
        "one-sided 95 % interval of the loss lies below it, and takes the terms of physics last."
    )
    heads = ("terms removed", "loss, kWh")
    return ReportTable(
        "Terms that can be removed (sections 5.2.1 and 5.2.2)", "elimination", heads, tuple(rows), (note,)
    )


def tabulate_steps(result: Result) -> ReportTable:
    """Return the loss as terms are removed one after the other, up to `BEYOND` terms after the last removable one."""
    name = "margin" if get_part(result, "selection", "margin", "steps") else "rfe"
    steps = get_part(result, "selection", name, "steps") or []
    count = len(get_part(result, "selection", name, "removed") or ()) + BEYOND
    rows = tuple(
        Row(f"{i}  {format_terms([step.get('term')])}", (Cell(_loss(step.get("loss"))), Cell(_p(step.get("loss")))))
        for i, step in enumerate(steps[:count], start=1)
    )
    note = "Loss: increase of the mean absolute error when this term and all above it are removed."
    return ReportTable("Order in which terms are removed", "term", ("loss, kWh", "p"), rows, (note,))


def format_terms(names: Sequence[Any]) -> str:
    """Return names of terms separated by commas, `none` where there is none."""
    return ", ".join(str(name) for name in names) or "none"


def _loss(loss: Any) -> str:
    """Return a difference of errors as text, with its confidence interval where it has one."""
    value, ci95 = get_number(loss), get_number(get_part(loss, "ci95"))
    if value is None:
        return UNKNOWN
    return format_signed(value, 4) if ci95 is None else f"{format_signed(value, 4)} ± {ci95:.4f}"


def _p(loss: Mapping[str, Any] | None) -> str:
    """Return the p-value of a loss as text, `UNKNOWN` where it has none."""
    p = get_number(get_part(loss, "p"))
    return UNKNOWN if p is None else "< 0.001" if p < 0.001 else f"{p:.3f}"
