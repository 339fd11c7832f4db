"""Records of the page about failures: the residual along any column, and the location of the error."""

from typing import Any, Final, NamedTuple

import numpy as np
import pandas as pd

from socast.core.batch import Floats, Ints
from socast.core.diagnose.bin_means import average_in_bins, split_at_quantiles
from socast.core.diagnose.dataset import Windows
from socast.core.errors import SettingsError
from socast.core.evaluate.compare import ride_wind
from socast.tools.report.diagnosis.location_sentences import KIND_NAMES, LEVEL_NAMES, describe_location
from socast.tools.report.diagnosis.sentences import describe_error, describe_slice
from socast.tools.workbench.loop.command_lines import diagnose_command
from socast.tools.workbench.loop.model_tree import ModelNode
from socast.tools.workbench.loop.ride_columns import (
    CATEGORIES,
    NUMBERS,
    ShownColumn,
    describe_column,
    list_columns,
    select_by_filter,
)
from socast.tools.workbench.loop.rides import ENERGIES, list_ride_columns, round_values, select_compared
from socast.tools.workbench.workspace import Workspace

BINS: Final = 12
"""Largest number of bins along a column."""
FACET_BINS: Final = 3
"""Number of parts into which a column of numbers is divided for facets."""
MOST_NAMES: Final = 24
"""Largest number of names along a category, and of facets: those with the most rows."""
MOST_POINTS: Final = 6000
"""Largest number of points that a page draws; of more rows, every k-th is drawn."""
NORMAL: Final = 1.96
"""Half width of a 95 % interval of a normal estimate. [standard errors]"""
LEAST_ROWS: Final = 5
"""Least mean number of rows in a bin."""


class Residuals(NamedTuple):
    """Hold the residuals of rides or windows.

    Parameters
    ----------
    value : (n,) float
        Predicted less measured energy of a ride [kWh], or mean power of a window [W].
    weight : (n,) float
        Weight in means: 1 for a ride, the duration of a window [s].
    day : (n,) int64
        Vehicle-day.
    keys : list of str
        Ride of each row.
    columns : list of (ShownColumn, (n,) array)
    unit : str
    """

    value: Floats
    weight: Floats
    day: Ints
    keys: list[str]
    columns: list[tuple[ShownColumn, Any]]
    unit: str


def read_residuals(workspace: Workspace, node: ModelNode, level: str, text: str = "") -> Residuals:
    """Return the residuals of the rides that a filter keeps.

    Parameters
    ----------
    workspace : Workspace
    node : ModelNode
        Model that predicts.
    level : str
        `rides` or `windows`.
    text : str
        Filter of rides, see `socast.tools.workbench.loop.ride_columns.select_by_filter`.

    Raises
    ------
    SettingsError
        If the level or the filter is not understood.
    """
    compared = select_compared(workspace, [node])
    kept = select_by_filter(compared.rides, text, list_ride_columns(compared, node.name)[: len(ENERGIES)])
    if level == "rides":
        rows = np.flatnonzero(kept)
        table = compared.rides.iloc[rows].reset_index(drop=True)
        error = (compared.predicted[node.name] - compared.measured)[rows]
        keys = [compared.keys[row] for row in rows]
        day = np.unique(compared.clusters[rows], return_inverse=True)[1]
        return Residuals(error, np.ones(len(rows)), day, keys, list_columns(table), "kWh")
    if level != "windows":
        raise SettingsError(f"level {level!r} is unknown; choose rides or windows")
    seen = workspace.gather(node)
    of_ride = seen.rides["ride_key"].astype(str).isin(set(compared.rides.loc[kept, "ride_key"].astype(str))).to_numpy()
    rows = np.flatnonzero(of_ride[seen.ride])
    table = _select_columns(seen, rows)
    seconds = table["duration_s"].to_numpy(np.float64)
    power = 3.6e6 * (seen.predicted - seen.measured)[rows] / seconds
    day = np.unique(seen.day[rows], return_inverse=True)[1]
    return Residuals(power, seconds, day, table["ride_key"].astype(str).tolist(), list_columns(table), "W")


