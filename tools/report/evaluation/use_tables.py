"""Tables for who uses a model: where it errs, its intervals, the reserve it asks for."""

from collections.abc import Mapping
from statistics import quantiles
from types import MappingProxyType
from typing import Any, Final

from core.evaluate.paper import published
from tools.report.cells import Cell, ReportTable, Row, count, kwh, mark_least, percent, signed
from tools.report.evaluation.result import (
    Result,
    clusters,
    mapping,
    number,
    part,
    principal,
    recipes,
    title,
    vehicle_models,
    vehicle_name,
)

AXES: Final[Mapping[str, str]] = MappingProxyType(
    {"distance": "distance", "temperature": "outside temperature", "season": "season", "driver": "driver"}
)
"""What errors are told by, and what people call it."""

UNITS: Final[Mapping[str, str]] = MappingProxyType({"distance": ", km", "temperature": ", °C"})
"""Of what errors are told by, for heads of columns."""

MANY_BINS: Final = 20
"""Of more bins than these only the spread is told."""

UNSEEN: Final[Mapping[str, str]] = MappingProxyType(
    {"by_vehicle": "cars unseen", "by_date": "last dates unseen", "new_vehicle": "vehicle model unseen"}
)
"""Coverage where something was held out whole, and what people call it."""
NOMINAL: Final = 0.9
"""Coverage that intervals are made for."""
LEAST_COVERAGE: Final = 0.85
"""Of a 90 % interval in any cluster or season."""
COVERAGE_RANGE: Final = (0.88, 0.92)
"""Of a 90 % interval over all rides."""


def place_tables(result: Result) -> list[ReportTable]:
    """Return the errors by distance, temperature, season and driver."""
    found = [axis for axis in AXES if mapping(result, "by", axis)]
    tables = [spread(result, axis) if len(bins(result, axis)) > MANY_BINS else by_bin(result, axis) for axis in found]
    return [table for table in tables if table.rows]


def bins(result: Result, axis: str) -> list[str]:
    """Return the names of the bins of an axis, in their order."""
    return list(dict.fromkeys(str(b["bin"]) for recipe in recipes(result) for b in entries(result, axis, recipe)))


def bin_name(axis: str, name: str) -> str:
    """Return the name of a bin as people write it.

    Examples
    --------
    >>> bin_name("distance", "0-5"), bin_name("temperature", "-10 to -5")
    ('0–5', '−10 to −5')
    """
    return name.replace("-", {"distance": "–", "temperature": "−"}.get(axis, "-")).removesuffix(" °C")


def entries(result: Result, axis: str, recipe: str) -> list[Mapping[str, Any]]:
    """Return the errors of a model along an axis, bin by bin."""
    found = part(result, "by", axis, recipe)
    return [entry for entry in found or () if isinstance(entry, Mapping) and "bin" in entry]


def by_bin(result: Result, axis: str) -> ReportTable:
    """Return mean absolute error and bias in each bin, of the principal models."""
    names = [recipe for recipe in principal(result) if entries(result, axis, recipe)]
    found = {recipe: {str(entry["bin"]): entry for entry in entries(result, axis, recipe)} for recipe in names}
    rows = tuple(
        Row(
            bin_name(axis, label),
            (Cell(_rides(found, label)), *(_error_and_bias(found[recipe].get(label)) for recipe in names)),
        )
        for label in bins(result, axis)
    )
    heads = ("predictions", *(title(result, recipe) for recipe in names))
    note = "In parentheses, bias: mean of predicted less measured."
    return ReportTable(
        f"Mean absolute error by {AXES[axis]}, kWh", f"{AXES[axis]}{UNITS.get(axis, '')}", heads, rows, (note,)
    )


def spread(result: Result, axis: str) -> ReportTable:
    """Return how errors spread over many bins, such as drivers."""
    rows = []
    for recipe in recipes(result):
        errors = [mae for entry in entries(result, axis, recipe) if (mae := number(entry.get("mae"))) is not None]
        if len(errors) > 1:
            deciles = quantiles(errors, n=10, method="inclusive")
            figures = (min(errors), deciles[0], deciles[4], deciles[8], max(errors))
            rows.append(Row(title(result, recipe), (Cell(count(len(errors))), *(Cell(kwh(f)) for f in figures))))
    heads = (f"{AXES[axis]}s", "least", "10 % are below", "half are below", "90 % are below", "most")
    return ReportTable(f"Mean absolute error by {AXES[axis]}, kWh", "model", heads, tuple(rows))


def reserve_tables(result: Result) -> list[ReportTable]:
    """Return the coverage of intervals and the reserve that keeps rides above theirs."""
    found = (coverage(result), coverage_unseen(result), buffers(result), buffers_by_cluster(result))
    return [table for table in found if table.rows]


