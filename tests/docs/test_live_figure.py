"""Test that the figure of the live table has the words of today's table, and that the README shows it."""

import re
import xml.etree.ElementTree as ET

from socast.core import models
from socast.core.pipeline import Pipeline
from socast.stream.loop import Tally
from socast.tools.terminal.model_comparison import DEFAULT_MODEL
from tests.support.live_figure import FIGURE, live_figure
from tests.support.paths import ROOT


def words(svg: str) -> set[str]:
    """Return the texts of a figure, with 0 for every number."""
    texts = (each.text or "" for each in ET.fromstring(svg).iter() if each.tag.endswith("text"))
    return {re.sub(r"[\d,.]+", "0", text.replace("\xa0", " ")).strip() for text in texts}


def test_figure_has_every_word_of_the_table_of_today():
    pipeline = Pipeline(models.load(DEFAULT_MODEL))
    expected = words(live_figure(pipeline, Tally()))
    assert any("undecodable" in text for text in expected)
    assert {text for text in expected if "─" not in text} <= words(FIGURE.read_text(encoding="utf-8"))


def test_figure_shows_cars_with_forecasts_and_minus_signs():
    shown = words(FIGURE.read_text(encoding="utf-8"))
    assert {"taxi-0", "0 0–0", "−0"} <= shown


def test_figure_asks_no_other_host_and_cuts_no_text():
    figure = FIGURE.read_text(encoding="utf-8")
    assert set(re.findall(r"https?://[^\s\"')<]+", figure)) <= {
        "http://www.w3.org/2000/svg",
        "https://www.textualize.io",
    }
    assert "…" not in figure


def test_readme_shows_the_figure():
    assert "](docs/live.svg)" in (ROOT / "README.md").read_text(encoding="utf-8")
