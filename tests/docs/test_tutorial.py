"""The tutorial is true: its commands print what it says, and what they find is what was hidden."""

import json
import re
from statistics import mean

import pytest

from core import models
from tests.support.commands import refused
from tests.support.tutorial import PAGE, ROOT, alike, difference, prepared, printed, renewed, shown
from tools.simulator.trace import REFERENCE_DENSITY

RECORDING = ROOT / "recordings" / "autumn.mcap"
TRUTH = json.loads(RECORDING.with_suffix(".truth.json").read_text(encoding="utf-8"))
TEXT = PAGE.read_text(encoding="utf-8")
TOLD = list(shown(TEXT))
ANSWER = "## The answer"
DENSITY = 1.29
"""Of air at 0 °C, the mean of that autumn, at sea level. [kg/m^3]"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder in which the commands of the page were run one after another, with what they printed."""
    return prepared(tmp_path_factory.mktemp("tutorial"))


@pytest.fixture(scope="module")
def outputs(folder):
    """Return what the commands of the page print."""
    return [printed(told.command, folder) for told in TOLD]


@pytest.mark.parametrize("at", range(len(TOLD)), ids=[told.command for told in TOLD])
def test_a_command_prints_what_the_page_says(at, outputs):
    told, lines = TOLD[at], outputs[at]
    assert told.lines, "the page says nothing of what it prints"
    wrong = difference(told.lines, lines)
    assert wrong is None, f"not printed: {wrong}\nrenew with: python -m tests.support.renew_tutorial\n" + "\n".join(
        lines
    )


def test_the_page_has_one_block_of_commands_after_the_other_and_nothing_else_to_type():
    blocks = re.findall(r"^```(\w*)$", TEXT, re.MULTILINE)
    assert set(blocks) == {"console", ""}
    assert len(blocks) == 2 * blocks.count("console")
    verbs = [told.command.split()[1] for told in TOLD]
    story = ["info", "tables", "fit", "compare", "diagnose", "add", "history", "replay"]
    assert [verb for i, verb in enumerate(verbs) if verb in story and verb not in verbs[:i]] == story


def drag_area() -> float:
    """Return the drag area that meets the wind in truth, in the air of that autumn. [m^2]"""
    hidden = TRUTH["total"]["hidden"]["headwind"]
    own = mean(car["drag_area"] for car in TRUTH["cars"].values())
    return hidden["factor"] * own * REFERENCE_DENSITY / DENSITY


def test_what_was_hidden_is_what_the_diagnosis_names_first_and_the_interval_holds_it(folder, outputs):
    (name,) = TRUTH["total"]["hidden"]
    diagnosed = next(lines for told, lines in zip(TOLD, outputs, strict=True) if "diagnose" in told.command)
    named = [line for line in diagnosed if re.match(r"\d\. ", line)]
    assert [line.split()[1].rstrip(":") for line in named] == [name]
    trial = models.load(str(folder / "better.json")).history[-1]
    assert trial["effect"] == name
    low, high = trial["coefficient"]["ci95"]
    assert low < drag_area() < high
    assert trial["coefficient"]["plausible"]
    assert trial["noise_floor_kwh"] < trial["mae_after_kwh"] < trial["mae_before_kwh"]
    assert trial["final"]["mae_after_kwh"] < trial["final"]["mae_before_kwh"]


def test_another_effect_is_refused_as_the_page_says(folder, outputs, monkeypatch, capsys):
    assert outputs
    monkeypatch.chdir(folder)
    (folder / "tried.json").write_bytes((folder / "base.json").read_bytes())
    assert "try `cornering`" in " ".join(TEXT.split())
    told = refused(capsys, *["add", "cornering", "--model", "tried.json", "--data", "autumn", "-o", "worse.json"])
    assert "cornering is not added" in told
    assert not (folder / "worse.json").exists()


def test_what_the_page_offers_beside_works(folder, outputs):
    assert outputs
    assert "`--html compared.html`" in TEXT
    printed("socast compare autumn --model base.json --html compared.html", folder)
    assert (folder / "compared.html").stat().st_size > 10_000
    (whole,) = re.findall(r"`(socast diagnose [^`]*--auto[^`]*)`", TEXT)
    printed(whole, folder)
    added = [entry["effect"] for entry in models.load(str(folder / "best.json")).history if entry["action"] == "add"]
    assert added == list(TRUTH["total"]["hidden"])


def test_the_effect_is_not_told_before_it_is_found():
    """Nor is it where a reader looks before: the page up to the diagnosis, and the recording's name."""
    name = next(iter(TRUTH["total"]["hidden"]))
    before = TEXT[: TEXT.index("$ socast diagnose")]
    assert name not in before.lower()
    assert TEXT.index("truth") > TEXT.index(ANSWER)
    told = (ROOT / "recordings" / "README.md").read_text(encoding="utf-8")
    assert name not in told[: told.index("The answer")]


def test_the_answer_is_that_of_the_truth_file():
    told = (ROOT / "recordings" / "README.md").read_text(encoding="utf-8")
    answer = " ".join(told[told.index("The answer") :].split())
    (name, hidden), *_ = TRUTH["total"]["hidden"].items()
    for said in (f"`{name}`", f"{drag_area():.1f} m²", f"{hidden['absolute_share']:.0%}".replace("%", " %")):
        assert said in answer
        assert said in " ".join(TEXT[TEXT.index(ANSWER) :].split())
    simulation = TRUTH["simulation"]
    for said in (f"--seed {simulation['seed']}", f"--vehicles {simulation['vehicles']}", f"--hidden {name}:0.05"):
        assert said in answer


def test_links_of_the_page_lead_somewhere():
    for target in re.findall(r"\]\(([^)#]+)", TEXT):
        assert target.startswith("http") or (PAGE.parent / target).exists(), target


def test_the_recording_is_small():
    assert RECORDING.stat().st_size < 3_000_000


def test_a_wrong_number_a_missing_line_and_other_words_are_differences():
    lines = ["the error is 0.0430 kWh", "more", "version 0123456789ab", "the end"]
    assert difference(["the error is 0.0431 kWh", "...", "the end"], lines) is None
    assert difference(["the error is 0.0461 kWh", "...", "the end"], lines) == "the error is 0.0461 kWh"
    assert difference(["the error is 0.0430 kWh", "the end"], lines) == "the end"
    assert difference(["the error is 0.0430 kWh", "more"], lines)
    assert difference(["...", "version ba9876543210", "the end"], lines) is None
    assert difference(["...", "the beginning"], lines) == "the beginning"
    assert difference(["...", "the end", "and more"], lines) == "and more"
    assert not alike("1. headwind", "1. wet_road")
    assert not alike("a fall of −20.4 %", "a fall of +20.4 %")


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
    assert alike(one, near)
    assert not alike(one, far)


def test_renewed_lines_keep_their_elisions():
    told = ["error 1.0 kWh", "...", "─────", "the end"]
    assert renewed(told, ["error 2.0 kWh", "new", "──", "the end"]) == ["error 2.0 kWh", "...", "──", "the end"]
    assert renewed(told, ["mistake 2.0 kWh", "new", "──", "the end"]) is None
    assert renewed(told[:1], ["error 2.0 kWh", "more"]) is None