def explore_residuals(
    workspace: Workspace,
    node: ModelNode,
    *,
    x: str,
    level: str = "windows",
    colour: str = "",
    facet: str = "",
    text: str = "",
) -> dict[str, Any]:
    """Return the residual along a column: the points, and their means in bins with intervals and counts.

    Parameters
    ----------
    workspace : Workspace
    node : ModelNode
        Model that predicts.
    x : str
        Column along the chart.
    level : str
        `rides` or `windows`.
    colour, facet : str
        Column of the colour, and column that divides the points into charts; empty for none.
    text : str
        Filter of rides.

    Returns
    -------
    dict
        `columns` to choose from; `x`, `colour`; `unit` of the residual; `facets`, each with a `title`, `points` and
        `bins`; the number of `rows`, of which every `every`-th is among the points.

    Raises
    ------
    SettingsError
        If there is no such column.
    """
    seen = read_residuals(workspace, node, level, text)
    known = {column.key: (column, values) for column, values in seen.columns}
    for key in filter(None, (x, colour, facet)):
        if key not in known:
            raise SettingsError(f"column {key!r} is not known of these {level}; choose from {', '.join(known)}")
    column, along = known[x]
    every = max(1, -(-len(seen.value) // MOST_POINTS))
    parts = _divide(*known[facet]) if facet else [("", np.arange(len(seen.value)))]
    facets = []
    for title, rows in parts:
        drawn = rows[::every]
        points = {"x": round_values(along[drawn]), "y": round_values(seen.value[drawn])}
        points["ride"] = [seen.keys[row] for row in drawn]
        if colour:
            points["colour"] = round_values(known[colour][1][drawn])
        facets.append({"title": title, "points": points, "bins": bin_residual(seen, column, along, rows)})
    return {
        "columns": [describe_column(each) for each, _ in seen.columns],
        "x": describe_column(column),
        "colour": describe_column(known[colour][0]) if colour else None,
        "unit": seen.unit,
        "facets": facets,
        "rows": len(seen.value),
        "every": every,
    }


def survey_residuals(workspace: Workspace, node: ModelNode, level: str, text: str = "") -> dict[str, Any]:
    """Return the mean residual along every column, for a page of small charts.

    Each chart has `outside`, the number of bins whose interval excludes zero, and `spread`, the root mean square of the
    means beyond what their standard errors cause. The largest spread comes first.
    """
    seen = read_residuals(workspace, node, level, text)
    charts: list[dict[str, Any]] = []
    for column, values in seen.columns:
        bins = bin_residual(seen, column, values, np.arange(len(values)))
        pairs = [(mean, half) for mean, half in zip(bins["mean"], bins["ci95"], strict=True) if half is not None]
        if len(pairs) > 1:
            outside = sum(abs(mean) > half for mean, half in pairs)
            chart = {"column": describe_column(column), "bins": bins, "outside": outside, "of": len(pairs)}
            charts.append(chart | {"spread": _measure_spread(bins)})
    charts.sort(key=lambda chart: -chart["spread"])
    return {"unit": seen.unit, "rows": len(seen.value), "charts": charts}


def bin_residual(seen: Residuals, column: ShownColumn, along: Any, rows: Ints) -> dict[str, Any]:
    """Return the mean residual of some rows in bins along a column.

    Parameters
    ----------
    seen : Residuals
    column : ShownColumn
        The column.
    along : (n,) array
        Its values.
    rows : (m,) int64
        Rows to average.

    Returns
    -------
    dict
        In bins: `x` (mean, or name), `low` and `high` ends, `mean` and half width `ci95` of its interval, numbers of
        `rows` and of vehicle-`days`.
    """
    values = along[rows]
    if column.unit:
        rows = rows[np.isfinite(values)]
        if len(rows) < LEAST_ROWS:
            return {name: [] for name in ("x", "low", "high", "mean", "ci95", "rows", "days")}
        values = along[rows]
        place, bins = split_at_quantiles(values, max(1, min(BINS, len(rows) // LEAST_ROWS)))
        middle: list[Any] = (np.bincount(place, values, bins) / np.bincount(place, minlength=bins)).tolist()
        ends = [[float(pick(values[place == i])) for i in range(bins)] for pick in (np.min, np.max)]
    else:
        names, place, count = np.unique(values, return_inverse=True, return_counts=True)
        most = np.sort([i for i in np.argsort(-count, kind="stable") if names[i]][:MOST_NAMES]).astype(np.int64)
        inside = np.isin(place, most)
        rows, place = rows[inside], np.searchsorted(most, place[inside])
        bins, middle, ends = len(most), names[most].tolist(), [[], []]
        if not bins:
            return {name: [] for name in ("x", "low", "high", "mean", "ci95", "rows", "days")}
    means = average_in_bins(place.astype(np.int64), bins, seen.value[rows], seen.weight[rows], seen.day[rows])
    return {
        "x": middle,
        "low": ends[0],
        "high": ends[1],
        "mean": means.value.tolist(),
        "ci95": [half if np.isfinite(half) else None for half in means.ci95.tolist()],
        "rows": means.windows.tolist(),
        "days": means.days.tolist(),
    }


def describe_failures(workspace: Workspace, node: ModelNode, diagnosis: dict[str, Any]) -> dict[str, Any]:
    """Return the slices that a diagnosis found, and the location of the error.

    Parameters
    ----------
    workspace : Workspace
    node : ModelNode
        The diagnosed model.
    diagnosis : dict
        Result of the diagnosis, as JSON values.
    """
    location = diagnosis.get("error_location") or {}
    return {
        "error": diagnosis["error"],
        "sentences": describe_error(diagnosis),
        "slices": [{**one, "words": describe_slice(one)} for one in diagnosis.get("slices") or ()],
        "location": {
            "sentences": describe_location(diagnosis),
            "shares": location.get("shares") or {},
            "estimates": [
                {**one, "level_name": LEVEL_NAMES[one["level"]], "kind_name": KIND_NAMES[one["kind"]]}
                for one in location.get("estimates") or ()
                if one["level"] in LEVEL_NAMES and one["kind"] in KIND_NAMES
            ],
        },
        "command": diagnose_command(workspace, node),
    }


def _measure_spread(bins: dict[str, Any]) -> float:
    """Return the root mean square of the means of bins, without what their standard errors cause."""
    known = [i for i, half in enumerate(bins["ci95"]) if half is not None]
    mean, half, rows = (np.array([bins[name][i] for i in known], dtype=np.float64) for name in ("mean", "ci95", "rows"))
    return float(np.sqrt(max(np.average(mean**2 - (half / NORMAL) ** 2, weights=rows), 0.0)))


def _select_columns(seen: Windows, rows: Ints) -> pd.DataFrame:
    """Return the columns of some windows that pages show, with the driver of their ride."""
    names = {column.key for column in (*NUMBERS, *CATEGORIES)}
    names |= {"ride_key", "window", "start_s", "duration_s", *ride_wind.COLUMNS}
    table = seen.table[[name for name in seen.table if name in names]].iloc[rows].reset_index(drop=True)
    if "driver_id" in seen.rides:
        table["driver_id"] = seen.rides["driver_id"].to_numpy()[seen.ride[rows]]
    return table


def _divide(column: ShownColumn, values: Any) -> list[tuple[str, Ints]]:
    """Return the titles and the rows of facets."""
    if column.unit:
        rows = np.flatnonzero(np.isfinite(values))
        if not len(rows):
            return []
        place, bins = split_at_quantiles(values[rows], FACET_BINS)
        parts = [rows[place == i] for i in range(bins)]
        return [(f"{values[part].min():.3g} to {values[part].max():.3g} {column.unit}", part) for part in parts]
    names, count = np.unique(values, return_counts=True)
    most = sorted(str(names[i]) for i in np.argsort(-count, kind="stable")[:MOST_NAMES] if names[i])
    return [(name, np.flatnonzero(values == name)) for name in most]
