"""Text whose lines never end inside a number: between a value and its uncertainty, its unit or its mark.

Two numbers with an arrow between them, and a range in parentheses, are whole as well.
"""

import re
from typing import Any, Final

from rich.cells import cell_len
from rich.console import Console, ConsoleOptions
from rich.containers import Lines
from rich.measure import Measurement
from rich.text import Text

_UNIT: Final = r"(?:[kM]?Wh?|J/kg|V|kg|k?m[²³]?|km/h|m/s|min|s|h|K)(?!\w)"
_NUMBER: Final = r"[-−+]?\d"
_TIED: Final = (
    rf"(?<=\d) (?=[%×°*↓↑●○]|{_UNIT})|(?<=[±<]) (?=\d)"
    rf"|(?<=\d) (?=→ {_NUMBER})|(?<=→) (?={_NUMBER})"
    rf"|(?<=\d) (?=to {_NUMBER}[\d.,]*\))|(?<=\d to) (?={_NUMBER}[\d.,]*\))"
)
WHOLE: Final = re.compile(rf"{_TIED}|(?<=\d) (?=±)")
"""Spaces within a number."""
LOOSE: Final = re.compile(_TIED)
"""The same, but a line may end before the uncertainty, where columns are too narrow."""
ANY: Final = re.compile(r"(?!)")
"""None: a line may end at any space."""
_TIE: Final = "\ue000"
"""Stands for a space of a number while lines are broken, because rich breaks them at no-break spaces too."""


def measure_parts(text: str, tied: re.Pattern[str]) -> int:
    """Return the width of the longest part of a text that stays on one line.

    Units: returns [characters].

    Examples
    --------
    >>> [measure_parts("0.064 ± 0.011 (16.9 %)", tied) for tied in (WHOLE, LOOSE, ANY)]
    [13, 8, 5]
    """
    return max((cell_len(part) for part in tied.sub(_TIE, text).split()), default=0)


class UnbrokenText(Text):
    """Text that keeps each number on one line."""

    tied: re.Pattern[str] = WHOLE

    @classmethod
    def of(cls, content: Any) -> Any:
        """Return text, with markup if it is a string, as such a text; any other content unchanged."""
        text = Text.from_markup(content) if isinstance(content, str) else content
        if not isinstance(text, Text):
            return content
        return cls(
            text.plain,
            style=text.style,
            justify=text.justify,
            overflow=text.overflow,
            no_wrap=text.no_wrap,
            end=text.end,
            spans=list(text.spans),
        )

    def wrap(self, console: Console, width: int, **options: Any) -> Lines:
        """Return the lines of the text, as `rich.text.Text.wrap` does."""
        tied = self.copy()
        tied.plain = self.tied.sub(_TIE, self.plain)
        lines = tied.wrap(console, width, **options)
        for line in lines:
            line.plain = line.plain.replace(_TIE, " ")
        return lines

    def __rich_measure__(self, console: Console, options: ConsoleOptions) -> Measurement:
        """Return the least and the largest useful width."""
        return Measurement(measure_parts(self.plain, self.tied), super().__rich_measure__(console, options).maximum)
