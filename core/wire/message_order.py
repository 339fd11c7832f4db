"""The order of the messages of a batch: telemetry rows, and the other messages between them."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from socast.core.batch import Ints
from socast.core.wire.decoder import Event
from socast.core.wire.messages import Vehicle, Weather, Wire


class VehicleChange(NamedTuple):
    """Hold a vehicle message and where it came.

    Parameters
    ----------
    row : int
        First row of the batch to which it applies.
    place : int
        Place among the messages of the batch.
    """

    row: int
    lane: int
    message: Vehicle
    place: int = 0


class Silence(Wire):
    """Mark where the samples of other cars show that a car is silent, among its messages; it is never published."""


class Piece(NamedTuple):
    """Hold the rows of a piece of a batch from `start` up to `stop`, and what applies between them.

    Parameters
    ----------
    kind : (rows,) int
        Kind of the car of each row.
    changes : list of VehicleChange
        Vehicle messages, with the row of the piece before which each came.
    ride_events : list of tuple
        Fields of RIDE_EVENT of each beginning and end of a ride, with the row of the batch before which it came.
    observations : list of (row, Weather)
        Observations, with the row of the batch before which each came.
    """

    start: int
    stop: int
    kind: Ints
    changes: list[VehicleChange]
    ride_events: list[tuple[Any, ...]]
    observations: list[tuple[int, Weather]]


class MessageOrder:
    """Number the telemetry rows and the other messages of a batch in the order of their arrival.

    Attributes
    ----------
    of_rows : (rows,) int
        Place of each row.

    Examples
    --------
    >>> from socast.core.wire.messages import Weather
    >>> seen = Weather("yul", 0.0, 45.0, -73.0)
    >>> order = MessageOrder(3, [Event(1, -1, seen), Event(3, -1, seen)])
    >>> order.of_rows.tolist(), [order.of_event(number) for number in (0, 1)], order.size
    ([0, 2, 3], [1, 4], 5)
    """

    def __init__(self, rows: int, events: Sequence[Event]) -> None:
        self._event_rows = np.array([event.row for event in events], dtype=np.int64)
        self.of_rows = np.arange(rows, dtype=np.int64)
        if events:
            self.of_rows += np.searchsorted(self._event_rows, self.of_rows, side="right")
        self.size = rows + len(events)

    def of_event(self, number: int) -> int:
        """Return the place of a message that is not telemetry, by its number among those."""
        return int(self._event_rows[number]) + number

    def of_row(self, row: int) -> int:
        """Return the place of a row, the number of all messages for the row after the last."""
        return int(self.of_rows[row]) if row < len(self.of_rows) else self.size
