"""What the pages of the fleet need of a player of recordings or an observer of a live service."""

from collections.abc import Mapping
from typing import Any, Protocol

from socast.core.wire.messages import Outlook
from socast.tools.workbench.fleet.board import Board


class FleetSource(Protocol):
    """Fill a board, and answer questions about its cars."""

    @property
    def board(self) -> Board:
        """Return the newest values of every car."""

    def show(self) -> None:
        """Learn that a page shows the fleet."""

    def close(self) -> None:
        """End."""

    def describe(self) -> dict[str, Any]:
        """Return the state of the source as a JSON record; its `problem` is why the board gets no newer, or empty."""

    def ask(self, vehicle_id: str, parameters: Mapping[str, str]) -> Outlook:
        """Return the outlook on the rest of a car's shift; `parameters` define a ride."""

    def list_ask_options(self) -> list[str] | None:
        """Return the options with which `socast ask` gets the same answers, None where no command does."""

    def get_parts(self, vehicle_id: str) -> dict[str, float] | None:
        """Return the predicted energy of the ride in progress by term, None where unknown. [kWh]"""
