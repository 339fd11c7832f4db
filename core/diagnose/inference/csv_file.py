"""Read small CSV files that a person writes beside tables: known events, groups of cars, days on."""

from io import BytesIO
from pathlib import Path
from typing import Final

import pandas as pd

from socast.core.errors import ModelError, read_input

LARGEST_CSV: Final = 16 << 20
"""Largest file that is read; a line of an event has some 40 bytes. [B]"""


def read_csv(path: Path, remedy: str = "give a file with a header line") -> pd.DataFrame:
    """Return the cells of a CSV file with a header line as text; an empty cell is an empty text."""
    try:
        return pd.read_csv(BytesIO(read_input(path, LARGEST_CSV)), dtype=str, keep_default_na=False)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())
        raise ModelError(f"{path} cannot be read as CSV ({reason}): {remedy}") from error
