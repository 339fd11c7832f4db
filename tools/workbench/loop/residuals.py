"""Records of the page about failures: the residual along any column, and the location of the error."""

from typing import Any, Final

import numpy as np

from socast.core.batch import Ints
from socast.core.diagnose.records import Diagnosis
from socast.core.diagnose.residual_survey import (
    MOST_NAMES,
    ColumnResiduals,
    bin_residual,
    read_window_residuals,
    survey_columns,
)
from socast.core.diagnose.shown_columns import ShownColumn, describe_column, list_columns
from socast.core.errors import SettingsError
from socast.core.stats.bin_means import split_at_quantiles
from socast.tools.report.diagnosis.location_sentences import KIND_NAMES, LEVEL_NAMES, describe_location
from socast.tools.report.diagnosis.sentences import describe_error
from socast.tools.workbench.loop.command_lines import diagnose_command
from socast.tools.workbench.loop.model_tree import ModelNode
from socast.tools.workbench.loop.ride_columns import select_by_filter
from socast.tools.workbench.loop.rides import ENERGIES, list_ride_columns, round_values, select_compared
from socast.tools.workbench.workspace import Workspace

FACET_BINS: Final = 3
"""Number of parts into which a column of numbers is divided for facets."""
MOST_POINTS: Final = 6000
"""Largest number of points that a page draws; of more rows, every k-th is drawn."""


def read_residuals(workspace: Workspace, node: ModelNode, level: str, text: str = "") -> ColumnResiduals:
    """Return the residuals of the rides that a filter keeps."""
    compared = select_compared(workspace, [node])
    kept = select_by_filter(compared.rides, text, list_ride_columns(compared, node.name)[: len(ENERGIES)])
    if level == "rides":
        rows = np.flatnonzero(kept)
        table = compared.rides.iloc[rows].reset_index(drop=True)
        error = (compared.predicted[node.name] - compared.measured)[rows]
        keys = [compared.keys[row] for row in rows]
        day = np.unique(compared.clusters[rows], return_inverse=True)[1]
        return ColumnResiduals(error, np.ones(len(rows)), day, keys, list_columns(table), "kWh")
    if level != "windows":
        raise SettingsError(f"level {level!r} is unknown; choose rides or windows")
    return read_window_residuals(workspace.gather(node), set(compared.rides.loc[kept, "ride_key"].astype(str)))


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
    colour, facet : str
        Column of the colour, and column that divides the points into charts; empty for none.

    Returns
    -------
    dict
        `columns` to choose from; `x`, `colour`; `unit` of the residual; `facets`, each with a `title`, `points` and
        `bins`; the number of `rows`, of which every `every`-th is among the points.
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
    means beyond what their standard errors cause. Those with a mean off zero come first, then the largest spread.
    """
    seen = read_residuals(workspace, node, level, text)
    return {"unit": seen.unit, "rows": len(seen.value), "charts": survey_columns(seen)}


def describe_failures(workspace: Workspace, node: ModelNode, diagnosis: Diagnosis) -> dict[str, Any]:
    """Return the slices that a diagnosis found, and the location of the error."""
    location = diagnosis.error_location
    return {
        "error": diagnosis.error.to_json(),
        "sentences": describe_error(diagnosis),
        "slices": [{**one.to_json(), "words": one.words} for one in diagnosis.slices],
        "location": {
            "sentences": describe_location(diagnosis),
            "shares": location.shares,
            "estimates": [
                {**one.to_json(), "level_name": LEVEL_NAMES[one.level], "kind_name": KIND_NAMES[one.kind]}
                for one in location.estimates
            ],
        },
        "command": diagnose_command(workspace, node),
    }


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
