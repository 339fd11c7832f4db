"""Define a report: sections with tables, which a terminal prints, and figures, which a page shows too."""

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import plotly.graph_objects as go

from socast.tools.report.table import ReportTable


class Illustration(NamedTuple):
    """Hold a figure of a report, with its title and caption.

    Parameters
    ----------
    key : str
        Unique key that is safe in HTML.
    title : str
        Title, with the paper's figure number where it has one.
    caption : str
        Description of the figure, also for readers who cannot see it.
    small : bool
        Whether the figure is one of several similar ones, which the page shows side by side where there is room.
    """

    key: str
    title: str
    caption: str
    figure: go.Figure
    small: bool = False


class Drawing(NamedTuple):
    """Hold a picture of a report that is an SVG, with its title and caption.

    Parameters
    ----------
    svg : str
        SVG that says in words what it shows.
    """

    key: str
    title: str
    caption: str
    svg: str
    small: bool = False


class Section(NamedTuple):
    """Hold a section of a report.

    Parameters
    ----------
    key : str
        Key of its figures, also used in links to it.
    folded : bool
        Whether its figures show the same as its tables. The page folds such tables away, the terminal leaves them out.
    closed : bool
        Whether the page folds the whole section away until a reader opens it.
    """

    key: str
    title: str
    text: str
    tables: list[ReportTable]
    folded: bool = False
    closed: bool = False


class Report(NamedTuple):
    """Hold a report.

    Parameters
    ----------
    name : str
        Name of the format, of `REPORT_VERSIONS`.
    command : str
        Command that made it.
    lead : sequence of str
        Sentences, and commands, with which the page begins.
    notes : sequence of str
        Sentences with which it ends.
    result : object
        Result from which the figures are drawn.
    figures : mapping of str to callable
        Key of a section -> function of the result that draws its figures.
    """

    name: str
    command: str
    title: str
    sections: Sequence[Section]
    lead: Sequence[str] = ()
    notes: Sequence[str] = ()
    result: Any = None
    figures: Mapping[str, Callable[[Any], Sequence[Illustration | Drawing]]] = MappingProxyType({})

    def draw(self, key: str) -> Sequence[Illustration | Drawing]:
        """Return the figures of a section."""
        draw = self.figures.get(key)
        return draw(self.result) if draw else ()
