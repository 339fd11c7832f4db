"""Test `socast replay --expect`."""

import json
import shutil
from contextlib import nullcontext
from threading import Event

import pytest

from tests.support.commands import called, refused
from tests.support.paths import RECORDINGS

SHIFT = RECORDINGS / "shift.mcap"


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    """Return the expected forecasts of the shift, which tests do not change."""
    file = tmp_path_factory.mktemp("expected") / "expected.mcap"
    out, _, code = called("replay", SHIFT, "--expect", file, "--update")
    assert (code, out.splitlines()[-1]) == (0, f"{file}: written for the first time")
    return file


def test_same_forecasts_are_one_line_and_exit_with_0(expected):
    out, _, code = called("replay", SHIFT, "--expect", expected)
    assert (code, out.endswith(" forecasts as expected\n"), len(out.splitlines())) == (0, True, 1)


def test_json_holds_the_comparison(expected):
    out, _, code = called("replay", SHIFT, "--expect", expected, "--model", "basic_physical", "--json", "-")
    made = json.loads(out)["comparison"]
    assert (code, made["is_equal"], made["missing"]) == (1, False, {})
    assert {each["field"] for each in made["differences"]} == {"model", "ride_energy_predicted_kwh"}


def test_update_never_replaces_a_recording_of_telemetry(capsys, tmp_path):
    other = shutil.copy(RECORDINGS / "commuter.csv", tmp_path / "model.json")
    assert "name that ends with .mcap" in refused(capsys, "replay", SHIFT, "--expect", other, "--update")
    other = shutil.copy(SHIFT, tmp_path / "other.mcap")
    assert "is a recording of telemetry" in refused(capsys, "replay", SHIFT, "--expect", other, "--update")
    assert other.read_bytes() == SHIFT.read_bytes()


def test_other_forecasts_are_listed_and_exit_with_1(expected):
    out, _, code = called("replay", SHIFT, "--expect", expected, "--model", "basic_physical")
    assert code == 1
    assert "values of 2 fields differ (model, ride_energy_predicted_kwh)" in out
    assert "ride_energy_predicted_kwh [kWh]: differs in " in out


def test_tolerance_allows_differences(expected):
    allowed = ("--tolerance", "model=any", "--tolerance", "ride_energy=100%", "--tolerance", "ride_energy_predicted=9")
    out, _, code = called("replay", SHIFT, "--expect", expected, "--model", "basic_physical", *allowed)
    assert (code, "as expected" in out) == (0, True)


def test_update_prints_what_changes(expected, tmp_path):
    file = tmp_path / "expected.mcap"
    file.write_bytes(expected.read_bytes())
    out, _, code = called("replay", SHIFT, "--expect", file, "--update", "--model", "basic_physical")
    assert code == 0
    assert f"{file}: written anew; " in out
    assert "ride_energy_predicted_kwh [kWh]: differs in " in out
    assert [path.name for path in tmp_path.iterdir()] == ["expected.mcap"]
    assert called("replay", SHIFT, "--expect", file, "--model", "basic_physical")[2] == 0


@pytest.fixture
def stopped(monkeypatch):
    """Let replays be stopped after their first messages."""

    class LateStop(Event):
        asked = 0

        def is_set(self):
            self.asked += 1
            return self.asked > 1

    monkeypatch.setattr("socast.tools.commands.replay.stop_on_signals", lambda: nullcontext(LateStop()))


@pytest.mark.usefixtures("stopped")
def test_stopped_replay_neither_passes_nor_replaces_the_expectation(expected, capsys):
    before = expected.read_bytes()
    for options in ((), ("--update",)):
        assert "stopped before the end" in refused(capsys, "replay", SHIFT, "--expect", expected, *options)
    assert expected.read_bytes() == before
    assert [path.name for path in expected.parent.iterdir()] == [expected.name]


@pytest.mark.usefixtures("stopped")
def test_stopped_replay_says_that_its_results_are_partial():
    _, err, code = called("replay", SHIFT)
    assert code == 0
    assert "stopped before the end: the results are those of the messages so far" in err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--expect", "absent.mcap"), "absent.mcap: does not exist; write it with --update"),
        (("--update",), "give --expect F.mcap too"),
        (("--expect", "absent.mcap", "--update", "--tolerance", "socc=1"), "'socc': there is no such field; did you"),
        (("--expect", "absent.mcap", "--update", "--tolerance", "range_km=1kWh"), "range_km.mean is in km"),
    ],
)
def test_mistakes_are_refused_before_the_replay(capsys, options, message):
    assert message in refused(capsys, "replay", SHIFT, *options)


def test_expectation_without_forecasts_is_refused(capsys):
    assert "it is a recording of telemetry" in refused(capsys, "replay", SHIFT, "--expect", SHIFT)