def coverage(result: Result) -> ReportTable:
    """Return the share of rides inside their 90 % interval: overall, by cluster, by season."""
    found = mapping(result, "coverage")
    names = [recipe for recipe in recipes(result) if mapping(found, recipe)]
    distances = clusters(result, (mapping(found, recipe, "cluster") for recipe in names))
    seasons = list(dict.fromkeys(season for recipe in names for season in mapping(found, recipe, "season")))
    rows = tuple(
        Row(
            title(result, recipe),
            (
                _covered(part(found, recipe, "overall"), *COVERAGE_RANGE),
                *(_covered(part(found, recipe, "cluster", c), LEAST_COVERAGE) for c in distances),
                *(_covered(part(found, recipe, "season", s), LEAST_COVERAGE) for s in seasons),
                Cell(kwh(part(found, recipe, "width_kwh"))),
            ),
        )
        for recipe in names
    )
    heads = ("overall", *(f"{c} km".replace("-", "–") for c in distances), *seasons, "width, kWh")
    low, high = COVERAGE_RANGE
    note = (
        f"↓ or ↑: outside of {percent(low, 0)} to {percent(high, 0)} overall, or below {percent(LEAST_COVERAGE, 0)} in "
        "a cluster or season. Width: mean of upper less lower end."
    )
    return ReportTable("Rides inside their 90 % prediction interval", "model", heads, rows, (note,))


def coverage_unseen(result: Result) -> ReportTable:
    """Return the share of rides inside their interval by vehicle model, and where cars, dates or models are unseen."""
    found = mapping(result, "coverage")
    names = [recipe for recipe in recipes(result) if mapping(found, recipe)]
    keys = [k for k in vehicle_models(result) if any(k in mapping(found, r, "vehicle_model") for r in names)]
    unseen = {kind: head for kind, head in UNSEEN.items() if any(kind in mapping(found, r) for r in names)}
    rows = tuple(
        Row(
            title(result, recipe),
            (
                *(_covered(part(found, recipe, "vehicle_model", key), LEAST_COVERAGE) for key in keys),
                *(_covered(part(found, recipe, kind), *COVERAGE_RANGE) for kind in unseen),
            ),
        )
        for recipe in names
    )
    heads = (*(vehicle_name(key) for key in keys), *unseen.values())
    return ReportTable(
        "Rides inside their 90 % prediction interval, by vehicle model and where something is unseen",
        "model",
        heads,
        rows if heads else (),
        ("An interval is made for rides like those it was calibrated on; unseen cars, days and models are others.",),
    )


def buffers(result: Result) -> ReportTable:
    """Return the energy in hand that keeps 95 % and 99 % of rides above their reserve."""
    found = mapping(result, "buffer_kwh")
    names = [recipe for recipe in recipes(result) if mapping(found, recipe)]
    shares = list(dict.fromkeys(share for recipe in names for share in mapping(found, recipe)))
    columns = [
        mark_least([Cell(kwh(part(found, r, share))) for r in names], [number(part(found, r, share)) for r in names])
        for share in shares
    ]
    rows = tuple(Row(title(result, recipe), tuple(c[i] for c in columns)) for i, recipe in enumerate(names))
    said = published.statement("buffer")
    note = (
        f"The paper's company came down to {said.value:g} kWh with the hybrid model with interaction terms, on its own "
        "rides, which are other data than these; the paper does not say how many rides that covers. Bold: the least."
    )
    heads = tuple(f"{share} % of rides" for share in shares)
    return ReportTable("Buffer that keeps rides above their reserve, kWh", "model", heads, rows, (note,))


def buffers_by_cluster(result: Result) -> ReportTable:
    """Return the same by distance, of the larger share of rides, of the principal models."""
    found = mapping(result, "buffer_by_cluster")
    names = [recipe for recipe in principal(result) if mapping(found, recipe)]
    shares = [share for recipe in names for row in mapping(found, recipe).values() for share in mapping(row)]
    if not shares:
        return ReportTable("", "", (), ())
    most = max(shares, key=float)
    at = {recipe: {c: part(found, recipe, c, most) for c in mapping(found, recipe)} for recipe in names}
    distances = clusters(result, at.values())
    rows = tuple(Row(title(result, recipe), tuple(Cell(kwh(at[recipe].get(c))) for c in distances)) for recipe in names)
    heads = tuple(f"{c} km".replace("-", "–") for c in distances)
    return ReportTable(f"Buffer for {most} % of rides by distance, kWh", "model", heads, rows)


def _rides(found: Mapping[str, Mapping[str, Mapping[str, Any]]], label: str) -> str:
    """Return the rides of a bin, of whichever model tells."""
    return count(next((entries[label].get("n") for entries in found.values() if label in entries), None))


def _error_and_bias(entry: Mapping[str, Any] | None) -> Cell:
    return Cell("" if entry is None else f"{kwh(entry.get('mae'))} ({signed(entry.get('bias'))})")


def _covered(share: Any, least: float, most: float = 1.0) -> Cell:
    """Return a share, marked where it is outside of its limits."""
    known = number(share)
    mark = "" if known is None or least <= known <= most else " ↓" if known < least else " ↑"
    return Cell(f"{percent(share)}{mark}", strong=bool(mark))
