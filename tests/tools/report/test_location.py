"""Test the sentences and the figure of the location of the error."""

import msgspec
import pytest

from socast.core.diagnose.error_location.absent_signals import SIGNALS
from socast.core.diagnose.error_location.kinds import KINDS
from socast.core.diagnose.records import Diagnosis
from socast.core.wire.messages import Ride, Telemetry, Weather
from socast.tools.report.diagnosis.figures import draw_location
from socast.tools.report.diagnosis.location_sentences import (
    CAUSES,
    FIELDS,
    JUDGED_BY,
    KIND_NAMES,
    LEVEL_NAMES,
    advise_recording,
    describe_location,
)
from socast.tools.report.diagnosis.page import build_sections
from socast.tools.report.diagnosis.sentences import describe_next_step
from tests.support.html_pages import assert_axes_are_titled

LEVELS = ("ride", "day", "driver", "date", "car")


def make_load(level="ride", kind="constant", size=640.0, claimed=True, **more):
    unit = "W" if kind in {"constant", "beginning"} else "%"
    load = {"level": level, "kind": kind, "size": size, "low": 0.95 * size, "high": 1.06 * size, "unit": unit}
    load |= {"size_w": size, "low_w": 0.95 * size, "high_w": 1.06 * size, "gain": 50.0, "claimed": claimed}
    return load | more


def make_result(*loads, shares=None, absent=("climate power",), **more):
    shares = shares or {"measurement": 0.34, "scatter": 0.02, "ride": 0.64}
    quiet = [make_load("day", kind.name, 12.0, claimed=False) for kind in KINDS]
    location = {"loads": list(loads), "estimates": [*loads, *quiet], "shares": shares, "levels": ["ride", "day"]}
    location |= {"absent_signals": list(absent)}
    return msgspec.convert({"error_location": location | more}, Diagnosis)


def test_load_is_described_in_a_persons_words():
    shares, load, absent = describe_location(make_result(make_load()))
    assert load == (
        "Each ride has its own constant load of ±640 W (95 % interval 608 to 678 W), which the model does not "
        "explain: something that a person switches, such as heating or air conditioning. Log the climate power."
    )
    assert "34 % is measurement noise, 2 % is unexplained within rides and" in shares
    assert "64 % is unexplained and differs from ride to ride" in shares
    assert absent == "These data cannot show how much of an error the climate control causes (no climate power)."


def test_next_step_names_field_topic_and_documentation_of_an_absent_signal():
    (line,) = advise_recording(make_result(make_load()))
    assert line.startswith(
        "Record hvac_w in fleet/{vehicle}/telemetry (climate power): docs/reference/wire.md documents"
    )
    assert describe_next_step(make_result(make_load()))[-1].startswith("Record hvac_w")
    assert not advise_recording(make_result(make_load(), absent=("wind",)))
    assert "hvac_w" not in " ".join(describe_next_step(make_result(absent=("climate power",))))


def test_fields_to_record_are_those_of_messages():
    declared = {each for kind in (Telemetry, Ride, Weather) for each in kind.__struct_fields__}
    assert {name for field, _ in FIELDS.values() for name in field.split(" and ")} <= declared
    assert set(FIELDS) <= set(SIGNALS)


def test_climate_power_that_is_logged_is_not_asked_for():
    _, load = describe_location(make_result(make_load(), absent=()))
    assert "Log the climate power" not in load
    assert "contain the measured climate power" in load


def test_climate_power_of_some_rides_is_counted_and_to_be_compared_there():
    _, load, absent = describe_location(make_result(make_load(), partial_signals={"climate power": [15, 31]}))
    assert "15 of 31 rides contain the measured climate power: compare it there. Log the climate power." in load
    assert absent.endswith("the climate control causes (climate power in 15 of 31 rides only).")


def test_share_of_overestimated_noise_is_an_upper_limit():
    shares, note, _ = describe_location(make_result(shares={"measurement": 0.51, "day": 0.49}, noise_limited=True))[:3]
    assert "at most 51 % is measurement noise" in shares
    assert "overestimated" in note


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("kind", [kind.name for kind in KINDS])
def test_each_level_and_kind_has_a_sentence_with_a_remedy(level, kind):
    line = describe_location(make_result(make_load(level, kind, 23.0)))[1]
    assert line.count("23") == 1 + (kind != "constant")
    assert CAUSES[kind][level][0] in line
    assert line.endswith(".")


def test_every_absent_signal_has_words():
    assert set(JUDGED_BY) == set(SIGNALS)
    assert set(LEVEL_NAMES) == set(LEVELS)
    assert set(KIND_NAMES) == {kind.name for kind in KINDS}


def test_rivals_of_a_load_are_named():
    load = make_load("day", "drag", 23.0, other_kinds=["rolling"], other_levels=["driver"])
    line = describe_location(make_result(load))[1]
    assert line.endswith("Not distinguishable from a load per km or per driver.")


def test_diagnosis_without_load_says_so():
    shares, line = describe_location(make_result(shares={"measurement": 1.0, "scatter": 0.0}, absent=()))
    assert shares.endswith(", 100 % is measurement noise.")
    assert line.startswith("No load differs")
    assert describe_location(Diagnosis()) == []


def test_figure_has_a_panel_for_each_level_and_a_point_with_interval_for_each_kind():
    (drawn,) = draw_location(make_result(make_load()))
    claimed, quiet = (trace for trace in drawn.figure.data if trace.error_x.array is not None)
    assert list(claimed.y) == ["per second"]
    assert claimed.error_x.array[0] == pytest.approx(0.06 * 640.0)
    assert len(quiet.y) == len(KINDS)
    assert [note.text for note in drawn.figure.layout.annotations] == ["Between rides", "Between vehicle-days"]
    first, second = drawn.figure.select_xaxes()
    assert first.matches == "x2" or second.matches == "x"
    assert_axes_are_titled(drawn.figure)
    assert draw_location(Diagnosis()) == []


def test_figure_marks_what_sampling_alone_causes():
    (drawn,) = draw_location(make_result(make_load(floor_w=50.0)))
    ticks = [trace for trace in drawn.figure.data if trace.name == "limit of sampling"]
    assert (50.0, "per second") in [row for trace in ticks for row in zip(trace.x, trace.y, strict=True)]


def test_page_has_a_section_for_the_location():
    sections = {section.key: section for section in build_sections(make_result(make_load()))}
    assert "±640 W" in sections["location"].text
