"""The tutorial of one's own car goes from a bare file to the hidden effect in five commands."""

import json
import re

from tests.support.documented_commands import documented_commands
from tests.support.own_car_figure import PAGE
from tests.support.own_car_file import FILE, HIDDEN, OPTIONS, SINCE, STANDBY, TRUTH
from tests.support.pages import read
from tests.support.paths import ROOT

TEXT = read(PAGE)
TRUE = json.loads(TRUTH.read_text(encoding="utf-8"))


def test_five_commands_lead_from_the_file_to_the_diagnosis():
    calls = [each.command.split()[1] for each in documented_commands(TEXT[: TEXT.index("## How large")])]
    assert calls == ["vehicles", "import", "tables", "fit", "diagnose"]


def test_file_holds_time_speed_and_power_only():
    lines = FILE.read_text(encoding="utf-8").splitlines()
    assert lines[0] == "time,speed_kmh,power_kw"
    assert all(re.fullmatch(r"2019-0[67]-\d\d \d\d:\d\d:\d\d,\d+\.\d,-?\d+\.\d\d", line) for line in lines[1:])
    assert f"{len(lines) - 1:,} rows" in TEXT
    for line in TEXT[TEXT.index("```text\n") + 8 :].partition("```")[0].splitlines():
        assert line in lines


def test_effect_is_not_named_before_the_diagnosis_and_the_answer_is_that_of_the_truth():
    assert HIDDEN not in TEXT[: TEXT.index("$ socast diagnose")].lower()
    assert (TRUE["effect"], TRUE["since"]) == (HIDDEN, SINCE)
    assert f"a hidden `{HIDDEN}` of {STANDBY * TRUE['factor']:.0f} W" in TEXT
    about = " ".join(read(ROOT / "recordings" / "README.md").split())
    assert OPTIONS in about
