"""Command lines that do the same as the actions of the workbench."""

import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from socast.core.condition.campaign_records import BeforeAfter
from socast.tools.workbench.loop.model_tree import ModelNode
from socast.tools.workbench.workspace import Workspace

DAYS_ON: Final = "days-on.csv"
"""File of days on that the shown commands write."""


def compare_command(workspace: Workspace, nodes: Sequence[ModelNode], ride: str = "") -> str:
    """Return the command that compares models, or traces one ride."""
    words = ["socast", "compare", *_data(workspace), *_models(nodes), *_options(workspace)]
    return shlex.join([*words, *(["--ride", ride] if ride else [])])


def diagnose_command(workspace: Workspace, node: ModelNode) -> str:
    """Return the command that diagnoses a model."""
    words = [*_data(workspace), *_models([node]), *_options(workspace), *_events(workspace)]
    return shlex.join(["socast", "diagnose", *words])


def add_command(
    workspace: Workspace,
    node: ModelNode,
    effect: str,
    scope: Sequence[str] = (),
    *,
    even_if_undecided: bool = False,
    force: bool = False,
) -> str:
    """Return the command that adds an effect to a model."""
    words = ["socast", "add", effect, *_data(workspace), *_models([node])]
    words += [word for part in scope for word in ("--scope", part)]
    out = str(Path(node.path).with_name(f"{node.name}-{effect.partition('@')[0]}.json"))
    also = ["--force"] if force else ["--even-if-undecided"] if even_if_undecided else []
    return shlex.join([*words, *_options(workspace), *also, "-o", out])


def condition_commands(workspace: Workspace, node: ModelNode) -> list[str]:
    """Return the commands that tell how each car is doing, and where the energy goes."""
    words = [*_data(workspace), *_models([node]), *_options(workspace)]
    return [
        shlex.join(["socast", "condition", *words, *_events(workspace)]),
        shlex.join(["socast", "waterfall", *words]),
    ]


def before_after_commands(workspace: Workspace, node: ModelNode, result: BeforeAfter, days_on: str = "") -> list[str]:
    """Return the commands that compare cars before and after; `--vehicles` of the last one names the cars.

    `days_on` is the text of a file of days on, which the commands write first.
    """
    source = workspace.given.source
    made, data, options = list[str](), _data(workspace), replace(source, vehicle_files=()).list_options()
    if workspace.recorded and source.vehicle_files:
        made, data = _make_tables(workspace)
        options = _effects(workspace)
    if days_on:
        writes = shlex.join(["printf", "%s\\n", *days_on.splitlines()])
        made.append(f"{writes} > {DAYS_ON}")
    given = {
        "--vehicles": ",".join(result.vehicles),
        "--at": result.at,
        "--until": result.until,
        "--toggle": DAYS_ON if days_on else None,
        "--what": result.what,
    }
    words = [*data, *_models([node]), *options, *(word for pair in given.items() if pair[1] for word in pair)]
    return [*made, shlex.join(["socast", "before-after", *map(str, words)])]


def live_command(workspace: Workspace, nodes: Sequence[ModelNode]) -> str:
    """Return the command that runs the models after the first one as its shadows, in service."""
    return shlex.join(["socast", "live", *_models(nodes), *_options(workspace)])


def replay_command(workspace: Workspace, nodes: Sequence[ModelNode]) -> str:
    """Return the command that shows with recordings the errors that shadows would have had in service."""
    return shlex.join(["socast", "replay", *_data(workspace), *_models(nodes), *_options(workspace)])


def history_command(node: ModelNode) -> str:
    """Return the command that shows the history of a model."""
    return shlex.join(["socast", "history", node.path])


def list_fit_commands(workspace: Workspace, node: ModelNode) -> list[str]:
    """Return the commands that fit the first model."""
    made, tables = _make_tables(workspace) if workspace.recorded else ([], _data(workspace))
    return [*made, shlex.join(["socast", "fit", *tables, "--recipe", node.model.recipe, "-o", f"{node.name}.json"])]


def effect_command(workspace: Workspace, effect: str) -> str:
    """Return the command that shows what an effect declares."""
    return shlex.join(["socast", "effects", "show", effect, *_effects(workspace)])


def _data(workspace: Workspace) -> list[str]:
    """Return the recordings or tables."""
    return [str(path) for path in workspace.given.source.given]


def _make_tables(workspace: Workspace) -> tuple[list[str], list[str]]:
    """Return the command that makes tables of the recordings, and their folder."""
    folder = Path(workspace.given.source.given[0]).stem
    return [shlex.join(["socast", "tables", *_data(workspace), *_options(workspace), "--out", folder])], [folder]


def _models(nodes: Sequence[ModelNode]) -> list[str]:
    """Return the options that name models."""
    return [word for node in nodes for word in ("--model", node.path)]


def _options(workspace: Workspace) -> list[str]:
    """Return the options with which a command reads the rides as the workbench does."""
    return workspace.given.source.list_options()


def _events(workspace: Workspace) -> list[str]:
    """Return the option that names the file of events."""
    return ["--events", str(workspace.given.events)] if workspace.given.events else []


def _effects(workspace: Workspace) -> list[str]:
    """Return the options that name files of effects."""
    return [word for path in workspace.given.source.effect_files for word in ("--effects", str(path))]
