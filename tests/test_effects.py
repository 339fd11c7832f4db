"""The library of effects: a user's file is checked, and told of in one line."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from core import effects
from core.effects import get, library, load_file
from core.errors import EffectError, SettingsError
from tools.effects import app


def power(name: str, **columns: float) -> float:
    """Power of an effect for one row."""
    return float(get(name).power({n: np.array([value]) for n, value in columns.items()})[0])


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
    """Write a file of effects; what it brings leaves the library after the test."""
    before, brought = dict(effects._library), dict(effects._brought_by)

    def write(text, name="mine.py"):
        path = tmp_path / name
        path.write_text(text)
        return path

    yield write
    effects._library.clear()
    effects._library.update(before)
    effects._brought_by.clear()
    effects._brought_by.update(brought)


def test_unknown_names_are_met_with_close_ones():
    with pytest.raises(EffectError, match="effect 'aero_drg' is unknown: did you mean aero_drag"):
        get("aero_drg")
    with pytest.raises(EffectError, match="effect 'xyz' is unknown: known are rolling"):
        get("xyz")


# A user's own file


def test_a_good_file_is_loaded_and_its_effects_work(write):
    (found,) = load_file(write(GOOD))
    assert (found.name, found.arguments, found.unit, found.per) == ("door_loss", ("stopped", "ambient"), "W/K", "time")
    assert get("door_loss") is found
    assert power("door_loss", stopped=1.0, ambient=284.15) == pytest.approx(10.0)


def test_loading_again_replaces_what_the_file_brought(write):
    load_file(write(GOOD))
    (found,) = load_file(write(GOOD.replace("door_loss", "gate_loss")))
    assert get("gate_loss") is found
    assert "door_loss" not in library()


def test_a_name_that_is_taken_is_refused_and_the_library_unchanged(write):
    before = dict(library())
    with pytest.raises(EffectError, match="effect 'rolling' is in the library already: give yours another name"):
        load_file(write(GOOD.replace("door_loss", "rolling")))
    assert dict(library()) == before
    load_file(write(GOOD))
    with pytest.raises(EffectError, match="effect 'door_loss' is in the library already"):
        load_file(write(GOOD, "theirs.py"))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("def f(:\n  pass\n", ":1: not Python: "),
        ("x = 1\0", ": not Python: "),
        ("", ": holds no effect"),
        ("from core.road_load import rolling\n", ": holds no effect"),
        ("import math\nimport socket\n", ":2: imports socket; an effect needs no more than"),
        ("from urllib.request import urlopen\n", ":1: imports urllib.request; "),
        ("from . import other\n", ":1: imports .; "),
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
def test_a_bad_file_is_told_of_in_one_line(write, text, said):
    path = write(text)
    before = dict(library())
    with pytest.raises(EffectError) as caught:
        load_file(path)
    assert str(caught.value).startswith(str(path))
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)
    assert dict(library()) == before


@pytest.mark.parametrize(
    "text", ["while True:\n    pass\n", GOOD.replace("    return", "    while True: pass\n    return")]
)
def test_an_endless_loop_is_ended(write, text):
    with pytest.raises(EffectError, match=r"mine\.py: not done after 1 s: look for a loop without end"):
        load_file(write(text), time_limit=1.0)


def test_files_that_cannot_be_read(tmp_path):
    with pytest.raises(EffectError, match=r"no\.py: cannot read effects: No such file"):
        load_file(tmp_path / "no.py")
    with pytest.raises(EffectError, match="cannot read effects: Is a directory"):
        load_file(tmp_path)
    (tmp_path / "binary.py").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(EffectError, match="cannot read effects: it is not UTF-8 text"):
        load_file(tmp_path / "binary.py")


# The command


def test_list_shows_every_effect_and_writes_json(tmp_path):
    done = CliRunner().invoke(app, ["list", "--json", str(tmp_path / "effects.json")], env={"COLUMNS": "120"})
    assert done.exit_code == 0
    written = json.loads((tmp_path / "effects.json").read_text())
    assert [row["name"] for row in written] == list(library())
    for row in written:
        assert row["name"] in done.stdout
        assert row["formula"].startswith("P = ")
        assert row["source"]
    assert written[0]["plausible"] == [0.004, 0.025]
    assert "[m^2]" in done.stdout


def test_check_command_tells_of_a_good_file_and_raises_for_a_bad_one(write):
    done = CliRunner().invoke(app, ["check", str(write(GOOD))], env={"COLUMNS": "200"})
    assert done.exit_code == 0
    assert "door_loss" in done.stdout
    assert "1 effect in" in done.stdout
    bad = CliRunner().invoke(app, ["check", str(write("x = 1\n", "bad.py"))])
    assert isinstance(bad.exception, EffectError)


def test_json_that_cannot_be_written_is_told_of(tmp_path):
    done = CliRunner().invoke(app, ["list", "--json", str(tmp_path / "no" / "effects.json")])
    assert isinstance(done.exception, SettingsError)
    assert "cannot be written: No such file" in str(done.exception)
