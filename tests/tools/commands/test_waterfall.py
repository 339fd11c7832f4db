"""`socast waterfall` prints parts that add up, writes JSON and a page, and refuses invalid input in one line."""

import json
from itertools import pairwise

import msgspec
import pandas as pd
import pytest

from socast.core.condition.energy_split import EnergySplit, split_energy
from socast.core.models import EXTENDED_PHYSICAL
from socast.tools.report.waterfall import MOST_STEPS, draw_picture, draw_waterfall, list_steps
from tests.support.commands import called, done, refused
from tests.support.html_pages import assert_axes_are_titled, read_figures, read_page
from tests.support.paths import RECORDINGS, SHIFT

pytestmark = pytest.mark.long

FITTED = RECORDINGS / "fitted.json"


@pytest.fixture(scope="module")
def written(shift_tables, tmp_path_factory):
    """Return a folder with the JSON, the page and the printed text of a split by car."""
    made = tmp_path_factory.mktemp("written")
    options = ("--by", "car", "--price", "0.12", "--json", made / "w.json", "--html", made / "w.html")
    out, *ended = called("waterfall", shift_tables, "--model", FITTED, *options)
    assert ended == ["", 0]
    (made / "w.txt").write_text(out)
    return made


@pytest.fixture(scope="module")
def result(written):
    return json.loads((written / "w.json").read_text())


def test_json_holds_parts_that_add_up_to_the_measured_energy(result, shift_tables):
    assert result.pop("format") == {"report": "waterfall", "version": 3}
    assert msgspec.convert(result, EnergySplit).price == 0.12
    rides = pd.read_parquet(shift_tables / "rides.parquet")
    fit = rides[rides["fit_for_training"]]
    assert result["fleet"]["measured"]["energy_kwh"]["value"] == pytest.approx(fit["energy_kwh"].sum(), rel=1e-3)
    for group in (result["fleet"], *result["groups"]):
        parts = sum(share["energy_kwh"]["value"] for share in group["shares"])
        assert parts == pytest.approx(group["measured"]["energy_kwh"]["value"], rel=1e-3)
    assert [group["name"] for group in result["groups"]] == sorted(set(fit["vehicle_id"]))
    assert result["fleet"]["rides"] + sum(result["left_out"].values()) == result["read"] == len(rides)


def test_parts_picture_and_sentences_are_printed(written, result):
    out = (written / "w.txt").read_text()
    share = result["fleet"]["shares"][0]
    assert f"{share['energy_kwh']['value']:.1f} ± {share['energy_kwh']['ci95']:.1f}" in out
    per_km = share["per_100km_kwh"]
    assert f"{per_km['value']:.2f} ± {per_km['ci95']:.2f}  █" in out  # the picture
    assert "57 of 61 rides" in out
    assert "Left out: 4 too short. Price: 0.12 per kWh." in out
    assert f"{result['fleet']['measured']['cost']:.2f}" in out
    for words in ("By car", "each car like the median", "10 % slower", "█ taken, ░ returned", "Unexplained: "):
        assert words in out
    assert all(len(line) <= 120 for line in out.splitlines() if not line.startswith("report in "))


def test_page_has_a_waterfall_with_units(written):
    text = (written / "w.html").read_text()
    parts = read_page(text)
    assert parts.loaded == []
    assert {"parts", "groups", "savings", "figure-waterfall"} <= set(parts.ids)
    figure = read_figures(text)["figure-waterfall"]
    assert figure["layout"]["xaxis"]["title"]["text"] == "Energy per distance [kWh/100 km]"
    assert "price/ 100 km" in " ".join("".join(parts.text).split())


def test_recording_gives_what_its_tables_give(result):
    out, *_ = called("waterfall", SHIFT, "--model", FITTED, "--json", "-")
    assert json.loads(out)["fleet"]["shares"][0]["name"] == result["fleet"]["shares"][0]["name"]
    assert json.loads(out)["fleet"]["rides"] == result["fleet"]["rides"]


def test_model_without_standard_errors_is_split_without_intervals(shift_tables, tmp_path):
    done("waterfall", shift_tables, "--model", "extended_physical", "--json", tmp_path / "w.json")
    fleet = json.loads((tmp_path / "w.json").read_text())["fleet"]
    assert {share["energy_kwh"]["ci95"] for share in fleet["shares"]} == {None}
    assert {share["cost"] for share in fleet["shares"]} == {None}


def test_each_step_begins_where_the_one_before_it_ends(shift_tables):
    group = split_energy(pd.read_parquet(shift_tables / "rides.parquet"), EXTENDED_PHYSICAL).fleet
    assert_axes_are_titled(draw_waterfall(group))
    for most in (MOST_STEPS, 3):
        *steps, last = list_steps(group, most)
        assert len(steps) <= most + 1
        for one, other in pairwise(steps):
            assert other.start == pytest.approx(one.start + one.change)
        assert steps[-1].start + steps[-1].change == pytest.approx(last.change)
    assert any(step.what == "4 smaller terms" for step in list_steps(group, 3))
    assert max(len(line.plain) for line in draw_picture(list_steps(group), 60)) <= 60


def test_wrong_calls_are_refused_in_one_line(shift_tables, tmp_path, capsys):
    call = ("waterfall", shift_tables, "--model")
    assert "price of a kWh is -1, and must be 0 or above" in refused(capsys, *call, FITTED, "--price", "-1")
    assert "grouped by 'colour' (--by 'colour'): give fleet, or one" in refused(capsys, *call, FITTED, "--by", "colour")
    assert "no.json: cannot read a model" in refused(capsys, *call, tmp_path / "no.json")
    assert "is read and would be overwritten" in refused(capsys, *call, FITTED, "--json", FITTED)
    empty = tmp_path / "rides.parquet"
    pd.read_parquet(shift_tables / "rides.parquet")[:0].to_parquet(empty)
    assert "there are no rides" in refused(capsys, "waterfall", empty, "--model", FITTED)
