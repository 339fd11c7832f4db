"""Records of the page about rides: predicted against measured energy, and the trace of one ride."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from socast.core.diagnose.shown_columns import ShownColumn, describe_column, list_columns
from socast.core.errors import ModelError, SettingsError
from socast.core.evaluate.compare.models import (
    ComparedRides,
    compute_errors,
    describe_rides,
    format_exclusions,
    list_notes,
    select_rides,
)
from socast.core.evaluate.compare.ride_trace import find_ride, trace_ride
from socast.core.records import to_json_values
from socast.tools.workbench.loop.command_lines import compare_command
from socast.tools.workbench.loop.model_tree import ModelNode
from socast.tools.workbench.loop.ride_columns import select_by_filter
from socast.tools.workbench.workspace import Workspace

ENERGIES: Final = (
    ShownColumn("measured_kwh", "Measured energy", "kWh"),
    ShownColumn("predicted_kwh", "Predicted energy", "kWh"),
    ShownColumn("error_kwh", "Error, predicted less measured", "kWh"),
    ShownColumn("error_pct", "Relative error", "%"),
)
DIGITS: Final = 5
"""Significant digits of numbers that a page draws."""
LEAST_KWH: Final = 0.1
"""Measured energy below which a relative error means little, as for the MAPE. [kWh]"""


def select_compared(workspace: Workspace, nodes: Sequence[ModelNode]) -> ComparedRides:
    """Return the rides that every given model predicts, with their predictions."""
    return select_rides(workspace.tables.rides, {node.name: node.model for node in nodes})


def list_ride_columns(compared: ComparedRides, model: str) -> list[tuple[ShownColumn, Any]]:
    """Return the columns of compared rides, the energies first."""
    measured, predicted = compared.measured, compared.predicted[model]
    error = predicted - measured
    relative = np.divide(100.0 * error, measured, out=np.full(len(error), np.nan), where=measured >= LEAST_KWH)
    energies = list(zip(ENERGIES, (measured, predicted, error, relative), strict=True))
    return [*energies, *list_columns(compared.rides)]


def describe_compared_rides(workspace: Workspace, node: ModelNode) -> dict[str, Any]:
    """Return every ride with its columns, for the scatter, the list and the filters of the page.

    Returns
    -------
    dict
        `columns`, their `values` by key, `keys` of the rides, `about` the rides, and the `command`.
    """
    compared = select_compared(workspace, [node])
    columns = list_ride_columns(compared, node.name)
    return {
        "model": node.name,
        "columns": [describe_column(column) for column, _ in columns],
        "values": {column.key: round_values(values) for column, values in columns},
        "keys": compared.keys,
        "about": describe_rides(compared).to_json() | {"left_out_words": format_exclusions(compared.left_out)},
        "notes": list_notes(compared),
        "command": compare_command(workspace, [node]),
    }


def measure_selection(workspace: Workspace, node: ModelNode, text: str) -> dict[str, Any]:
    """Return the errors of the rides that a filter keeps, and which these are.

    Returns
    -------
    dict
        `errors` as of `socast.core.evaluate.compare.models.compute_errors`, None where no ride is kept;
        `noise_floor_kwh`; and `kept`, the places of the rides.
    """
    compared = select_compared(workspace, [node])
    kept = select_by_filter(compared.rides, text, list_ride_columns(compared, node.name)[: len(ENERGIES)])
    rows = np.flatnonzero(kept)
    if not len(rows):
        return {"errors": None, "noise_floor_kwh": None, "kept": []}
    part = replace(
        compared,
        rides=compared.rides.iloc[rows].reset_index(drop=True),
        measured=compared.measured[rows],
        predicted={label: energy[rows] for label, energy in compared.predicted.items()},
        clusters=compared.clusters[rows],
    )
    errors = compute_errors(part, part.predicted[node.name]).to_json()
    return {"errors": errors, "noise_floor_kwh": to_json_values(part.noise_floor), "kept": rows.tolist()}


def trace_one_ride(workspace: Workspace, nodes: Sequence[ModelNode], ride: str) -> dict[str, Any]:
    """Return the trace of a ride along its way, and the command that shows it."""
    models = {node.name: node.model for node in nodes}
    rides, windows, _ = workspace.tables
    row = find_ride(rides, ride)
    key = str(row["ride_key"].iloc[0]) if "ride_key" in row else ""
    command = {"command": compare_command(workspace, nodes, key or ride)}
    try:
        return {**trace_ride(row, windows, models).to_json(), "key": key, **command}
    except (ModelError, SettingsError) as error:
        return {"key": key, "untraced": str(error)} | command


def round_values(values: Any) -> list[Any]:
    """Return numbers with `DIGITS` significant digits, None where unknown; names as they are.

    Examples
    --------
    >>> round_values(np.array([1.23456789, np.nan])), round_values(np.array(["a"]))
    ([1.2346, None], ['a'])
    """
    if values.dtype.kind != "f":
        return list(map(str, values))
    return [float(f"{value:.{DIGITS}g}") if np.isfinite(value) else None for value in values.tolist()]
