"""What the command line gave to the workbench: rides, models and files of effects.

The rides are read once. Recordings become tables with every known effect, again when a file of effects changes. Tables
are read as they are. Without a model, the recipe `road_load` is fitted as the first one.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, NamedTuple

import pandas as pd

from socast.core.condition.records import FleetCondition
from socast.core.diagnose.dataset import Windows, gather_windows
from socast.core.diagnose.inference.events import read_events
from socast.core.diagnose.records import Diagnosis
from socast.core.errors import ModelError, SettingsError, SocastError
from socast.core.fit.recipes import fit_to_windows
from socast.core.models import BUILT_IN_MODELS, EXTENDED_PHYSICAL, LinearModel
from socast.stream.mcap_format import RECORDING
from socast.tools.commands.compare import named
from socast.tools.commands.diagnose import check_tables, list_lacking_effects
from socast.tools.terminal.ride_source import RideSource
from socast.tools.workbench.loop.model_tree import ModelNode, ModelTree
from socast.tools.workbench.loop.own_effects import OwnEffects

FIRST_RECIPE: Final = "road_load"
"""Recipe of the first model where none is given: textbook physics, in which an effect may be missing."""
Report = Callable[[float, str], None]
"""Function that receives the share of the work that is done, and the step in words."""


class Given(NamedTuple):
    """Hold the arguments of the command line.

    Parameters
    ----------
    source : RideSource
        Recordings, or folders of tables; none for a fleet without rides.
    folder : Path, optional
        Folder in which models are kept; by default a temporary one.
    live : str, optional
        Endpoint of a live service, None without one.
    events : Path, optional
        File of known events of the cars.
    """

    source: RideSource = RideSource()
    models: Sequence[str] = ()
    folder: Path | None = None
    live: str | None = None
    events: Path | None = None


class RideTables(NamedTuple):
    """Hold the ride table and the window table, and how often they were made.

    Parameters
    ----------
    version : int
        Number that rises each time the tables are made.
    """

    rides: pd.DataFrame
    windows: pd.DataFrame
    version: int


class Workspace:
    """Hold the rides, the models and the effects of one workbench.

    Parameters
    ----------
    given : Given
        Arguments of the command line. Files of effects must be loaded already.

    Attributes
    ----------
    recordings : list of Path
        The recordings; empty where tables were given, which cannot be made again.
    notes : list of str
        What the reader should know about the first model.
    problem : str
        Why the rides could not be read; empty if they could, or were not read yet.
    """

    def __init__(self, given: Given = Given()) -> None:  # noqa: B008 - immutable
        self.given = given
        if given.source.given:
            given.source.check()
        files = given.source.files if given.source.given else []
        self.recordings = [file for file in files if file.suffix == RECORDING]
        self.events = read_events(given.events) if given.events else []
        self.effects = OwnEffects(given.source.effect_files)
        self._temporary = None if given.folder else TemporaryDirectory(prefix="socast-models-")
        self.models = ModelTree(given.folder or Path(self._temporary.name if self._temporary else "."))
        self.notes: list[str] = []
        self.problem = ""
        self._tables: RideTables | None = None
        self._diagnoses: dict[tuple[str, int], Diagnosis] = {}
        self._conditions: dict[tuple[str, int], FleetCondition] = {}
        self._gathered: tuple[tuple[str, int], Windows] | None = None

    @property
    def tables(self) -> RideTables:
        """The tables of the rides; `SettingsError` while there are none."""
        if self._tables is None:
            raise SettingsError(self.problem or self._explain_absence())
        return self._tables

    @property
    def recorded(self) -> bool:
        """Whether recordings were given, so that tables can be made again."""
        return bool(self.recordings)

    @property
    def is_ready(self) -> bool:
        """Whether the rides are read and there is a model."""
        return self._tables is not None and bool(self.models.names)

    @property
    def is_temporary(self) -> bool:
        """Whether the models are lost when the workbench stops."""
        return self._temporary is not None

    def open(self, report: Report = lambda *_: None) -> dict[str, Any]:
        """Read the rides, load or fit the first model, and return what was read."""
        try:
            given = named(self.given.models)
            if self.given.source.given:
                self.make_tables(report, [name for model in given.values() for name in model.effects])
            self.models.load_folder()
            for (label, model), word in zip(given.items(), self.given.models, strict=True):
                self.models.insert(Path(label).stem, model, given=word)
            if self._tables is not None and not self.models.names:
                report(0.95, f"fitting the recipe {FIRST_RECIPE}")
                self._fit_first(self._tables)
        except SocastError as error:
            self.problem = str(error)
            raise
        return self.describe()

    def make_tables(self, report: Report = lambda *_: None, wanted: Sequence[str] = ()) -> RideTables:
        """Read the tables, or make them of the recordings with every effect that is known now."""
        words = "making tables of the recordings" if self.recorded else "reading the tables"
        of_models = [name for node in self.models.list_nodes() for name in node.model.effects]
        rides, windows = self.given.source.read([*wanted, *of_models], lambda share: report(0.95 * share, words))
        self._tables = RideTables(rides, windows, self._tables.version + 1 if self._tables else 1)
        return self._tables

    def read_effects_again(self, report: Report = lambda *_: None) -> dict[str, Any]:
        """Load the files of effects that changed, and make the tables again so that they hold the new effects.

        Tables that were given cannot be made again; `describe` then names the effects that they lack.
        """
        report(0.0, "checking the files of effects")
        loaded = self.effects.read_again()
        if loaded and self.recorded:
            self.make_tables(report)
        return {"effects": loaded, "made": bool(loaded) and self.recorded}

    def get_node(self, name: str | None = None) -> ModelNode:
        """Return a model of the tree, by default the first one."""
        return self.models.find(name) if name else self.models.first

    def check_rides(self, model: LinearModel) -> tuple[pd.DataFrame, pd.DataFrame]:
        """Return the two tables after the checks that a diagnosis needs."""
        return check_tables(model, self.tables.rides, self.tables.windows)

    def gather(self, node: ModelNode) -> Windows:
        """Return the windows of the rides with the predictions of a model; those of the last model are kept."""
        key = (node.model.version, self.tables.version)
        kept = self._gathered
        if kept is None or kept[0] != key:
            kept = (key, gather_windows(self.tables.rides, self.tables.windows, node.model))
            self._gathered = kept
        return kept[1]

    def find_diagnosis(self, node: ModelNode) -> Diagnosis | None:
        """Return the diagnosis of a model if it was made of the present tables."""
        return self._diagnoses.get((node.model.version, self.tables.version))

    def diagnose(self, node: ModelNode, report: Report = lambda *_: None) -> Diagnosis:
        """Return the diagnosis of a model, which is made once for each model and table."""
        from socast.core.diagnose.diagnosis import diagnose  # noqa: PLC0415 - it takes a second to import

        if (known := self.find_diagnosis(node)) is not None:
            return known
        rides, windows = self.check_rides(node.model)
        version = self.tables.version
        dated = self.given.source.are_dated
        result = diagnose(rides, windows, node.named, events=self.events, dated=dated, report=report)
        self._diagnoses[node.model.version, version] = result
        return result

    def find_condition(self, node: ModelNode) -> FleetCondition | None:
        """Return the condition of the cars by a model if it was made of the present tables."""
        return self._conditions.get((node.model.version, self.tables.version))

    def assess_condition(self, node: ModelNode) -> None:
        """Assess the condition of the cars, once for each model and table."""
        from socast.core.condition.car_condition import assess_condition  # noqa: PLC0415 - imports an optimiser

        tables = self.tables
        self._conditions[node.model.version, tables.version] = assess_condition(tables.rides, node.named, self.events)

    def describe(self) -> dict[str, Any]:
        """Return what was given and read, for the head of every page."""
        made = self._tables
        described = {
            "given": [str(path) for path in self.given.source.given],
            "recordings": [str(path) for path in self.recordings],
            "effects": [str(path) for path in self.given.source.effect_files],
            "live": self.given.live,
            "recorded": self.recorded,
            "ready": self.is_ready,
            "problem": self.problem,
            "notes": self.notes,
            "folder": str(self.models.folder),
            "temporary": self.is_temporary,
            "models": self.models.names,
            "parents": {node.name: node.parent for node in self.models.list_nodes()},
            "first": self.models.first.name if self.models.names else "",
            "rides": 0 if made is None else len(made.rides),
            "windows": 0 if made is None else len(made.windows),
            "tables_version": 0 if made is None else made.version,
        }
        if made is not None and len(made.rides):
            described |= {
                "vehicles": int(made.rides["vehicle_id"].nunique()),
                "first_date": str(made.rides["date"].min()),
                "last_date": str(made.rides["date"].max()),
                "seen": [node.name for node in self.models.list_nodes() if _is_in_sample(node.model, made.rides)],
                "lacking": list_lacking_effects(self.given.source.effect_files, made.windows),
            }
        return described

    def close(self) -> None:
        """Remove the temporary folder of models."""
        if self._temporary:
            self._temporary.cleanup()

    def _fit_first(self, made: RideTables) -> None:
        """Fit the first model; where the rides are too few, take a built-in one and say so."""
        try:
            model = fit_to_windows(FIRST_RECIPE, made.rides, made.windows)
        except ModelError as error:
            self.notes.append(
                f"No model was given, and none could be fitted: {error}. The built-in model "
                f"{EXTENDED_PHYSICAL.name} is used."
            )
            self.models.insert(EXTENDED_PHYSICAL.name, EXTENDED_PHYSICAL, given=_name_built_in())
            return
        self.notes.append(f"No model was given. The recipe {FIRST_RECIPE} was fitted to these rides as the first one.")
        self.models.insert(FIRST_RECIPE, model, origin="fitted")

    def _explain_absence(self) -> str:
        """Return why there are no tables."""
        if not self.given.source.given:
            return "no rides were given; start the workbench with socast serve RECORDING"
        return "the rides are still being read; wait until the tables are made"


def _is_in_sample(model: LinearModel, rides: pd.DataFrame) -> bool:
    """Return whether a model was fitted to rides of dates of these rides, so that its error on them is in sample."""
    fitted = model.training
    return fitted is not None and fitted.first_date <= rides["date"].max() and fitted.last_date >= rides["date"].min()


def _name_built_in() -> str:
    """Return the name by which the stand-in is loaded."""
    return next(name for name, model in BUILT_IN_MODELS.items() if model is EXTENDED_PHYSICAL)
