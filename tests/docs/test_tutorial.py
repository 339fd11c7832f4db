"""The tutorial tells its story in order and does not name the hidden effect before a command shows it."""

import json
import re

import pytest

from tests.support.documented_commands import documented_commands, first_difference, lines_match, renew_lines
from tests.support.pages import TUTORIAL, read
from tests.support.paths import ROOT

RECORDING = ROOT / "recordings" / "autumn.mcap"
TEXT = read(TUTORIAL)


def test_page_shows_the_commands_in_the_order_of_the_story():
    fences = re.findall(r"^```(\w*)$", TEXT, re.MULTILINE)
    assert set(fences) == {"console", ""}
    assert len(fences) == 2 * fences.count("console")
    verbs = [each.command.split()[1] for each in documented_commands(TEXT)]
    story = ["info", "tables", "fit", "compare", "diagnose", "add", "history", "replay"]
    assert [verb for i, verb in enumerate(verbs) if verb in story and verb not in verbs[:i]] == story


def test_effect_is_not_named_before_the_comparison_shows_it():
    """The description of the recording does not name it before its answer either."""
    truth = json.loads(RECORDING.with_suffix(".truth.json").read_text(encoding="utf-8"))
    (name,) = truth["total"]["hidden"]
    assert name not in TEXT[: TEXT.index("$ socast compare")].lower()
    assert TEXT.index("truth") > TEXT.index("## The answer")
    about_recordings = read(ROOT / "recordings" / "README.md")
    assert name not in about_recordings[: about_recordings.index("The answer")]


def test_recording_is_small():
    assert RECORDING.stat().st_size < 15_000_000


def test_wrong_number_missing_line_and_other_words_are_differences():
    lines = ["the error is 0.0430 kWh", "more", "version 0123456789ab", "the end"]
    assert first_difference(["the error is 0.0431 kWh", "...", "the end"], lines) is None
    assert first_difference(["the error is 0.0461 kWh", "...", "the end"], lines) == "the error is 0.0461 kWh"
    assert first_difference(["the error is 0.0430 kWh", "the end"], lines) == "the end"
    assert first_difference(["the error is 0.0430 kWh", "more"], lines)
    assert first_difference(["...", "version ba9876543210", "the end"], lines) is None
    assert first_difference(["...", "the beginning"], lines) == "the beginning"
    assert first_difference(["...", "the end", "and more"], lines) == "and more"
    assert not lines_match("1. headwind", "1. wet_road")
    assert not lines_match("a fall of −20.4 %", "a fall of +20.4 %")


@pytest.mark.parametrize(
    ("one", "near", "far"),
    [
        ("q = 8.2e-06", "q = 7.9e-06", "q = 7.9e-05"),
        ("0.0354 kWh", "0.0355 kWh", "0.0369 kWh"),
        ("in 1,035 windows", "in 1,036 windows", "in 1,235 windows"),
        ("(3.3 %)", "(3.4 %)", "(3.5 %)"),
        ("1. headwind", "1. headwind", "2. headwind"),
        ("taxi-002, 2018-10-20", "taxi-002, 2018-10-20", "taxi-002, 2018-10-21"),
    ],
)
def test_rounding_is_no_difference_and_more_is_one(one, near, far):
    assert lines_match(one, near)
    assert not lines_match(one, far)


def test_renewed_lines_keep_their_elisions():
    shown = ["error 1.0 kWh", "...", "─────", "the end"]
    assert renew_lines(shown, ["error 2.0 kWh", "new", "──", "the end"]) == ["error 2.0 kWh", "...", "──", "the end"]
    assert renew_lines(shown, ["mistake 2.0 kWh", "new", "──", "the end"]) is None
    assert renew_lines(shown[:1], ["error 2.0 kWh", "more"]) is None
