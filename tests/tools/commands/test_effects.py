"""Test that the commands list, show, check and create effects."""

import json

import pytest
from typer.testing import CliRunner

from socast.core import effects
from socast.core.columns import SIGNALS
from socast.core.effects import get, get_library, group_by_topic, list_tabulated, load_file, registry
from socast.core.errors import EffectError, SettingsError
from socast.tools.cli import main
from socast.tools.commands.effects import app
from tests.support.effect_files import GOOD


@pytest.fixture
def write(tmp_path):
    """Return a function that writes a file of effects."""

    def write(text, name="mine.py"):
        path = tmp_path / name
        path.write_text(text)
        return path

    return write


def test_list_shows_every_effect_by_topic_and_writes_json(tmp_path):
    done = CliRunner().invoke(app, ["list", "--json", str(tmp_path / "effects.json")])
    assert done.exit_code == 0
    written = json.loads((tmp_path / "effects.json").read_text())["effects"]
    assert [row["name"] for row in written] == list(get_library())
    assert list(dict.fromkeys(row["topic"] for row in written)) == list(group_by_topic())
    for row in written:
        assert row["name"] in done.stdout
        assert row["topic"] in done.stdout
        assert row["formula"].startswith("P = ")
        assert row["source"]
        assert row["sign"] in (-1, 0, 1)
    assert written[0]["plausible"] == [0.004, 0.025]
    assert "[m^2]" in done.stdout
    assert [name for row in written for name in row["tabulated"]] == [f"effect_{name}" for name in list_tabulated()]


@pytest.mark.parametrize("name", [*get_library(), "cold_rolling@reference=283.15"])
def test_show_prints_the_whole_declaration(name):
    effect = get(name)
    done = CliRunner().invoke(app, ["show", name])
    assert done.exit_code == 0
    printed = " ".join(done.stdout.split())
    for expected in (
        *(effect.name, effect.coefficient, f"[{effect.unit}]" if effect.unit != "1" else "", effect.energy_name),
        *(effect.source[:40], effect.shown_by[:40], *effect.confused_with, *effect.parameters, *effect.arguments),
        *(f"{effect.low:g} to {effect.high:g}", effect.formula[:40]),
    ):
        assert expected in printed, expected


def test_user_effects_are_listed_and_shown_with_their_file(write):
    path = write(GOOD.replace("per=", 'confused_with="cabin_heating", per='))
    listed = CliRunner().invoke(app, ["list", "--effects", str(path)])
    assert listed.exit_code == 0
    assert listed.stdout.index("mine.py") < listed.stdout.index("door_loss")
    shown = CliRunner().invoke(app, ["show", "door_loss", "--effects", str(path)])
    assert "door_loss (mine.py)" in shown.stdout
    assert "cabin_heating" in shown.stdout
    assert "door_loss" in list_tabulated()


@pytest.mark.parametrize("origin", [None, *get_library()])
def test_new_file_passes_its_check_and_copies_its_origin(tmp_path, origin):
    path = tmp_path / "begun.py"
    done = CliRunner().invoke(app, ["new", str(path), *(["--from", origin] if origin else [])])
    assert done.exit_code == 0
    assert f"socast effects check {path}" in " ".join(done.stdout.split())
    (copy,) = registry._run(path)
    effects.check_effect(copy)
    assert f'per="{copy.per}",' in path.read_text()
    if origin is None:
        assert copy.name == "my_effect"
        assert copy.variants
        return
    like = get(origin)
    assert copy.name == f"my_{origin}"
    for what in ("coefficient", "unit", "low", "high", "source", "per", "formula", "arguments", "documentation"):
        assert getattr(copy, what) == getattr(like, what), what
    assert (copy.parameters, copy.words, copy.scale) == (like.parameters, like.words, like.scale)
    assert copy.confused_with == (origin,)


@pytest.mark.parametrize("origin", [None, "accessories"])
def test_new_file_can_be_loaded(write, tmp_path, origin):
    write("")  # the fixture restores the library after the test
    path = tmp_path / "begun.py"
    CliRunner().invoke(app, ["new", str(path), *(["--from", origin] if origin else [])])
    (loaded,) = load_file(path)
    assert get(loaded.name) is loaded


def test_new_file_lists_every_column(tmp_path):
    CliRunner().invoke(app, ["new", str(tmp_path / "begun.py")])
    text = (tmp_path / "begun.py").read_text()
    for column in SIGNALS:
        assert f"#   {column.name}" in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["show", "cold_roling"], "effect 'cold_roling' is unknown: did you mean cold_rolling"),
        (["show", "cold_rolling@reference=1"], "parameter reference is 1 K, but must be from 268.15 to 303.15"),
        (["new", "mine.txt"], "mine.txt: effects are written in Python: name a file that ends in .py"),
        (["new", "no/mine.py"], "mine.py cannot be written: No such file or directory"),
        (["new", "there.py"], "there.py is there already and would be overwritten"),
        (["new", "mine.py", "--from", "headwnd"], "effect 'headwnd' is unknown: did you mean headwind"),
        (["check", "no.py"], "no.py: cannot read effects: No such file or directory"),
        (["list", "--effects", "no.py"], "no.py: cannot read effects: No such file or directory"),
    ],
)
def test_bad_command_is_refused_in_one_line(tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.py").write_text("")
    with pytest.raises(SystemExit) as ended:
        main(["effects", *arguments])
    assert ended.value.code == 2
    printed = capsys.readouterr().err
    assert message in printed
    assert printed.count("\n") == 1
    assert not (tmp_path / "mine.py").exists()


def test_check_command_accepts_a_valid_file_and_refuses_an_invalid_one(write):
    done = CliRunner().invoke(app, ["check", str(write(GOOD))], env={"COLUMNS": "200"})
    assert done.exit_code == 0
    assert "door_loss" in done.stdout
    assert "1 effect in" in done.stdout
    lines = [line.split() for line in done.stdout.splitlines()]
    assert any(line[-1:] == ["per"] for line in lines)
    assert any(line[:1] == ["door_loss"] and line[-1] == "time" for line in lines)
    bad = CliRunner().invoke(app, ["check", str(write("x = 1\n", "bad.py"))])
    assert isinstance(bad.exception, EffectError)


def test_json_file_that_cannot_be_written_is_refused(tmp_path):
    done = CliRunner().invoke(app, ["list", "--json", str(tmp_path / "no" / "effects.json")])
    assert isinstance(done.exception, SettingsError)
    assert "cannot be written: No such file" in str(done.exception)
