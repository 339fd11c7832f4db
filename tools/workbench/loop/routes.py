"""The routes of the pages about rides, errors, causes and models."""

from collections.abc import Mapping
from io import StringIO
from typing import Any, Final

from socast.core.errors import SettingsError
from socast.tools.commands.before_after import read_campaign
from socast.tools.workbench.jobs import Report
from socast.tools.workbench.json_routes import JsonRequest, JsonRoute, Workbench
from socast.tools.workbench.loop import causes, condition, models, residuals, rides
from socast.tools.workbench.loop.model_tree import ModelNode


def _get_workspace(workbench: Workbench, _: JsonRequest) -> dict[str, Any]:
    """Return what was read, and the job that reads it while it runs."""
    return {**workbench.workspace.describe(), "job": workbench.jobs.find_running()}


def _get_rides(workbench: Workbench, request: JsonRequest) -> dict[str, Any]:
    return rides.describe_compared_rides(workbench.workspace, _find_model(workbench, request))


def _get_selection(workbench: Workbench, request: JsonRequest) -> dict[str, Any]:
    model = _find_model(workbench, request)
    return rides.measure_selection(workbench.workspace, model, request.parameters.get("filter", ""))


def _get_trace(workbench: Workbench, request: JsonRequest) -> dict[str, Any]:
    nodes = [_find_model(workbench, request)]
    if beside := request.parameters.get("with"):
        nodes.append(workbench.workspace.get_node(beside))
    return rides.trace_one_ride(workbench.workspace, nodes, _require(request.parameters, "ride"))


def _get_residuals(workbench: Workbench, request: JsonRequest) -> dict[str, Any]:
    given = request.parameters
    return residuals.explore_residuals(
        workbench.workspace,
        _find_model(workbench, request),
        x=_require(given, "x"),
        level=given.get("level", "windows"),
        colour=given.get("colour", ""),
        facet=given.get("facet", ""),
        text=given.get("filter", ""),
    )


def _get_survey(workbench: Workbench, request: JsonRequest) -> dict[str, Any]:
    model, given = _find_model(workbench, request), request.parameters
    return residuals.survey_residuals(
        workbench.workspace, model, given.get("level", "windows"), given.get("filter", "")
    )


def _get_failures(workbench: Workbench, request: JsonRequest) -> dict[str, Any]:
    model = _find_model(workbench, request)
    if (known := workbench.workspace.find_diagnosis(model)) is None:
        return _diagnose(workbench, model)
    return residuals.describe_failures(workbench.workspace, model, known)


def _get_causes(workbench: Workbench, request: JsonRequest) -> dict[str, Any]:
    model = _find_model(workbench, request)
    if (known := workbench.workspace.find_diagnosis(model)) is None:
        return _diagnose(workbench, model)
    return causes.describe_causes_of(workbench.workspace, model, known)


def _get_effect(workbench: Workbench, request: JsonRequest) -> dict[str, Any]:
    return causes.describe_effect(workbench.workspace, _find_model(workbench, request), request.path["effect"])


def _add_effect(workbench: Workbench, request: JsonRequest) -> dict[str, Any]:
    body, workspace = request.body, workbench.workspace
    model, effect = workspace.get_node(_require(body, "model")), _require(body, "effect")
    scope = [str(part) for part in body.get("scope") or ()]
    also = {name: bool(body.get(name)) for name in ("even_if_undecided", "force")}
    return workbench.jobs.start(
        f"adding {effect} to {model.name}",
        lambda report: causes.add_to_model(workspace, model.name, effect, scope=scope, **also, report=report),
    )


def _undo(workbench: Workbench, request: JsonRequest) -> dict[str, Any]:
    return {"model": workbench.workspace.models.remove(_require(request.body, "model"))}


def _list_models(workbench: Workbench, _: JsonRequest) -> dict[str, Any]:
    return models.list_models(workbench.workspace)


def _get_model(workbench: Workbench, request: JsonRequest) -> dict[str, Any]:
    return models.describe_model(workbench.workspace, workbench.workspace.get_node(request.path["model"]))


def _export_model(workbench: Workbench, request: JsonRequest) -> dict[str, Any]:
    return models.export_model(workbench.workspace.get_node(request.path["model"]))


def _compare_models(workbench: Workbench, request: JsonRequest) -> dict[str, Any]:
    one, other = (_require(request.parameters, name) for name in ("model", "with"))
    workspace = workbench.workspace
    return models.compare_two(workspace, workspace.get_node(one), workspace.get_node(other))


