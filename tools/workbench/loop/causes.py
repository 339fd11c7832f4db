"""Records of the page about causes: the candidates with their probabilities, and the trial of an effect."""

from collections.abc import Sequence
from typing import Any

from socast.core import effects
from socast.core.diagnose.add.add import AdditionTrial, force_addition
from socast.core.diagnose.add.records import ADDED, UNDECIDED, EffectAttempt, list_attempts
from socast.core.diagnose.partial_residual import compute_candidate_residual
from socast.core.diagnose.records import NONE, CarDeviation, Diagnosis, NamedEffect
from socast.core.errors import SocastError
from socast.tools.commands.add import try_effect
from socast.tools.commands.diagnose import parse_term
from socast.tools.commands.effects import find_topic, make_effect_record
from socast.tools.report.diagnosis.finding_words import describe_deviation
from socast.tools.report.diagnosis.sentences import (
    CAUSE_NAMES,
    describe_missing_effect,
    describe_next_step,
    describe_remainder,
    describe_verdict,
    find_recommended,
    title_verdict,
)
from socast.tools.workbench.loop.command_lines import add_command, diagnose_command, effect_command, live_command
from socast.tools.workbench.loop.model_tree import ModelNode
from socast.tools.workbench.loop.models import describe_model
from socast.tools.workbench.workspace import Report, Workspace


def describe_causes_of(workspace: Workspace, node: ModelNode, diagnosis: Diagnosis) -> dict[str, Any]:
    """Return the candidates of a diagnosis: the missing effects in their order, then the most probable ones.

    Returns
    -------
    dict
        `causes`, each with the probability that it is missing, whether it is named or explains what a named one does,
        and for an effect its declaration and how it was ranked; the `recommended` effect, None where none is missing in
        all cars or a car comes first; the result as a `title` and in sentences; the entries of `missing` effects and of
        `deviations` of cars, with the command that adds each.
    """
    order = {one.effect: place for place, one in enumerate(diagnosis.missing)}
    credible = {name for one in diagnosis.missing for name in one.credible_set}
    tried = {each.effect: each for each in list_attempts(node.model.history) if each.action != ADDED}
    causes = [
        {
            "name": row.effect,
            "probability": row.probability,
            "credible": row.effect in credible,
            "words": None,
            "tried": _describe_attempt(tried.get(row.effect)),
            "status": row.status,
            "gain": row.gain,
            "effect": _describe_declared(row.effect),
        }
        for row in sorted(diagnosis.tested, key=lambda row: order.get(row.effect, len(order)))
    ]
    title = title_verdict(diagnosis)
    return {
        "model": node.name,
        "error": diagnosis.error.to_json(),
        "causes": [*_list_none(diagnosis), *causes],
        "recommended": find_recommended(diagnosis),
        "title": title,
        "verdict_sentences": [rest for line in describe_verdict(diagnosis) if (rest := line.removeprefix(f"{title}."))],
        "next": [line for line in describe_next_step(diagnosis) if not line.startswith("socast ")],
        "remainder": describe_remainder(diagnosis),
        "missing": [_describe_missing(workspace, node, one) for one in diagnosis.missing],
        "deviations": [_describe_deviation(workspace, node, one) for one in diagnosis.deviations],
        "held_out": diagnosis.data.held_out.to_json(),
        "command": diagnose_command(workspace, node),
    }


