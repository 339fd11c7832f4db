"""Every measured figure of a page is inside a block, and the blocks hold what measurements published.

A figure is a number with a unit in a sentence that says how it was found or what it is better than. Code, block quotes
of output, limits and definitions are none.
"""

import re
from pathlib import Path

import pytest

from socast.tools.bench.figures.__main__ import MEASUREMENTS, main
from socast.tools.bench.figures.published import (
    RESULTS,
    Published,
    describe,
    list_blocks,
    list_pages,
    list_results,
    read_published,
    render_page,
)

NUMBER = r"\d[\d.,]*\s?(?:%|points|ms|µs|us|s|min|h|kB|MB|GB|kWh|Wh|times)(?![\w/])"
LIMIT = re.compile(rf"\b(?:at most|at least|up to|more than|less than|below|above) {NUMBER}")
COMPARED = re.compile(rf"{NUMBER}\s(?:of [a-z]+ )?(?:better|worse|less|more|faster|slower|larger|smaller)\b")
MEASURED = re.compile(
    r"\b(?:(?:was|were) measured|took|median|on average|of CPU time|times as fast|was found in|off by)\b"
)
STALE = re.compile(r"†|[Oo]lder than the (?:code|end|reaction)|out of date|measured (?:before|when|afterwards)")
CODE = re.compile(r"```.*?```|~~~.*?~~~|`[^`\n]*`|\]\([^)]*\)", re.DOTALL)
BLOCK = re.compile(r"<!-- ([a-z-]+) begins -->.*?<!-- \1 ends -->", re.DOTALL)


def list_figures(text: str) -> list[str]:
    """Return the sentences of a page that state a figure outside of blocks and code."""
    prose = CODE.sub(lambda code: "\n" * code.group().count("\n"), BLOCK.sub("", text))
    prose = LIMIT.sub("", prose)
    sentences = re.split(r"(?<=[.:;])\s|\n\s*\n|\n[-|] ?", prose)
    told = [" ".join(sentence.split()) for sentence in sentences]
    return [
        sentence
        for sentence in told
        if COMPARED.search(sentence) or (MEASURED.search(sentence) and re.search(NUMBER, sentence))
    ]


@pytest.fixture
def published():
    return read_published()


@pytest.mark.parametrize("page", list_pages(), ids=lambda page: page.name)
def test_blocks_of_a_page_are_those_that_were_published(page: Path, published):
    text = page.read_text(encoding="utf-8")
    assert render_page(text, published) == text


def test_every_measurement_has_a_block_and_every_block_a_measurement(published):
    shown = {name for page in list_pages() for name, _ in list_blocks(page.read_text(encoding="utf-8"))}
    assert shown == {*published, RESULTS}
    assert set(MEASUREMENTS) <= shown


@pytest.mark.parametrize("page", list_pages(), ids=lambda page: page.name)
def test_page_states_no_figure_that_no_command_writes(page: Path):
    text = page.read_text(encoding="utf-8")
    assert list_figures(text) == []
    assert STALE.findall(BLOCK.sub("", text)) == []


@pytest.mark.parametrize(
    ("sentence", "is_figure"),
    [
        ("The forecasts are 12 % better than those of a person.", True),
        ("10 GB of CSV took 4 min.", True),
        ("The error is 1.4 kWh on average.", True),
        ("A ride below 0.1 kWh is left out.", False),
        ("The interval of 90 % contains nine outcomes in ten.", False),
        ("Run `sleep 4 s` that took long.", False),
        ("<!-- speed begins -->\nIt took 3 s.\n<!-- speed ends -->", False),
    ],
)
def test_figures_are_told_from_limits(sentence: str, is_figure: bool):
    assert bool(list_figures(sentence)) == is_figure


def test_block_says_where_its_figures_come_from():
    one = Published("make bench", "2026-01-02", "abc", "2 cores", ["| a |"], {})
    page = render_page("<!-- speed begins -->\nold\n<!-- speed ends -->\n", {"speed": one})
    assert "\n".join(describe(one)) in page
    assert "old" not in page
    assert render_page(page, {}) == page


def test_results_are_single_figures_of_measurements():
    one = Published("x", "2026-01-02", "abc", "2 cores", [], {"wrong": "1 %", "wrong_on": "9 drives"})
    assert list_results({"league": one})[2:] == [
        "| drives of faulty loggers that are fit for training and wrong | 1 % | 9 drives | 2026-01-02 |"
    ]


def test_unknown_measurement_is_refused_in_one_line(capsys):
    assert main(["--only", "luck"]) == 2
    assert capsys.readouterr().err.startswith("luck is no measurement; choose from ")
