"""Build the tables of the data: the rides that the filter kept, and Tables 2 to 4 of the paper."""

from collections.abc import Callable
from types import MappingProxyType
from typing import Final

from socast.core.evaluate.paper import published
from socast.core.evaluate.paper.published import AVERAGE, WEIGHTED, PublishedFigure
from socast.core.evaluate.paper.records import EstimateTable, EvaluatedTable, Numbers, RecipeEvaluation
from socast.core.evaluate.records import EstimatedValue
from socast.tools.report.cells import (
    UNKNOWN,
    Cell,
    ReportTable,
    Row,
    format_cluster,
    format_count,
    format_energy,
    format_percent,
    format_published,
    get_value,
)
from socast.tools.report.evaluation.result import get_vehicle_name, list_clusters, list_vehicle_models

MEASURED_BY: Final = MappingProxyType({"vi": "voltage and current", "soc": "state of charge"})
"""Sources of the measured energy of a ride -> their names for readers."""


AVERAGE_NOTE: Final = "* Unweighted mean over the clusters that have a figure."
"""Note below tables that have a column of averages."""


def tabulate_data(result: RecipeEvaluation) -> list[ReportTable]:
    """Return the tables of the data that have a row."""
    tables = (
        tabulate_ride_filter(result),
        tabulate_rides(result),
        tabulate_consumption(result),
        tabulate_test_consumption(result),
    )
    return [table for table in tables if table.rows]


def tabulate_ride_filter(result: RecipeEvaluation) -> ReportTable:
    """Return the number of rides, and how many the filter left out for which reason."""
    about, total = result.about, result.about.rides
    rows: list[Row] = []
    if total is not None:
        published_count = format_count(published.get_statement("rides").value)
        rows.append(Row("rides", (Cell(format_count(total), published_count), Cell(""))))
    for reason, count in about.unfit.items():
        rows.append(_counted(f"left out: {reason.replace('_', ' ')}", count, total))
    removed = sum(about.unfit.values())
    if removed:
        published_count = format_count(published.get_statement("rides_removed").value)
        share = published.get_statement("rides_removed").value / published.get_statement("rides").value
        rows.append(
            Row(
                "left out, all",
                (Cell(format_count(removed), published_count), Cell(_share(removed, total), format_percent(share))),
                total=True,
            )
        )
    if about.fit is not None:
        rows.append(_counted("evaluated", about.fit, total, last=True))
    return ReportTable("Rides and the filter (section 3)", "rides", ("count", "share"), tuple(rows), _origin(about))


def tabulate_rides(result: RecipeEvaluation) -> ReportTable:
    """Return the number of rides by vehicle model and cluster of distance, as Table 2 of the paper."""
    columns = [*list_clusters(result, result.rides.values()), "total"]
    rows = tuple(
        Row(
            get_vehicle_name(key),
            tuple(
                Cell(format_count(result.rides[key].get(c)), _paper_count(published.get_ride_count(key, c)))
                for c in columns
            ),
        )
        for key in list_vehicle_models(result)
        if key in result.rides
    )
    note = "Table 2 of the paper adds up to the rides before any was removed."
    return ReportTable("Rides by distance (Table 2)", "vehicle model", format_heads(columns), rows, (note,))


def tabulate_consumption(result: RecipeEvaluation) -> ReportTable:
    """Return the mean consumption by vehicle model and cluster of distance, as Table 3 of the paper. [kWh]"""
    return tabulate_by_cluster(
        result,
        result.consumption,
        "Mean consumption of a ride, kWh (Table 3)",
        published.get_consumption,
    )


def tabulate_test_consumption(result: RecipeEvaluation) -> ReportTable:
    """Return the mean consumption in the test sets by vehicle model and cluster, as Table 4 of the paper. [kWh]"""
    table = tabulate_by_cluster(
        result,
        result.test_consumption,
        "Mean consumption of a ride in the test sets, kWh (Table 4)",
        published.get_test_consumption,
    )
    return table._replace(notes=(*table.notes, "± is half of the 95 % confidence interval over the repeated draws."))


def tabulate_by_cluster(
    result: RecipeEvaluation,
    energies: EstimateTable | Numbers,
    title: str,
    paper: Callable[[str, str], PublishedFigure | None],
) -> ReportTable:
    """Return a table of energies by vehicle model and cluster of distance. [kWh]

    The table has an average column and a weighted row where the evaluation has figures for them.

    Parameters
    ----------
    paper : callable
        Returns the paper's figure of a vehicle model and a cluster, None where the paper has none.
    """
    columns = list_clusters(result, energies.values())
    if any(AVERAGE in row for row in energies.values()):
        columns.append(AVERAGE)
    keys = [key for key in (*list_vehicle_models(result), WEIGHTED) if key in energies]
    rows = tuple(
        Row(
            "Weighted average" if key == WEIGHTED else get_vehicle_name(key),
            tuple(_beside(energies[key].get(column), paper(key, column)) for column in columns),
            total=key == WEIGHTED,
        )
        for key in keys
    )
    notes = (AVERAGE_NOTE,) if AVERAGE in columns else ()
    return ReportTable(title, "vehicle model", format_heads(columns), rows, notes)


def format_heads(columns: list[str]) -> tuple[str, ...]:
    """Return the headings of columns that are clusters, an average or a total."""
    special = {AVERAGE: "average *", "total": "total"}
    return tuple(special.get(column) or format_cluster(column) for column in columns)


def _beside(value: EstimatedValue | float | None, figure: PublishedFigure | None) -> Cell:
    """Return a cell with the figure of this evaluation and that of the paper, an empty cell where there is neither."""
    if get_value(value) is None and figure is None:
        return Cell("")
    return Cell(format_energy(value), format_published(figure))


def _paper_count(figure: PublishedFigure | None) -> str:
    """Return a count of the paper, empty text where it has none."""
    return "" if figure is None else format_count(figure.value)


def _counted(name: str, count: int, total: int | None, *, last: bool = False) -> Row:
    """Return a row with a count and its share of the total."""
    return Row(name, (Cell(format_count(count)), Cell(_share(count, total))), total=last)


def _share(value: int, total: int | None) -> str:
    """Return a value as a share of the total, `UNKNOWN` where that is unknown."""
    return format_percent(value / total) if total else UNKNOWN


def _origin(about: EvaluatedTable) -> tuple[str, ...]:
    """Return notes on the dates of the rides, the source of their energy, and how test sets were drawn."""
    notes: list[str] = []
    if about.first_date:
        cars = "" if about.vehicles is None else f", {format_count(about.vehicles)} cars"
        notes.append(f"From {about.first_date} to {about.last_date}{cars}.")
    if about.energy_source:
        used = {MEASURED_BY.get(name, name): share for name, share in about.energy_source.items() if share}
        shares = ", ".join(f"{name} {format_percent(share)}" for name, share in used.items())
        notes.append(f"Energy measured by: {shares}.")
    if about.repeats is not None:
        share = format_percent(about.test_share, 0)
        drawn = f"{about.repeats} draws of {share} test rides within each cluster and vehicle model"
        notes.append(f"{drawn}, seed {about.seed}.")
    return tuple(notes)
