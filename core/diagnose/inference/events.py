"""Read known events that may have changed a car: visits to a workshop, new tyres, an update of its software."""

from datetime import date
from pathlib import Path
from typing import Final, NamedTuple

from socast.core.diagnose.inference.csv_file import read_csv
from socast.core.errors import ModelError

DATE: Final = "date"
VEHICLE: Final = "vehicle_id"
WHAT: Final = "what"
"""Columns of the file; the last two may be absent. A line without a car is an event of all cars."""


class KnownEvent(NamedTuple):
    """Hold a known event that may have changed a car.

    Parameters
    ----------
    date : str
        First date after it. [UTC]
    vehicle : str
        The car; empty for all cars.
    what : str
        What happened, in the words of the file; empty where it says nothing.
    """

    date: str
    vehicle: str = ""
    what: str = ""


def read_events(path: Path) -> list[KnownEvent]:
    """Return the events of a CSV file: `date`, the first UTC date after the event, `vehicle_id` and `what` happened."""
    table = read_csv(path, remedy="give a file with a header line, and quote words with a comma")
    if DATE not in table:
        raise ModelError(f"{path} has no column {DATE!r}: its header line must be {DATE},{VEHICLE},{WHAT}")
    columns = (table[name].tolist() if name in table else [""] * len(table) for name in (DATE, VEHICLE, WHAT))
    out = []
    for row, (day, vehicle, what) in enumerate(zip(*columns, strict=True), start=2):
        try:
            out.append(KnownEvent(date.fromisoformat(day.strip()).isoformat(), vehicle.strip(), " ".join(what.split())))
        except ValueError:
            raise ModelError(f"{path}, line {row}: the date is {day!r}; write it as 2023-05-05") from None
    return out
