"""The commands of the pages and the notebook run and show what the pages do; the tutorial finds the hidden effect."""

import json
import re
from collections import defaultdict
from statistics import mean

import pandas as pd
import pytest

from socast.core import models
from socast.core.diagnose.add.records import list_attempts
from socast.tools.simulator.trace import REFERENCE_DENSITY
from tests.support import own_car_figure, picture_figure
from tests.support.commands import refused
from tests.support.documented_commands import Shell, documented_commands, first_difference, prepare_folder
from tests.support.error_figure import FIGURE, error_figure
from tests.support.own_car_file import HIDDEN, SINCE, STANDBY
from tests.support.own_car_file import TRUTH as OWN_TRUTH
from tests.support.pages import PAGES, TUTORIAL, blocks, name_of, read
from tests.support.paths import ROOT
from tests.support.remembered_results import diagnosing_once

pytestmark = pytest.mark.long
COMMANDS = {
    name_of(page): commands
    for page in (TUTORIAL, *PAGES)
    if "<!-- included:" not in page.read_text(encoding="utf-8") and (commands := list(documented_commands(read(page))))
}
"""Page -> its commands in order; the tutorial comes first, and other pages use its files."""
TUTORIAL_NAME = name_of(TUTORIAL)
NOTEBOOK = ROOT / "docs" / "guide" / "notebook.md"
"""The steps of the tutorial in Python; its test shares the results of the commands."""
TRUTH = json.loads((ROOT / "recordings" / "autumn.truth.json").read_text(encoding="utf-8"))
AIR_DENSITY = 1.28
"""Mean density of air at 2 °C at sea level in the autumn of the recording. [kg/m^3]"""


@pytest.fixture(scope="module")
def shell(tmp_path_factory):
    """Return a shell that runs the commands of all pages in one folder, each command once."""
    with diagnosing_once():
        yield Shell(prepare_folder(tmp_path_factory.mktemp("pages")))


@pytest.fixture(scope="module")
def tutorial(shell):
    """Return the output of every command of the tutorial, after running all of them."""
    return {each.command: shell.run(each.command) for each in COMMANDS[TUTORIAL_NAME]}


@pytest.mark.parametrize(
    ("page", "at"),
    [(page, at) for page, commands in COMMANDS.items() for at in range(len(commands))],
    ids=[f"{page}: {each.command}" for page, commands in COMMANDS.items() for each in commands],
)
def test_command_runs_and_prints_what_the_page_shows(page, at, shell):
    for before in COMMANDS[page][:at]:
        shell.run(before.command)
    each = COMMANDS[page][at]
    printed = shell.run(each.command)
    assert any(printed), f"{each.command} prints nothing"
    assert each.lines or page != TUTORIAL_NAME, "the tutorial shows no output of this command"
    wrong = first_difference(each.lines, printed) if each.lines else None
    remedy = "renew the tutorial with: python -m tests.support.renew_tutorial"
    assert wrong is None, "\n".join([f"not printed: {wrong}", remedy, *printed])


def test_every_line_of_a_console_block_belongs_to_a_command():
    for page in PAGES:
        assert all(block.startswith("$ socast ") for block in blocks(page, "console")), name_of(page)


def test_no_two_commands_of_the_pages_write_the_same_file():
    written = defaultdict(set)
    for each in (each for commands in COMMANDS.values() for each in commands):
        for file in re.findall(r"(?:--out|-o|--json|--html|--suggest|effects new) (\S+)", each.command):
            written[file].add(each.command)
    assert {file: commands for file, commands in written.items() if len(commands) > 1} == {}


def seen_drag_area(rides: pd.DataFrame) -> float:
    """Return the drag area that the hidden energy of rides has for the wind in their tables. [m^2]

    It is less than the true one, because the wind of a station is not exactly that at a car.
    """
    hidden = {ride["ride_id"]: ride["hidden_kwh"]["headwind"] for ride in TRUTH["rides"]}
    known = rides[rides["ride_id"].isin(list(hidden))]
    energy = known["ride_id"].map(hidden)
    return float(energy @ known["effect_headwind"] / (known["effect_headwind"] @ known["effect_headwind"]))


def hidden_drag_area() -> float:
    """Return the true drag area of the hidden effect, for the air density of that autumn. [m^2]"""
    hidden = TRUTH["total"]["hidden"]["headwind"]
    of_cars = mean(car["drag_area"] for car in TRUTH["cars"].values())
    return hidden["factor"] * of_cars * REFERENCE_DENSITY / AIR_DENSITY


def test_diagnosis_names_the_hidden_effect_first_and_its_interval_contains_the_truth(shell, tutorial):
    (name,) = TRUTH["total"]["hidden"]
    diagnosis = next(lines for command, lines in tutorial.items() if "diagnose" in command)
    named = [line for line in diagnosis if re.match(r"\d\. ", line)]
    assert [line.split()[1].rstrip(":") for line in named] == [name]
    trial = models.load(str(shell.folder / "better.json")).history[-1]
    assert trial["effect"] == name
    low, high = trial["coefficient"]["ci95"]
    seen = seen_drag_area(pd.read_parquet(shell.folder / "autumn" / "rides.parquet"))
    assert low < seen < high
    assert 0.85 < seen / hidden_drag_area() < 1.0
    assert trial["coefficient"]["plausible"]
    assert trial["noise_floor_kwh"] < trial["mae_after_kwh"] < trial["mae_before_kwh"]
    assert trial["final"]["mae_after_kwh"] < trial["final"]["mae_before_kwh"]


