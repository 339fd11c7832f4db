"""Tables of the data: what the filter left, Tables 2 to 4 of the paper."""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, Final

from core.evaluate.paper import published
from core.evaluate.paper.published import AVERAGE, WEIGHTED, Published
from tools.report.cells import UNKNOWN, Cell, ReportTable, Row, count, kwh, percent, printed
from tools.report.evaluation.result import Result, clusters, mapping, number, part, vehicle_models, vehicle_name

MEASURED_BY: Final = MappingProxyType({"vi": "voltage and current", "soc": "state of charge"})
"""How the energy of rides was measured, for people."""


AVERAGE_NOTE: Final = "* Plain mean over the clusters that have a figure, each counted once."


def data_tables(result: Result) -> list[ReportTable]:
    """Return the tables of the data, those that have a row."""
    found = (ride_filter(result), rides(result), consumption(result), consumption_in_tests(result))
    return [table for table in found if table.rows]


def ride_filter(result: Result) -> ReportTable:
    """Return how many rides there are, and how many are left out and why."""
    about = mapping(result, "about")
    total = number(about.get("rides"))
    rows: list[Row] = []
    if total is not None:
        said = printed_count(published.statement("rides").value)
        rows.append(Row("rides", (Cell(count(total), said), Cell(""))))
    for reason, found in mapping(about, "unfit").items():
        rows.append(_counted(f"left out: {reason.replace('_', ' ')}", found, total))
    removed = sum(number(found) or 0.0 for found in mapping(about, "unfit").values())
    if removed:
        said = printed_count(published.statement("rides_removed").value)
        share = published.statement("rides_removed").value / published.statement("rides").value
        rows.append(
            Row("left out, all", (Cell(count(removed), said), Cell(_share(removed, total), percent(share))), total=True)
        )
    if number(about.get("fit")) is not None:
        rows.append(_counted("evaluated", about["fit"], total, last=True))
    return ReportTable("Rides and the filter (section 3)", "rides", ("count", "share"), tuple(rows), _origin(about))


def rides(result: Result) -> ReportTable:
    """Return the number of rides by vehicle model and cluster, Table 2."""
    found = mapping(result, "rides")
    columns = [*clusters(result, found.values()), "total"]
    rows = tuple(
        Row(
            vehicle_name(key),
            tuple(Cell(count(part(found, key, c)), _paper_count(published.rides(key, c))) for c in columns),
        )
        for key in vehicle_models(result)
        if key in found
    )
    note = "Table 2 of the paper adds up to the rides before any was removed."
    return ReportTable("Rides by distance (Table 2)", "vehicle model", heads(columns), rows, (note,))


def consumption(result: Result) -> ReportTable:
    """Return the mean consumption by vehicle model and cluster, Table 3."""
    return by_cluster(
        result, mapping(result, "consumption"), "Mean consumption of a ride, kWh (Table 3)", published.consumption
    )


def consumption_in_tests(result: Result) -> ReportTable:
    """Return the mean consumption in the test sets, Table 4."""
    table = by_cluster(
        result,
        mapping(result, "test_consumption"),
        "Mean consumption of a ride in the test sets, kWh (Table 4)",
        published.consumption_in_tests,
    )
    return table._replace(notes=(*table.notes, "± is half of the 95 % confidence interval over the repeated draws."))


def by_cluster(
    result: Result, found: Mapping[str, Any], title: str, paper: Callable[[str, str], Published | None]
) -> ReportTable:
    """Return a table of energies by vehicle model and cluster, with average and weighted row where there are any.

    Parameters
    ----------
    result : mapping
        Of the evaluation.
    found : mapping
        Vehicle model, or `WEIGHTED` -> cluster -> figure. [kWh]
    title : str
    paper : callable
        Gives the paper's figure of a vehicle model and a cluster.
    """
    columns = clusters(result, found.values())
    if any(AVERAGE in mapping(row) for row in found.values()):
        columns.append(AVERAGE)
    keys = [key for key in (*vehicle_models(result), WEIGHTED) if key in found]
    rows = tuple(
        Row(
            "Weighted average" if key == WEIGHTED else vehicle_name(key),
            tuple(_beside(part(found, key, column), paper(key, column)) for column in columns),
            total=key == WEIGHTED,
        )
        for key in keys
    )
    notes = (AVERAGE_NOTE,) if AVERAGE in columns else ()
    return ReportTable(title, "vehicle model", heads(columns), rows, notes)


def heads(columns: list[str]) -> tuple[str, ...]:
    """Return the heads of columns that are clusters, an average or a total."""
    special = {AVERAGE: "average *", "total": "total"}
    return tuple(special.get(column, f"{column} km".replace("-", "–")) for column in columns)


def _beside(value: Any, figure: Published | None) -> Cell:
    """Return a cell of ours and the paper's, empty where there is neither."""
    if number(value) is None and figure is None:
        return Cell("")
    return Cell(kwh(value), printed(figure))


def printed_count(value: float) -> str:
    """Return a count of the paper."""
    return f"{value:,.0f}"


def _paper_count(figure: Published | None) -> str:
    return "" if figure is None else printed_count(figure.value)


def _counted(name: str, found: Any, total: float | None, *, last: bool = False) -> Row:
    """Return a row of a count and its share."""
    return Row(name, (Cell(count(found)), Cell(_share(number(found), total))), total=last)


def _share(value: float | None, total: float | None) -> str:
    return percent(value / total) if value is not None and total else UNKNOWN


def _origin(about: Mapping[str, Any]) -> tuple[str, ...]:
    """Return sentences on when the rides were, how their energy was measured and how they were drawn."""
    notes: list[str] = []
    if about.get("first_date"):
        cars = f", {count(about['vehicles'])} cars" if number(about.get("vehicles")) is not None else ""
        notes.append(f"From {about['first_date']} to {about.get('last_date')}{cars}.")
    if sources := mapping(about, "energy_source"):
        used = {MEASURED_BY.get(name, name): share for name, share in sources.items() if number(share)}
        shares = ", ".join(f"{name} {percent(share)}" for name, share in used.items())
        notes.append(f"Energy measured by: {shares}.")
    repeats, share = number(about.get("repeats")), number(about.get("test_share"))
    if repeats is not None and share is not None:
        drawn = f"{repeats:.0f} draws of {percent(share, 0)} test rides within each cluster and vehicle model"
        notes.append(f"{drawn}, seed {about.get('seed')}.")
    return tuple(notes)