def _list_none(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Return the entry of no missing effect, where no effect is named."""
    chances = [cause.probability for cause in diagnosis.causes if cause.effect == NONE]
    if diagnosis.missing or not chances:
        return []
    unknown = dict.fromkeys(("tried", "status", "gain", "effect"))
    return [{"name": NONE, "probability": chances[0], "credible": True, "words": CAUSE_NAMES[NONE], **unknown}]


def describe_effect(workspace: Workspace, node: ModelNode, name: str) -> dict[str, Any]:
    """Return what an effect declares, its partial residual, and the commands that show and add it.

    Returns
    -------
    dict
        `partial_residual` is None, with the reason in `undrawn`, where the data cannot show the effect.
    """
    effect = effects.get(name)
    base = effects.get(effect.base)
    record: dict[str, Any] = {
        "effect": make_effect_record(effect, find_topic(effect)),
        "about": " ".join(base.documentation.partition("\n\n")[2].split()),
        "example": effect.in_words((effect.low + effect.high) / 2.0),
        "command": effect_command(workspace, name),
        "add_command": add_command(workspace, node, name),
        "live_command": live_command(workspace, [node]),
        "partial_residual": None,
        "undrawn": "",
    }
    known = workspace.find_diagnosis(node)
    for one in () if known is None else known.missing:
        if one.effect == effect.base:
            return record | {"partial_residual": one.partial_residual.to_json()}
    try:
        drawn = compute_candidate_residual(*workspace.check_rides(node.model), node.model, effect.base)
    except SocastError as error:
        return record | {"undrawn": str(error)}
    return record | {"partial_residual": drawn.to_json()}


def add_to_model(
    workspace: Workspace,
    name: str,
    effect: str,
    *,
    scope: Sequence[str] = (),
    even_if_undecided: bool = False,
    force: bool = False,
    report: Report = lambda *_: None,
) -> dict[str, Any]:
    """Add an effect to a model if it helps on rides to which it was not fitted, and return the step.

    Parameters
    ----------
    even_if_undecided : bool
        Whether to add the effect even if the rides do not decide whether it helps.

    Returns
    -------
    dict
        `accepted`, `added` (also if undecided or by force), the `trial`, the `model` after it, and the records of the
        model `before` and `after`.
    """
    node = workspace.get_node(name)
    rides, windows = workspace.check_rides(node.model)
    report(0.0, "measuring the noise floor")
    added: AdditionTrial = try_effect(node.model, effect, scope, rides, windows, report=report)
    undecided = added.trial.outcome == UNDECIDED
    if not added.trial.accepted and (force or (undecided and even_if_undecided)):
        added = force_addition(added)
    after = workspace.models.insert_trial(node.name, added)
    return {
        "accepted": added.trial.accepted,
        "added": added.trial.action == ADDED,
        "trial": added.trial.to_json(),
        "model": after.name,
        "before": describe_model(workspace, node),
        "after": describe_model(workspace, after),
        "command": add_command(workspace, node, effect, scope, even_if_undecided=even_if_undecided, force=force),
        "live_command": live_command(workspace, [node, after]) if after.name != node.name else "",
    }


def _describe_attempt(attempt: EffectAttempt | None) -> dict[str, str] | None:
    """Return the outcome of the last attempt that did not add an effect, and why; None without one."""
    return {"outcome": attempt.action, "reason": attempt.reason} if attempt else None


def _describe_declared(name: str) -> dict[str, Any] | None:
    """Return what an effect of the library declares; None for another one."""
    if name not in effects.get_library():
        return None
    effect = effects.get(name)
    return make_effect_record(effect, find_topic(effect))


def _describe_missing(workspace: Workspace, node: ModelNode, one: NamedEffect) -> dict[str, Any]:
    """Return the entry of a missing effect, with its sentences and the command that adds it."""
    name, scope = parse_term(one)
    return {
        "name": name,
        "effect": one.effect,
        "scope": scope,
        "probability": one.probability,
        "gain": one.gain,
        "gain_ci95": one.gain_ci95,
        "coefficient": one.coefficient.to_json(),
        "sentences": describe_missing_effect(one),
        "equivalents": one.equivalents,
        "command": add_command(workspace, node, name, scope),
    }


def _describe_deviation(workspace: Workspace, node: ModelNode, one: CarDeviation) -> dict[str, Any]:
    """Return a car that deviates or changed in sentences, and the effect that a term can hold, if any."""
    lines = [line.removeprefix("- ") for line in describe_deviation(one)]
    record: dict[str, Any] = {"who": one.who, "sentences": lines, "name": None, "scope": [], "command": None}
    if not one.columns:
        return record
    name, scope = parse_term(one)
    return {**record, "name": name, "scope": scope, "command": add_command(workspace, node, name, scope)}
