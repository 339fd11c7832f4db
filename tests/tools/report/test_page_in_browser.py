"""Test in a browser that the script of a page draws its figures."""

import plotly.graph_objects as go

from socast.tools.report.document import Drawing, Illustration, Report, Section
from socast.tools.report.figure_style import make_figure
from socast.tools.report.page import write_report
from tests.support.browsers import WIDE, open_browser


def test_figure_below_a_drawing_is_drawn(tmp_path):
    drawn = [
        Drawing("first", "A drawing", "", '<svg viewBox="0 0 9 9"></svg>'),
        Illustration("second", "A figure", "", make_figure([go.Scatter(x=[1, 2], y=[1, 2])])),
    ]
    sections = [Section("one", "One", "", [])]
    page = Report("history", "history", "A page", sections, figures={"one": lambda _: drawn})
    write_report(page, tmp_path / "page.html")
    with open_browser() as browser:
        shown, errors = browser.new_page(viewport=WIDE), []
        shown.on("pageerror", lambda error: errors.append(str(error)))
        shown.goto((tmp_path / "page.html").as_uri())
        shown.wait_for_selector("#figure-second .main-svg", timeout=20_000)
        assert errors == []
