"""Count rows and files that cannot be read by cause, with the place of the first one and the remedy."""

import csv
import io
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import numpy as np

from socast.core.errors import ImportFileError
from socast.tools.importers.table.cells import is_grouped, is_value
from socast.tools.importers.table.guess_names import guess_name
from socast.tools.importers.table.text_stream import TextStream

WRONG_WIDTH: Final = "another number of cells than the header"
"""Cause: a row that cannot be divided into columns."""
DIVIDED_THOUSANDS: Final = (
    "more cells than the header, because thousands separators divide their numbers (export them without thousands "
    "separators, or in quotes, or with ';' between the cells)"
)
DIVIDED_DECIMALS: Final = (
    "more cells than the header, because decimal commas divide their numbers (export with ';' between the cells, or "
    "with decimal points)"
)
OPEN_QUOTE: Final = "a quote that is opened and not closed, up to the next quote (close or remove it)"
HEADER_AGAIN: Final = "the header again, as in joined files"
LONGEST_EXAMPLE: Final = 60
"""Letters of a row that are shown."""


class RowFaults:
    """Count rows that cannot be read by cause, with the place of the first one.

    Attributes
    ----------
    places : dict of str to str
        Cause -> file, line and text of its first row.
    notes : list of str
        What else a person should know of the files.
    blank_lines : list of int
        Blank lines of the file that is read.
    numbers : (n,) int
        Numbers of the rows of the block that is read, counted in the file without blank lines.
    wide : int
        Rows that cannot be divided into columns.
    """

    def __init__(self) -> None:
        self.causes: Counter[str] = Counter()
        self.places: dict[str, str] = {}
        self.notes: list[str] = []
        self.wide = 0
        self.numbers = np.zeros(0, "i8")
        self.blank_lines: list[int] = []

    def start_file(self, blank_lines: list[int]) -> None:
        """Begin a file, whose blank lines are noted while it is read."""
        self.blank_lines, self.numbers = blank_lines, np.zeros(0, "i8")

    def take_lines(self, other: "RowFaults") -> None:
        """Take over where the rows of a block stand in their file."""
        self.blank_lines, self.numbers = other.blank_lines, other.numbers

    def find_line(self, row: int) -> int | None:
        """Return the line of a row of the block that is read, None where it is not known."""
        return self.count_blank(int(self.numbers[row])) if row < len(self.numbers) else None

    def count_blank(self, number: int) -> int:
        """Return the line of a row whose number leaves out blank lines."""
        for blank in self.blank_lines:
            number += blank <= number
        return number

    def add(self, cause: str, count: int, path: Path, line: int | None, text: str) -> None:
        """Count rows by their cause."""
        self.causes[cause] += count
        if cause not in self.places:
            where = f"{path.name} line {line}" if line is not None else path.name
            shown = text if len(text) <= LONGEST_EXAMPLE else f"{text[:LONGEST_EXAMPLE]}..."
            self.places[cause] = f"first in {where}: {shown!r}" if text else f"first in {where}"

    def add_wide(self, cause: str, count: int, path: Path, line: int | None, text: str) -> None:
        """Count rows that cannot be divided into columns by their cause."""
        self.wide += count
        self.add(cause, count, path, line, text)

    def explain(self) -> str:
        """Return the causes with their numbers, the most frequent first."""
        return ", ".join(f"{count:,} with {cause}" for cause, count in self.causes.most_common())

    def explain_first(self) -> str:
        """Return the place of the first row of the most frequent cause, empty where there is none."""
        return next((self.places[cause] for cause, _ in self.causes.most_common(1) if cause in self.places), "")


def find_width_cause(text: str, names: Sequence[str], separator: str) -> str:
    """Return why a row has another number of cells than the header.

    Examples
    --------
    >>> find_width_cause("7,12,000.5,80", ["t", "odometer", "soc"], ",") == DIVIDED_THOUSANDS
    True
    >>> find_width_cause("7,0,5,79,9", ["t", "speed", "soc"], ",") == DIVIDED_DECIMALS
    True
    """
    if "\n" in text or "\r" in text or text.count('"') % 2:
        return OPEN_QUOTE
    cells = next(csv.reader([text], delimiter=separator), [])
    extra = len(cells) - len(names)
    if extra <= 0 or separator != ",":
        return WRONG_WIDTH
    if _join_thousands(cells) <= len(names) < len(cells):
        return DIVIDED_THOUSANDS
    numbers = sum(cell.strip().lstrip("+-").isdigit() for cell in cells)
    return DIVIDED_DECIMALS if numbers >= 2 * extra else WRONG_WIDTH


def is_header(cells: Sequence[str | None], names: Sequence[str]) -> bool:
    """Return whether cells are names of columns: of at least two, and with no value among them."""
    words = [cell.strip() for cell in cells if cell and cell.strip()]
    if len(words) < 2 or any(map(is_value, words)):
        return False
    known = sum(word in names or guess_name(word) is not None for word in words)
    return known >= max(2, len(words) / 2)


def find_open_quote(path: Path, encoding: str) -> int | None:
    """Return the number of the first line with an odd number of quotes, None where there is none."""
    with TextStream(path, encoding) as stream:
        for number, line in enumerate(io.TextIOWrapper(io.BufferedReader(stream), "utf-8", "replace"), start=1):
            if line.count('"') % 2:
                return number
    return None


def _join_thousands(cells: Sequence[str]) -> int:
    """Return the least number of cells that remains where cells that continue a number are joined to it."""
    count, at = 0, 0
    while at < len(cells):
        end = at + 1
        while end < len(cells) and is_grouped(
            ",".join(cell.strip() for cell in cells[at : end + 1]), ".", is_sure=False
        ):
            end += 1
        count, at = count + 1, end
    return count


class SkippedFiles:
    """Collect the files of an import that cannot be read.

    Parameters
    ----------
    is_active : bool
        Whether to skip them; otherwise the first one ends the import.

    Attributes
    ----------
    rows : dict of Path to int
        File -> rows that were read before the damage, and are kept.
    """

    def __init__(self, is_active: bool = False) -> None:
        self.is_active = is_active
        self.rows: dict[Path, int] = {}
        self._causes: dict[str, list[Path]] = defaultdict(list)

    @contextmanager
    def skip(self, path: Path) -> Iterator[None]:
        """Skip a file with an error, where files are skipped."""
        try:
            yield
        except ImportFileError as error:
            if not self.is_active:
                raise
            self.rows.setdefault(path, 0)
            cause = str(error).removeprefix(str(path)).lstrip(": ").partition(";")[0]
            self._causes[cause].append(path)

    def list_lines(self, files: int) -> list[str]:
        """Return a line for each cause, the most frequent first."""
        lines = []
        for cause, paths in sorted(self._causes.items(), key=lambda item: -len(item[1])):
            others = f" and {len(paths) - 1} more" if len(paths) > 1 else ""
            kept = sum(self.rows[path] for path in paths)
            rows = f"; {kept:,} rows before the damage are kept" if kept else ""
            lines.append(f"skipped {len(paths)} of {files} files ({paths[0].name}{others}): {cause}{rows}")
        return lines
