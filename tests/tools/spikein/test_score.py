"""What a score says of a known effect, on two cars of the autumn."""

import json
import re

import pytest
from msgspec.structs import replace

from socast.stream.mcap_reader import McapSource
from socast.stream.mcap_writer import McapSink
from socast.tools.report.spikein import judge
from socast.tools.spikein.records import SpikeScore
from socast.tools.spikein.score import is_named_first
from tests.support.commands import called, refused
from tests.support.paths import RECORDINGS

pytestmark = pytest.mark.long


OTHERS = re.compile("fleet/taxi-00[345]/")
"""Keys of the cars that are left out, so that a score takes half as long."""


@pytest.fixture(scope="module")
def score(tmp_path_factory):
    """Return the JSON, the page and the text of a score."""
    folder = tmp_path_factory.mktemp("score")
    files = folder / "score.json", folder / "score.html"
    with McapSink(folder / "two.mcap") as sink:
        for messages in McapSource(RECORDINGS / "autumn.mcap"):
            sink.put([message for message in messages if not OTHERS.search(message.key)])
    options = ["--effect", "payload,regen_full_battery", "--size", "5%", "--json", files[0], "--html", files[1]]
    text, _, code = called("spikein", folder / "two.mcap", "--score", *options)
    assert code == 0
    return json.loads(files[0].read_text()), files[1].read_text(), text


def test_effect_that_the_data_show_is_named_first_with_its_size(score):
    (one,) = [each for each in score[0]["scores"] if each["effect"] == "payload"]
    assert one["visible"]
    assert one["new_rank"] == 1
    assert one["probability"] > 0.9
    assert one["in_credible_set"]
    assert one["ratio"] == pytest.approx(1.0, abs=0.25)
    assert one["way"] > 0.7


def test_placebo_names_what_the_recording_hides(score):
    assert "headwind" in [each["effect"] for each in score[0]["placebo"]]


def test_share_counts_what_the_data_can_show(score):
    (found,) = score[0]["found"]
    visible = [each for each in score[0]["scores"] if each["visible"] and each["plausible"]]
    assert found["visible"] == len(visible)
    assert found["tried"] == len(score[0]["scores"])
    assert found["named"] == sum(each["rank"] is not None for each in visible)


def test_page_and_terminal_show_the_outcomes(score):
    _, page, text = score
    assert "Outcome by effect and size" in page
    assert "Energy of the effect over that of the cars [%]" in page
    assert "Without any effect put in, the diagnosis names" in text


def test_outcome_says_whether_the_library_has_a_formula_that_shows_the_effect():
    seen = SpikeScore(effect="snow", size=0.03, visible=True, plausible=True, evidence=9.0)
    assert judge(seen) == "not named: no formula of the library shows it here"
    assert judge(replace(seen, form_evidence=4.0)) == "not named"
    assert judge(replace(seen, visible=False)) == "not visible in these data"
    assert judge(replace(seen, new_rank=2)) == "named"


@pytest.mark.parametrize(
    ("placebo", "spiked", "right"),
    [
        (["snow"], ["snow", "payload"], True),  # a name of the placebo is not new
        (["payload"], ["payload"], True),  # unless it is right
        ([], ["snow", "payload"], False),
        ([], [], False),
    ],
)
def test_other_method_is_judged_by_its_first_new_name(placebo, spiked, right):
    assert is_named_first(lambda names: names, placebo, spiked, ["payload"]) is right


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--score", "--out", "spiked.mcap"], "give one of the two"),
        ([], "give one of the two"),
        (["--score", "--effect", "tail_wind"], "no hidden effect is called 'tail_wind'"),
        (["--out", "spiked.mcap"], "--effect is missing"),
    ],
)
def test_request_that_cannot_be_met_is_refused_in_one_line(options, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert words in refused(capsys, "spikein", RECORDINGS / "shift.mcap", *options)
