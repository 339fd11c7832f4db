"""Read known events that may have changed a car: visits to a workshop, new tyres, an update of its software."""

from datetime import date
from pathlib import Path
from typing import Final

import pandas as pd

from socast.core.diagnose.inference.scopes import KnownEvent
from socast.core.errors import ModelError

DATE: Final = "date"
VEHICLE: Final = "vehicle_id"
"""Columns of the file; the second one may be absent, and empty for an event of all cars."""


def read_events(path: Path) -> list[KnownEvent]:
    """Return the events of a CSV file with the columns `date`, the first UTC date after the event, and `vehicle_id`."""
    try:
        table = pd.read_csv(path, dtype=str, keep_default_na=False)
    except (OSError, ValueError) as error:
        raise ModelError(f"{path} cannot be read as CSV ({error}): give a file with a header line") from error
    if DATE not in table:
        raise ModelError(f"{path} has no column {DATE!r}: its header line must be {DATE},{VEHICLE}")
    vehicles = table[VEHICLE].tolist() if VEHICLE in table else [""] * len(table)
    out = []
    for row, (day, vehicle) in enumerate(zip(table[DATE].tolist(), vehicles, strict=True), start=2):
        try:
            out.append(KnownEvent(date.fromisoformat(day.strip()).isoformat(), vehicle.strip()))
        except ValueError:
            raise ModelError(f"{path}, line {row}: the date is {day!r}; write it as 2023-05-05") from None
    return out
