"""Test the library of effects: user files are checked and refused in one line, and the command prints effects."""

import json

import pytest
from typer.testing import CliRunner

from core import effects
from core.columns import SIGNALS
from core.effects import get, get_library, group_by_topic, list_tabulated, load_file, registry
from core.errors import EffectError, SettingsError
from tests.support.one_row import power
from tools.cli import main
from tools.commands.effects import app

GOOD = '''
import numpy as np
from core.effects import Parameter, effect

@effect(coefficient="door area times flow", unit="W/K", low=0, high=500, source="Somebody 2020, p. 7", per="time",
        parameters={"inside": Parameter(294.15, "K", 288.15, 298.15)})
def door_loss(stopped, inside, ambient):
    """Heat through open doors: P = H stopped (T_in - T)."""
    return stopped * np.maximum(inside - ambient, 0.0)
'''


@pytest.fixture
def write(tmp_path):
    """Return a function that writes a file of effects; the library is restored after the test."""
    before, brought = dict(registry._library), dict(registry._brought_by)

    def write(text, name="mine.py"):
        path = tmp_path / name
        path.write_text(text)
        return path

    yield write
    registry._library.clear()
    registry._library.update(before)
    registry._brought_by.clear()
    registry._brought_by.update(brought)


def test_unknown_effect_is_refused_with_similar_names():
    with pytest.raises(EffectError, match="effect 'aero_drg' is unknown: did you mean aero_drag"):
        get("aero_drg")
    with pytest.raises(EffectError, match="effect 'xyz' is unknown: known are rolling"):
        get("xyz")


# A user's own file


def test_valid_file_is_loaded_and_its_effects_work(write):
    (loaded,) = load_file(write(GOOD))
    assert (loaded.name, loaded.arguments, loaded.unit, loaded.per) == (
        "door_loss",
        ("stopped", "ambient"),
        "W/K",
        "time",
    )
    assert get("door_loss") is loaded
    assert power("door_loss", stopped=1.0, ambient=284.15) == pytest.approx(10.0)


def test_loading_a_file_again_replaces_its_effects(write):
    load_file(write(GOOD))
    (loaded,) = load_file(write(GOOD.replace("door_loss", "gate_loss")))
    assert get("gate_loss") is loaded
    assert "door_loss" not in get_library()


def test_existing_name_is_refused_and_the_library_stays_unchanged(write):
    before = dict(get_library())
    with pytest.raises(EffectError, match="effect 'rolling' is in the library already: give yours another name"):
        load_file(write(GOOD.replace("door_loss", "rolling")))
    assert dict(get_library()) == before
    load_file(write(GOOD))
    with pytest.raises(EffectError, match="effect 'door_loss' is in the library already"):
        load_file(write(GOOD, "theirs.py"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("def f(:\n  pass\n", ":1: not Python: "),
        ("x = 1\0", ": not Python: "),
        ("", ": holds no effect"),
        ("from core.effects.road_load import rolling\n", ": holds no effect"),
        ("import math\nimport socket\n", ":2: imports socket; an effect may import only"),
        ("from urllib.request import urlopen\n", ":1: imports urllib.request; "),
        ("from . import other\n", ":1: imports .; "),
        ("from ssl import create_default_context\n", ":1: imports ssl; "),
        ("http = __import__('http.client')\n", ":1: calls __import__; compute an effect from its columns alone"),
        ("x = 1\ny = open('/etc/hosts').read()\n", ":2: calls open; "),
        (
            GOOD.replace("per=", 'confused_with=["cabin_heatng"], per='),
            "'cabin_heatng', which is unknown: did you mean",
        ),
        (GOOD.replace("per=", 'confused_with=["qqq"], per='), "confused with 'qqq', which is unknown"),
        (
            GOOD.replace("298.15)", "298.15, grid=(288.15, 299.15))"),
            "must ascend, hold its value 294.15 and stay within",
        ),
        (GOOD.replace("per=", 'words="{kelvin}", per='), "words have a place for 'kelvin'"),
        (GOOD.replace("    return stopped", "    return stopped[:-1]"), ": effect door_loss: raises ValueError: "),
        (GOOD.replace("- ambient, 0.0)", "- ambient, 0.0)[1:]"), ": effect door_loss: raises ValueError: "),
        (
            GOOD.replace("    return ", "    return (stopped * (inside - ambient))[1:] + 0 * "),
            ": effect door_loss: raises",
        ),
        (GOOD.replace("- ambient, 0.0)", "- ambient, 0.0) / stopped"), "gives nan at stopped=0"),
        ("1 / 0\n", ":1: raises ZeroDivisionError when imported: division by zero"),
        ("raise SystemExit(3)\n", ":1: raises SystemExit when imported: 3"),
        (GOOD + GOOD, ": 'door_loss' is defined twice"),
        (
            GOOD.replace("stopped, inside, ambient", "stopped, inside, outside"),
            ": effect door_loss: argument 'outside' is neither",
        ),
        (GOOD.replace('"W/K"', '"W"'), ": effect door_loss: function gives [K]"),
        (
            "from core.effects import effect\n@effect\ndef f(speed):\n    pass\n",
            ":2: raises TypeError when imported: effect() takes",
        ),
    ],
)
def test_invalid_file_is_refused_in_one_line(write, text, message):
    path = write(text)
    before = dict(get_library())
    with pytest.raises(EffectError) as caught:
        load_file(path)
    assert str(caught.value).startswith(str(path))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    assert dict(get_library()) == before


@pytest.mark.parametrize(
    "text", ["while True:\n    pass\n", GOOD.replace("    return", "    while True: pass\n    return")]
)
def test_endless_loop_is_stopped(write, text):
    with pytest.raises(EffectError, match=r"mine\.py: not done after 1 s: look for an endless loop"):
        load_file(write(text), time_limit=1.0)


def test_unreadable_file_is_refused(tmp_path):
    with pytest.raises(EffectError, match=r"no\.py: cannot read effects: No such file"):
        load_file(tmp_path / "no.py")
    with pytest.raises(EffectError, match="cannot read effects: Is a directory"):
        load_file(tmp_path)
    (tmp_path / "binary.py").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(EffectError, match="cannot read effects: it is not UTF-8 text"):
        load_file(tmp_path / "binary.py")


# The command


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
    bad = CliRunner().invoke(app, ["check", str(write("x = 1\n", "bad.py"))])
    assert isinstance(bad.exception, EffectError)


def test_json_file_that_cannot_be_written_is_refused(tmp_path):
    done = CliRunner().invoke(app, ["list", "--json", str(tmp_path / "no" / "effects.json")])
    assert isinstance(done.exception, SettingsError)
    assert "cannot be written: No such file" in str(done.exception)