def _run_shadow(workbench: Workbench, request: JsonRequest) -> dict[str, Any]:
    workspace = workbench.workspace
    one, other = (workspace.get_node(_require(request.body, name)) for name in ("model", "with"))
    return workbench.jobs.start(
        f"replaying {other.name} as a shadow of {one.name}",
        lambda report: models.run_shadows(workspace, one, other, report),
    )


def _get_own_effects(workbench: Workbench, _: JsonRequest) -> dict[str, Any]:
    """Return the files of effects; if one changed on disk, begin to read it again and to make the tables again."""
    workspace, job = workbench.workspace, workbench.jobs.find_running()
    if job is None and workspace.is_ready and workspace.effects.has_changed:
        job = workbench.jobs.start("reading the files of effects again", workspace.read_effects_again)
    described = workspace.describe()
    return {
        "files": workspace.effects.list_records(),
        "job": job,
        "lacking": described.get("lacking", []),
        "tables_version": described["tables_version"],
    }


def _get_condition(workbench: Workbench, request: JsonRequest) -> dict[str, Any]:
    model = _find_model(workbench, request)
    if (known := workbench.workspace.find_condition(model)) is not None:
        return condition.describe_condition(workbench.workspace, model, known)
    if running := workbench.jobs.find_running():
        return {"job": running}
    workspace = workbench.workspace

    def assess(_: Report) -> dict[str, Any]:
        workspace.assess_condition(model)
        return {"model": model.name}

    return {"job": workbench.jobs.start("assessing the condition of the cars", assess)}


def _compare_repair(workbench: Workbench, request: JsonRequest) -> dict[str, Any]:
    """Return the record of the job that compares cars before and after a repair, as the form describes it."""
    body, workspace = request.body, workbench.workspace
    model = workspace.get_node(_require(body, "model"))
    vehicles, at, until, what = (
        " ".join(str(body.get(name) or "").split()) for name in ("vehicles", "at", "until", "what")
    )
    days_on = condition.complete_days_on(str(body.get("days_on") or ""))
    campaign = read_campaign(
        vehicles,
        at or None,
        until or None,
        toggle=StringIO(days_on) if days_on else None,
        what=what,
        names=condition.REPAIR_FORM,
    )

    def compare(report: Report) -> dict[str, Any]:
        record = condition.compare_repair(workspace, model, campaign, days_on)
        report(1.0)  # a cancelled comparison ends here
        return record

    return workbench.jobs.start("comparing before and after", compare)


def _diagnose(workbench: Workbench, model: ModelNode) -> dict[str, Any]:
    """Return the record of the job that diagnoses a model, or of the one that must end first."""
    if running := workbench.jobs.find_running():
        return {"job": running}
    workspace = workbench.workspace

    def diagnose(report: Report) -> dict[str, Any]:
        workspace.diagnose(model, report)
        return {"model": model.name}

    return {"job": workbench.jobs.start(f"diagnosing {model.name}", diagnose)}


def _find_model(workbench: Workbench, request: JsonRequest) -> ModelNode:
    """Return the model of a request, by default the first one."""
    node: ModelNode = workbench.workspace.get_node(request.parameters.get("model"))
    return node


def _require(given: Mapping[str, Any], name: str) -> str:
    """Return a parameter that must be there."""
    if not (value := given.get(name)):
        raise SettingsError(f"the parameter {name} is missing")
    return str(value)


ROUTES: Final[tuple[JsonRoute, ...]] = (
    JsonRoute("/workspace", _get_workspace),
    JsonRoute("/rides", _get_rides),
    JsonRoute("/selection", _get_selection),
    JsonRoute("/trace", _get_trace),
    JsonRoute("/residuals", _get_residuals),
    JsonRoute("/survey", _get_survey),
    JsonRoute("/failures", _get_failures),
    JsonRoute("/causes", _get_causes),
    JsonRoute("/condition", _get_condition),
    JsonRoute("/effects/{effect}", _get_effect),
    JsonRoute("/own-effects", _get_own_effects),
    JsonRoute("/models", _list_models),
    JsonRoute("/models/{model}", _get_model),
    JsonRoute("/models/{model}/file", _export_model),
    JsonRoute("/comparison", _compare_models),
    JsonRoute("/add", _add_effect, changes=True),
    JsonRoute("/undo", _undo, changes=True),
    JsonRoute("/shadow", _run_shadow, changes=True),
    JsonRoute("/before-after", _compare_repair, changes=True),
)
"""Routes of these pages, under `/api`."""
