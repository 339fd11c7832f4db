"""Read small CSV files that a person writes beside tables: known events, groups of cars, days on."""

from io import BytesIO
from pathlib import Path
from typing import Final, TextIO

import pandas as pd

from socast.core.errors import ModelError, read_input

LARGEST_CSV: Final = 16 << 20
"""Largest file that is read; a line of an event has some 40 bytes. [B]"""


def read_csv(
    source: Path | TextIO, name: str | None = None, remedy: str = "give a file with a header line"
) -> pd.DataFrame:
    """Return the cells of CSV with a header line as text; an empty or absent cell is an empty text.

    Parameters
    ----------
    source : Path or TextIO
        A file, or text that a person entered.
    name : str, optional
        What an error names; the file by default.
    """
    try:
        given = BytesIO(read_input(source, LARGEST_CSV)) if isinstance(source, Path) else source
        return pd.read_csv(given, dtype=str, keep_default_na=False).fillna("")
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())
        raise ModelError(f"{name or source} cannot be read as CSV ({reason}): {remedy}") from error
