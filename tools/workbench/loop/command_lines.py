"""Command lines that do the same as the actions of the workbench."""

import shlex
from collections.abc import Sequence
from pathlib import Path

from socast.tools.workbench.loop.model_tree import ModelNode
from socast.tools.workbench.workspace import Workspace


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
    folder = Path(workspace.given.source.given[0]).stem if workspace.recorded else ""
    made = (
        [shlex.join(["socast", "tables", *_data(workspace), *_options(workspace), "--out", folder])] if folder else []
    )
    tables = [folder] if folder else _data(workspace)
    return [*made, shlex.join(["socast", "fit", *tables, "--recipe", node.model.recipe, "-o", f"{node.name}.json"])]


def effect_command(workspace: Workspace, effect: str) -> str:
    """Return the command that shows what an effect declares."""
    return shlex.join(["socast", "effects", "show", effect, *_effects(workspace)])


def _data(workspace: Workspace) -> list[str]:
    """Return the recordings or tables."""
    return [str(path) for path in workspace.given.source.given]


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
