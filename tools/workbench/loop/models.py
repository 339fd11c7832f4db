"""Records of the page about models: the tree, the history of each, comparisons, and shadows in service."""

from typing import Any

from socast.core.diagnose.add.records import ADDED, EffectAttempt, list_attempts
from socast.core.errors import SettingsError
from socast.core.evaluate.compare.models import compare_predictions
from socast.core.fit.model_summary import summarise_model
from socast.core.models import ANY
from socast.core.pipeline import Pipeline
from socast.core.records import to_json_values
from socast.stream.loop import collect_garbage_rarely, feed
from socast.stream.source import merge_sources
from socast.tools.terminal.model_comparison import make_records
from socast.tools.terminal.recordings import open_recordings
from socast.tools.workbench.loop.command_lines import (
    compare_command,
    history_command,
    list_fit_commands,
    live_command,
    replay_command,
)
from socast.tools.workbench.loop.model_tree import ModelNode, read_model_file
from socast.tools.workbench.loop.rides import select_compared
from socast.tools.workbench.workspace import Report, Workspace


def list_models(workspace: Workspace) -> dict[str, Any]:
    """Return the tree of models, and the folder of their files."""
    records = workspace.models.list_records()
    return {"models": records, "folder": str(workspace.models.folder), "temporary": workspace.is_temporary}


def describe_model(workspace: Workspace, node: ModelNode) -> dict[str, Any]:
    """Return the coefficients of a model with their intervals, its history, and its steps against the noise floor."""
    from socast.tools.report import error_fall, history  # noqa: PLC0415 - figures take seconds to import

    fitted, attempts = summarise_model(node.model), list_attempts(node.model.history)
    coefficients = {key: to_json_values(fit.coefficients) for key, fit in fitted.fits.items()}
    commands = [history_command(node)]
    return {
        "name": node.name,
        "parent": node.parent,
        "file": str(node.file),
        "version": node.model.version,
        "origin": node.origin,
        "title": fitted.title,
        "training": to_json_values(fitted.training),
        "coefficients": coefficients.pop(ANY, []),
        "by_vehicle_model": coefficients,
        "progress": history.describe_progress(node.model),
        "picture": error_fall.draw_error_fall(attempts, standalone=False),
        "steps": [_describe_step(attempt) for attempt in attempts],
        "commands": [*(list_fit_commands(workspace, node) if node.origin == "fitted" else []), *commands],
    }


def compare_two(workspace: Workspace, one: ModelNode, other: ModelNode) -> dict[str, Any]:
    """Return the errors of two models on the same rides, and the step between them if one was made of the other."""
    if one.name == other.name:
        raise SettingsError(f"both models are {one.name}; choose two different ones")
    result = compare_predictions(select_compared(workspace, [one, other]))
    return {
        "about": result.about.to_json(),
        "models": {name: {**errors.to_json(), "worst": None, "by": None} for name, errors in result.models.items()},
        "difference": to_json_values(next(iter(result.pairs), None)),
        "step": _find_step(one, other) or _find_step(other, one),
        "rides": result.rides.to_json(),
        "coefficients": {node.name: describe_model(workspace, node)["coefficients"] for node in (one, other)},
        "command": compare_command(workspace, [one, other]),
        "live_command": live_command(workspace, [one, other]),
    }


@collect_garbage_rarely()
def run_shadows(
    workspace: Workspace, one: ModelNode, other: ModelNode, report: Report = lambda *_: None
) -> dict[str, Any]:
    """Return the errors that a model would have had as the shadow of another, on the given recordings."""
    if not workspace.recorded:
        raise SettingsError("a shadow runs on recordings, and tables were given; start the workbench with a recording")
    sources = open_recordings(workspace.recordings)
    blocks = max(sum(source.blocks for source in sources), 1)
    pipeline = Pipeline(one.model, shadows=[other.model], keep_forecasts=False)
    for _ in feed(merge_sources(sources), pipeline):
        report(sum(source.blocks_read for source in sources) / blocks, "replaying the recordings")
    return {
        "names": [one.name, other.name],
        "models": to_json_values(make_records(pipeline.shadows.errors())),
        "command": replay_command(workspace, [one, other]),
        "live_command": live_command(workspace, [one, other]),
    }


def export_model(node: ModelNode) -> dict[str, Any]:
    """Return the name and the text of a model's file."""
    return {"file": f"{node.name}.json", "text": read_model_file(node).decode()}


def _find_step(before: ModelNode, after: ModelNode) -> dict[str, Any] | None:
    """Return the step that made a model of another, with its errors on held-out days; None where there is none."""
    if after.parent != before.name:
        return None
    taken = [attempt for attempt in list_attempts(after.model.history) if attempt.action == ADDED]
    return _describe_step(taken[-1]) if taken else None


def _describe_step(attempt: EffectAttempt) -> dict[str, Any]:
    """Return one attempt of the history of a model."""
    names = ("action", "effect", "scope", "mae_before_kwh", "mae_after_kwh", "change_kwh", "noise_floor_kwh", "final")
    more = ("words", "reason", "outcome", "forced", "coefficient", "gain", "rides", "first_date", "last_date")
    return {name: to_json_values(getattr(attempt, name)) for name in (*names, *more)}
