"""The models of a workbench as a tree: each is a file, and each but the roots has the model that it was made of."""

import re
from pathlib import Path
from threading import RLock
from typing import Any, Final, NamedTuple

from msgspec.structs import replace

from socast.core import models
from socast.core.diagnose.add.add import AdditionTrial, log_attempt
from socast.core.diagnose.add.records import ADDED, REFUSED, UNDECIDED, EffectAttempt, list_attempts
from socast.core.errors import ModelError, SettingsError
from socast.core.models import LinearModel

SUFFIX: Final = ".json"
_UNSAFE: Final = re.compile(r"[^\w.@=,-]+")
"""Characters that a file name made from a model's name must not hold."""


class ModelNode(NamedTuple):
    """Hold a model of the tree.

    Parameters
    ----------
    name : str
        Name, unique in the tree; the file has it too.
    parent : str
        Name of the model that it was made of; empty for a root.
    origin : str
        `given`, `fitted`, `added` or `found` (in the folder when the workbench began).
    given : str
        Name or path on the command line; empty for other models.
    """

    name: str
    model: LinearModel
    file: Path
    parent: str = ""
    origin: str = "given"
    given: str = ""

    @property
    def named(self) -> LinearModel:
        """The model with its name in the tree, for reports."""
        return replace(self.model, name=self.name)

    @property
    def path(self) -> str:
        """The model as a command names it."""
        return self.given or str(self.file)


class ModelTree:
    """Keep models as files of one folder, and how each was made.

    Parameters
    ----------
    folder : Path
        Folder of the files. It is made if it does not exist.
    """

    def __init__(self, folder: Path) -> None:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise SettingsError(f"--models {folder}: {error.strerror}; name a folder that can be made") from error
        self.folder = folder
        self._nodes: dict[str, ModelNode] = {}
        self._lock = RLock()

    @property
    def names(self) -> list[str]:
        """Names of the models, in the order in which they came."""
        return list(self._nodes)

    @property
    def first(self) -> ModelNode:
        """The first model that was given or fitted; `SettingsError` where there is none."""
        nodes = self.list_nodes()
        if not nodes:
            raise SettingsError("there is no model yet; give one with --model M, or recordings to fit one to")
        return next((node for node in nodes if node.origin in {"given", "fitted"}), nodes[0])

    def list_nodes(self) -> list[ModelNode]:
        """Return all models, in the order in which they came."""
        return list(self._nodes.values())

    def find(self, name: str) -> ModelNode:
        """Return the model of a name."""
        if name not in self._nodes:
            raise SettingsError(f"model {name!r} is not in this workbench; choose from {', '.join(self._nodes)}")
        return self._nodes[name]

    def load_folder(self) -> None:
        """Insert the models that the folder holds already, those with the shortest history first."""
        found = [(path, models.load(path)) for path in sorted(self.folder.glob(f"*{SUFFIX}"))]
        for path, model in sorted(found, key=lambda pair: len(pair[1].history)):
            parent = self._find_parent(model)
            self._nodes[path.stem] = ModelNode(path.stem, model, path, parent, "found")

    def insert(
        self, name: str, model: LinearModel, *, parent: str = "", origin: str = "given", given: str = ""
    ) -> ModelNode:
        """Insert a model, write its file, and return it; a model that is there already is returned as it is."""
        with self._lock:
            stamped = models.stamp(model)
            known = [node for node in self._nodes.values() if node.model.version == stamped.version]
            if same := [node for node in known if node.parent == parent or origin == "given"]:
                kept = same[0]._replace(origin=origin, given=given) if origin == "given" else same[0]
                self._nodes[kept.name] = kept
                return kept
            unique = self._find_free_name(_UNSAFE.sub("-", name))
            node = ModelNode(unique, stamped, self.folder / f"{unique}{SUFFIX}", parent, origin, given)
            models.save(stamped, node.file)
            self._nodes[unique] = node
            return node

    def insert_trial(self, name: str, added: AdditionTrial) -> ModelNode:
        """Insert the model that a trial accepted, or write the refused attempt into the history of its model."""
        base = self.find(name)
        if added.trial.action == ADDED:
            effect = added.trial.effect.partition("@")[0]
            return self.insert(f"{name}-{effect}", added.model, parent=name, origin="added")
        with self._lock:
            file = self.folder / f"{name}{SUFFIX}"
            logged = base._replace(model=log_attempt(base.model, added.trial), file=file, given="")
            models.save(logged.model, file)
            self._nodes[name] = logged
            return logged

    def remove(self, name: str) -> str:
        """Remove a model that the workbench made, with its file, and return the name of the model before."""
        with self._lock:
            node = self.find(name)
            if not node.parent:
                raise SettingsError(f"model {name} was not made by adding an effect; there is nothing to undo")
            if children := [each.name for each in self._nodes.values() if each.parent == name]:
                raise SettingsError(f"{', '.join(children)} was made of {name}; undo that first")
            del self._nodes[name]
            node.file.unlink(missing_ok=True)
            return node.parent

    def list_records(self) -> list[dict[str, Any]]:
        """Return what the tree shows of each model, with the errors on held-out days of the step that made it."""
        parents = {node.parent for node in self._nodes.values()}
        return [
            {
                "name": node.name,
                "parent": node.parent,
                "origin": node.origin,
                "version": node.model.version,
                "recipe": node.model.recipe,
                "file": str(node.file),
                "path": node.path,
                **_describe_last_addition(node),
                "tried": _count_attempts(node.model),
                "removable": bool(node.parent) and node.name not in parents,
            }
            for node in self._nodes.values()
        ]

    def _find_parent(self, model: LinearModel) -> str:
        """Return the name of the model to which the last effect of a model was added."""
        added = _find_last_addition(model)
        version = added.from_version if added else None
        return next((node.name for node in self._nodes.values() if node.model.version == version), "")

    def _find_free_name(self, name: str) -> str:
        """Return a name that neither a model nor a file has."""
        place, free = 2, name
        while free in self._nodes or (self.folder / f"{free}{SUFFIX}").exists():
            free, place = f"{name}-{place}", place + 1
        return free


def _describe_last_addition(node: ModelNode) -> dict[str, Any]:
    """Return the effect that made a model of its parent, and the errors on held-out days before and after."""
    added = _find_last_addition(node.model) if node.parent else None
    names = ("effect", "action", "outcome", "forced", "mae_before_kwh", "mae_after_kwh")
    return {name: getattr(added, name, None) for name in names}


def _count_attempts(model: LinearModel) -> dict[str, int]:
    """Return how many effects were tried on a model after its last addition and not added, by outcome."""
    actions = [attempt.action for attempt in list_attempts(model.history)]
    last = max((i for i, action in enumerate(actions) if action == ADDED), default=-1)
    return {outcome: actions[last + 1 :].count(outcome) for outcome in (REFUSED, UNDECIDED)}


def _find_last_addition(model: LinearModel) -> EffectAttempt | None:
    """Return the last effect that was added to a model, None without any."""
    return next((each for each in reversed(list_attempts(model.history)) if each.action == ADDED), None)


def read_model_file(node: ModelNode) -> bytes:
    """Return the content of a model's file, for a download."""
    try:
        return node.file.read_bytes()
    except OSError as error:
        raise ModelError(f"{node.file}: cannot read the model: {error.strerror}; restart the workbench") from error
