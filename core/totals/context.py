"""What every step of one run shares: the vehicles, their kinds, the effects, the settings and the model."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from socast.core.batch import Floats, Lanes, Table
from socast.core.settings import Settings
from socast.core.vehicles.fleet import Cars


class Model(Protocol):
    """Predict the energy of rides, or of any part of one."""

    @property
    def name(self) -> str:
        """Name for people."""

    @property
    def version(self) -> str:
        """Distinguishes models of the same name."""

    @property
    def needs(self) -> tuple[str, ...]:
        """Columns of the ride table that `predict` reads."""

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of the effects whose energy `predict` reads."""

    def predict_energy(self, columns: Table) -> Floats:
        """Return the energy of each row, NaN where it is not predictable. [kWh]"""


@dataclass(frozen=True)
class RunContext:
    """Hold the objects that every step of one run shares.

    The references never change; `lanes` and `cars` grow as messages arrive.

    Parameters
    ----------
    lanes : Lanes
        Name of the vehicle in each lane.
    effects : sequence of str
        Names of the effects whose energies are summed, in the order of their columns.
    """

    lanes: Lanes
    cars: Cars
    effects: Sequence[str]
    settings: Settings
    model: Model

    @property
    def vehicle_ids(self) -> list[str]:
        """Name of the vehicle in each lane."""
        return self.lanes.names

    @property
    def model_label(self) -> str:
        """Name and version of the model, as published."""
        return f"{self.model.name}/{self.model.version}"
