"""Test the library of effects: user files are checked, and refused in one line."""

import re

import pytest

from socast.core.effects import get, get_library, load_file, registry
from socast.core.errors import EffectError
from tests.support.effect_files import GOOD
from tests.support.one_row import power


@pytest.fixture
def write(tmp_path):
    """Return a function that writes a file of effects."""

    def write(text, name="mine.py"):
        path = tmp_path / name
        path.write_text(text)
        return path

    return write


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


@pytest.mark.usefixtures("_checks_here")
def test_loading_a_file_again_replaces_its_effects(write):
    load_file(write(GOOD))
    (loaded,) = load_file(write(GOOD.replace("door_loss", "gate_loss")))
    assert get("gate_loss") is loaded
    assert "door_loss" not in get_library()


@pytest.mark.usefixtures("_checks_here")
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
        ('{"terms": []}\n', ": holds JSON, and effects are written in Python: name a .py file; a model file goes to"),
        ('{"low": null}', ": holds JSON, and effects are written in Python"),
        ("", ": holds no effect"),
        ("from socast.core.effects.road_load import rolling\n", ": holds no effect"),
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
            "from socast.core.effects import effect\n@effect\ndef f(speed):\n    pass\n",
            ":2: @effect has too many arguments without a name: write @effect(coefficient=",
        ),
        (
            GOOD.replace('source="', 'sauce="'),
            "@effect has no argument sauce: write @effect(coefficient=",
        ),
        (
            re.sub(r'source="[^"]*",? ?', "", GOOD),
            "@effect lacks source: write @effect(coefficient=..., unit=..., low=..., high=..., source=...)",
        ),
        (
            "from socast.core.effects import Parameter\nlimit = Parameter(3.0)\n",
            ':2: Parameter lacks unit: write Parameter(value, "unit", low, high, grid=(...))',
        ),
    ],
)
@pytest.mark.usefixtures("_checks_here")
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
    ("text", "message"),
    [
        (GOOD.replace("    return stopped", "    return stopped[:-1]"), ":9: effect door_loss: raises ValueError: "),
        ("import sys\nprint('talk', file=sys.stderr)\n1 / 0\n", ":3: raises ZeroDivisionError when imported: "),
        ("import os\nos._exit(7)\n", ": the interpreter stopped with code 7"),
    ],
)
def test_refusal_of_the_separate_process_is_one_line(write, monkeypatch, text, message):
    monkeypatch.setattr(registry, "ALLOWED_IMPORTS", {*registry.ALLOWED_IMPORTS, "os", "sys"})
    path = write(text)
    with pytest.raises(EffectError) as caught:
        load_file(path)
    assert str(caught.value).startswith(f"{path}{message}")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "text", ["while True:\n    pass\n", GOOD.replace("    return", "    while True: pass\n    return")]
)
def test_endless_loop_is_stopped(write, text):
    with pytest.raises(EffectError, match=r"mine\.py: not done after 0.2 s: look for an endless loop"):
        load_file(write(text), time_limit=0.2)


def test_unreadable_file_is_refused(tmp_path):
    with pytest.raises(EffectError, match=r"no\.py: cannot read effects: No such file"):
        load_file(tmp_path / "no.py")
    with pytest.raises(EffectError, match="cannot read effects: Is a directory"):
        load_file(tmp_path)
    (tmp_path / "binary.py").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(EffectError, match="cannot read effects: it is not UTF-8 text"):
        load_file(tmp_path / "binary.py")
