"""Build the tables of the data: the rides that the filter kept, and Tables 2 to 4 of the paper."""

from collections.abc import Callable
from functools import partial
from types import MappingProxyType
from typing import Final

from socast.core.evaluate.paper import published
from socast.core.evaluate.paper.published import AVERAGE, WEIGHTED, PublishedFigure
from socast.core.evaluate.paper.records import EstimateTable, EvaluatedTable, Numbers, RecipeEvaluation
from socast.tools.report.evaluation.result import get_vehicle_name, list_clusters, list_vehicle_models
from socast.tools.report.table import (
    UNKNOWN,
    Cell,
    ReportTable,
    format_cluster,
    format_count,
    format_energy,
    format_percent,
    format_published,
    get_value,
    keep_filled,
    tabulate,
)

MEASURED_BY: Final = MappingProxyType({"vi": "voltage and current", "soc": "state of charge"})
"""Sources of the measured energy of a ride -> their names for readers."""


AVERAGE_NOTE: Final = "* Unweighted mean over the clusters that have a figure."
"""Note below tables that have a column of averages."""


def tabulate_data(result: RecipeEvaluation) -> list[ReportTable]:
    """Return the tables of the rides by cluster of distance, and of their mean consumption, that have a row. [kWh]"""
    consumption = tabulate_by_cluster(
        result, result.consumption, "Mean consumption of a ride, kWh (Table 3)", published.get_consumption
    )
    tested = tabulate_by_cluster(
        result,
        result.test_consumption,
        "Mean consumption of a ride in the test sets, kWh (Table 4)",
        published.get_test_consumption,
        ("± is half of the 95 % confidence interval over the repeated draws.",),
    )
    return keep_filled(tabulate_ride_filter(result), tabulate_rides(result), consumption, tested)


def tabulate_ride_filter(result: RecipeEvaluation) -> ReportTable:
    """Return the number of rides, and how many the filter left out for which reason."""
    about, total = result.about, result.about.rides
    removed, all_rides = (published.get_statement(name).value for name in ("rides_removed", "rides"))
    counts = {"rides": total} | {
        f"left out: {reason.replace('_', ' ')}": count for reason, count in about.unfit.items()
    }
    counts |= {"left out, all": sum(about.unfit.values()) or None, "evaluated": about.fit}
    papers = {
        "rides": (format_count(all_rides), ""),
        "left out, all": (format_count(removed), _share(removed, all_rides)),
    }

    def make_share(name: str) -> Cell:
        shown = "" if name == "rides" else _share(counts[name] or 0, total)
        return Cell(shown, papers.get(name, ("", ""))[1])

    rows = [(name, name) for name, count in counts.items() if count is not None]
    columns = (
        ("count", lambda name: Cell(format_count(counts[name]), papers.get(name, ("", ""))[0])),
        ("share", make_share),
    )
    totals = ("left out, all", "evaluated")
    return tabulate("Rides and the filter (section 3)", "rides", rows, columns, _origin(about), totals=totals)


def tabulate_rides(result: RecipeEvaluation) -> ReportTable:
    """Return the number of rides by vehicle model and cluster of distance, as Table 2 of the paper."""

    def make_cell(cluster: str, key: str) -> Cell:
        theirs = published.get_ride_count(key, cluster)
        return Cell(format_count(result.rides[key].get(cluster)), "" if theirs is None else format_count(theirs.value))

    columns = [*list_clusters(result, result.rides.values()), "total"]
    rows = [(get_vehicle_name(key), key) for key in list_vehicle_models(result) if key in result.rides]
    note = "Table 2 of the paper adds up to the rides before any was removed."
    heads = [(format_head(each), partial(make_cell, each)) for each in columns]
    return tabulate("Rides by distance (Table 2)", "vehicle model", rows, heads, (note,))


def tabulate_by_cluster(
    result: RecipeEvaluation,
    energies: EstimateTable | Numbers,
    title: str,
    paper: Callable[[str, str], PublishedFigure | None],
    notes: tuple[str, ...] = (),
) -> ReportTable:
    """Return a table of energies by vehicle model and cluster of distance. [kWh]

    The table has an average column and a weighted row where the evaluation has figures for them.

    Parameters
    ----------
    paper : callable
        Returns the paper's figure of a vehicle model and a cluster, None where the paper has none.
    """

    def make_cell(cluster: str, key: str) -> Cell:
        value, figure = energies[key].get(cluster), paper(key, cluster)
        if get_value(value) is None and figure is None:
            return Cell("")
        return Cell(format_energy(value), format_published(figure))

    columns = list_clusters(result, energies.values())
    if any(AVERAGE in row for row in energies.values()):
        columns, notes = [*columns, AVERAGE], (AVERAGE_NOTE, *notes)
    rows = [(get_vehicle_name(key), key) for key in (*list_vehicle_models(result), WEIGHTED) if key in energies]
    heads = [(format_head(each), partial(make_cell, each)) for each in columns]
    return tabulate(title, "vehicle model", rows, heads, notes, totals=(get_vehicle_name(WEIGHTED),))


def format_head(column: str) -> str:
    """Return the heading of a column that is a cluster, an average or a total."""
    return {AVERAGE: "average *", "total": "total"}.get(column) or format_cluster(column)


def _share(value: float, total: float | None) -> str:
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