@pytest.mark.usefixtures("tutorial")
def test_notebook_runs_and_the_error_falls(monkeypatch):
    monkeypatch.chdir(ROOT)
    cells = re.findall(
        r"^```{code-cell} python\n(?::tags:[^\n]*\n)?(.*?)^```$", read(NOTEBOOK), re.MULTILINE | re.DOTALL
    )
    names: dict[str, object] = {}
    for cell in cells:
        exec(compile(cell, str(NOTEBOOK), "exec"), names)
    rides, added, base = names["rides"], names["added"], names["base"]
    assert added.accepted
    before, after = ((model.predict(rides) - rides["energy_kwh"]).abs().mean() for model in (base, added.model))
    assert after < 0.8 * before


@pytest.mark.usefixtures("tutorial")
def test_picture_shows_the_missing_effect_of_the_tutorial(shell):
    found = picture_figure.diagnose_base(shell.folder)
    shown, now = (
        [float(number) for number in re.findall(r" cy='([\d.]+)'", text)]
        for text in (picture_figure.FIGURE.read_text(encoding="utf-8"), picture_figure.picture_figure(found))
    )
    assert shown == pytest.approx(now, abs=5.0), "renew with: python -m tests.support.picture_figure"
    assert shown[0] > shown[-1] + 150.0, "the points do not rise"


@pytest.mark.usefixtures("tutorial")
def test_figure_shows_the_falling_error_of_the_tutorial(shell):
    shown, now = (
        [
            float(number)
            for number in re.findall(r"(?<=[> (])\d+(?:\.\d+)?(?=[ <)])", re.sub("<style.*</style>", "", text))
        ]
        for text in (FIGURE.read_text(encoding="utf-8"), error_figure(shell.folder))
    )
    assert shown == pytest.approx(now, rel=0.02, abs=1.0), "renew with: python -m tests.support.error_figure"


@pytest.mark.usefixtures("tutorial")
def test_error_falls_beyond_doubt_on_the_final_hold_out_of_the_tutorial(shell):
    [step] = list_attempts(models.load(str(shell.folder / "better.json")).history)
    for fall in (step.of_effect, step.final):
        assert fall.change_kwh.value + fall.change_kwh.ci95 < 0.0
        assert fall.removed.low > 0.0
        assert not fall.is_noise_overestimated


@pytest.mark.usefixtures("tutorial")
def test_other_effect_is_refused_as_the_tutorial_says(shell, monkeypatch, capsys):
    monkeypatch.chdir(shell.folder)
    assert "Try `cornering`" in " ".join(read(TUTORIAL).split())
    message = refused(capsys, *["add", "cornering", "autumn", "--model", "base.json", "-o", "worse.json"])
    assert "cornering is not added" in message
    assert [step["action"] for step in models.load(str(shell.folder / "worse.json")).history] == ["fit", "refused"]


@pytest.mark.usefixtures("tutorial")
def test_loop_in_the_text_of_the_tutorial_adds_the_hidden_effect(shell):
    (loop,) = re.findall(r"`(socast diagnose [^`]*--auto[^`]*)`", read(TUTORIAL))
    shell.run(loop)
    steps = models.load(str(shell.folder / "best.json")).history
    assert [step["effect"] for step in steps if step["action"] == "add"] == list(TRUTH["total"]["hidden"])


def test_answer_agrees_with_the_truth_file():
    (name, hidden), *_ = TRUTH["total"]["hidden"].items()
    answers = [
        " ".join(text[text.index("The answer") :].split())
        for text in (read(TUTORIAL), read(ROOT / "recordings" / "README.md"))
    ]
    for words in (f"`{name}`", f"{hidden_drag_area():.2f} m²", f"{100 * hidden['absolute_share']:.0f} %"):
        assert all(words in answer for answer in answers)
    simulation = TRUTH["simulation"]
    for words in (f"--seed {simulation['seed']}", f"--vehicles {simulation['vehicles']}", f"--hidden {name}:0.06"):
        assert words in answers[1]


def test_change_of_the_own_car_is_dated_and_sized_as_it_was_hidden_and_drawn(shell):
    for each in COMMANDS[name_of(own_car_figure.PAGE)]:
        shell.run(each.command)
    found = own_car_figure.find_change(shell.folder)
    early, late = found.since_ci90
    assert early <= SINCE <= late
    assert found.causes[0].effect == HIDDEN
    step = models.load(str(shell.folder / "commuter-standby.json")).history[-1]
    low, high = step["coefficient"]["ci95"]
    assert low < STANDBY * json.loads(OWN_TRUTH.read_text(encoding="utf-8"))["factor"] < high
    shown, now = (
        [float(y) for y in re.findall(r" cy='([\d.]+)'", text)]
        for text in (own_car_figure.FIGURE.read_text(encoding="utf-8"), own_car_figure.own_car_figure(found))
    )
    assert shown == pytest.approx(now, abs=5.0), "renew with: python -m tests.support.own_car_figure"
