"""Test what `socast replay --expect` and the fixtures of pytest tell of forecasts that differ."""

import json
from io import StringIO

import pytest
from rich.console import Console

from socast.core.errors import SettingsError
from socast.core.wire.messages import Message
from socast.stream.mcap_writer import McapSink
from socast.tools.testing.forecast_differences import compare_recordings, parse_tolerances, show_comparison
from socast.tools.testing.replayed import check_forecasts, write_samples
from tests.support.commands import called
from tests.support.paths import ROOT

FORECAST = {"time_s": 1.5e9, "model": "m/1", "soc_pct": 80.0, "range_km": {"mean": 100.0, "p05": None}, "ride_id": None}


@pytest.fixture
def write(tmp_path):
    """Return a function that writes forecasts of cars, each given by the fields that differ."""

    def write(name, *forecasts):
        with McapSink(tmp_path / name) as sink:
            for i, (vehicle, changes) in enumerate(forecasts):
                payload = FORECAST | {"vehicle_id": vehicle, "time_s": FORECAST["time_s"] + i} | changes
                sink.put([Message(f"fleet/{vehicle}/forecast", json.dumps(payload).encode(), i)])
        return tmp_path / name

    return write


def describe(comparison):
    text = StringIO()
    show_comparison(comparison, Console(file=text, width=120))
    return text.getvalue()


def test_same_forecasts_are_as_expected(write):
    rows = [("a", {}), ("b", {})]
    assert describe(compare_recordings(write("x", *rows), write("y", *rows))) == "2 forecasts as expected\n"


def test_fields_that_differ_are_listed_by_the_time_at_which_they_first_do(write):
    expected = write("x", ("b", {}), ("a", {}), ("b", {}))
    found = write(
        "y", ("b", {}), ("a", {"range_km": {"mean": 99.0, "p05": 1.0}}), ("b", {"soc_pct": 80.5, "model": "m/2"})
    )
    comparison = compare_recordings(expected, found)
    assert [(each.vehicle, each.field, each.differing, each.compared) for each in comparison.differences] == [
        ("a", "range_km.mean", 1, 1),
        ("a", "range_km.p05", 1, 1),
        ("b", "model", 1, 2),
        ("b", "soc_pct", 1, 2),
    ]
    assert comparison.differences[3].largest == pytest.approx(0.5)
    shown = describe(comparison)
    assert "4 fields of 2 cars differ; 3 forecasts compared" in shown
    assert "2017-07-14T02:40:01Z" in shown


def test_missing_and_additional_forecasts_are_differences(write):
    comparison = compare_recordings(write("x", ("a", {}), ("b", {})), write("y", ("a", {}), ("c", {})))
    assert not comparison.is_equal
    assert comparison.describe() == ("1 forecast missing (b); 1 forecast not expected (c); 1 forecast compared")


@pytest.mark.parametrize(("word", "equal"), [("soc_pct=0.6", False), ("range_km=1.5", False), ("", False)])
def test_tolerance_holds_for_all_parts_of_a_field_and_no_other(write, word, equal):
    expected = write("x", ("a", {}))
    found = write("y", ("a", {"soc_pct": 80.5, "range_km": {"mean": 99.0, "p05": None}}))
    assert compare_recordings(expected, found, parse_tolerances([word] if word else [])).is_equal is equal
    assert compare_recordings(expected, found, parse_tolerances(["soc_pct=0.6", "range_km=1.5"])).is_equal


@pytest.mark.parametrize("word", ["soc_pct", "soc_pct=", "=1", "soc_pct=-1", "soc_pct=nan"])
def test_wrong_tolerance_is_refused(word):
    with pytest.raises(SettingsError, match="give FIELD=NUMBER"):
        parse_tolerances([word])


def test_tolerance_of_an_unknown_field_names_the_known_ones(write):
    file = write("x", ("a", {}))
    with pytest.raises(SettingsError, match="no forecast has this field; the fields are model, range_km"):
        compare_recordings(file, file, {"rnage_km": 1.0})


def test_expectation_is_written_and_compared_by_the_command(tmp_path):
    expected, shift = tmp_path / "expected.mcap", ROOT / "recordings" / "shift.mcap"
    out, err, code = called("replay", shift, "--expect", expected)
    assert (code, "does not exist; write it with --update" in err) == (2, True)
    _, _, code = called("replay", shift, "--expect", expected, "--update")
    assert code == 0
    out, _, code = called("replay", shift, "--expect", expected)
    assert (code, "forecasts as expected" in out) == (0, True)
    out, _, code = called("replay", shift, "--expect", expected, "--model", "basic_physical")
    assert (code, "What differs first" in out, "2 fields of 7 cars differ" in out) == (1, True, True)


def test_absent_expectation_names_the_option_of_pytest(tmp_path, write):
    found = write("y", ("a", {}))
    assert "pytest --socast-update" in check_forecasts(tmp_path / "x", found, None, update=False)
    assert check_forecasts(tmp_path / "x", found, None, update=True) == ""
    assert check_forecasts(tmp_path / "x", found, None, update=False) == ""


@pytest.mark.parametrize(
    "sample", [{"vehicle_id": "a", "time_s": 1.0, "sped": 3}, {"vehicle_id": "a", "time_s": "now"}]
)
def test_wrong_sample_is_refused_with_its_number(tmp_path, sample):
    with pytest.raises(SettingsError, match="sample 1: "):
        write_samples([sample], tmp_path / "made.mcap")
