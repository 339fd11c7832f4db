"""Exported data sets hold what others need to name a hidden effect, and the judge grades their answers."""

import json
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from socast.core.effects import get_library
from socast.core.errors import SettingsError
from socast.tools.bench.hidden.cases import Case
from socast.tools.bench.hidden.judge import is_answer_right, judge, main
from socast.tools.bench.hidden.running import draw_decoy, export_tasks
from socast.tools.simulator.settings import Hidden


@pytest.fixture(scope="module")
def folder(source, tmp_path_factory):
    out = tmp_path_factory.mktemp("hidden")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("socast.tools.bench.hidden.running.SeedData", lambda _: source)
        one = Case(5, (Hidden("headwind", 0.06),))
        hidden = Case(5, (Hidden("snow", 0.06),), "soc", without=("snow",))
        assert export_tasks([("one", [one]), ("outside", [hidden]), ("none", [Case(5)])], out, 1) == 3
    return out


def get_name(folder, part):
    """Return the name of the data set of a part."""
    truths = json.loads((folder / "truth.json").read_text())
    return next(name for name, truth in truths.items() if truth["part"] == part)


def read_table(folder, part, kind="windows"):
    """Return the windows or the truth of the data set of a part."""
    return pd.read_parquet(folder / kind / f"{get_name(folder, part)}.parquet")


def test_windows_hold_base_candidates_and_measured_energy(folder):
    table = read_table(folder, "one")
    truth = read_table(folder, "one", "truth")
    assert {"ride", "vehicle", "day", "measured_kwh", "predicted_kwh", "base_rolling", "effect_headwind"} <= set(table)
    assert list(truth) == ["hidden_headwind"]
    assert len(truth) == len(table) > 100
    assert truth["hidden_headwind"].abs().sum() / table["measured_kwh"].sum() == pytest.approx(0.06, rel=0.25)
    assert np.isfinite(table.filter(like="effect_")).all().all()


def test_files_do_not_tell_the_truth(folder):
    cases = json.loads((folder / "cases.json").read_text())
    assert sorted(cases) == ["00000", "00001", "00002"]
    assert all(set(case) == {"measurement", "weather", "recipe"} for case in cases.values())
    assert "effect_snow" not in read_table(folder, "outside")
    assert read_table(folder, "none", "truth").empty


def test_every_data_set_lacks_one_effect_of_the_library(folder):
    effects = {
        p: {c.partition("@")[0] for c in read_table(folder, p).filter(like="effect_")} for p in ("one", "outside")
    }
    assert effects["outside"] - effects["one"]
    assert "effect_headwind" in effects["one"]


def test_effect_that_is_left_out_is_random_and_never_a_hidden_one():
    library = SimpleNamespace(names=tuple(get_library()))
    drawn = [draw_decoy(Case(seed, (Hidden("humidity~other", 0.03),)), library) for seed in range(100)]
    assert len(set(drawn)) > 10
    assert not {name for names in drawn for name in names} & {"humidity", "demisting"}


def test_effect_can_be_found_from_the_files_alone(folder):
    table = read_table(folder, "one")
    base = table.filter(regex="^base_").to_numpy(np.float64)
    falls = {}
    for name in table.filter(regex="^effect_"):
        design = np.column_stack([base, table[name].to_numpy(np.float64)])
        design /= np.maximum(np.sqrt((design**2).sum(axis=0)), 1e-12)
        left = table["measured_kwh"] - design @ np.linalg.lstsq(design, table["measured_kwh"], rcond=1e-9)[0]
        falls[name] = -float(left @ left)
    assert max(falls, key=falls.get).startswith(("effect_headwind", "effect_crosswind_yaw"))


def test_card_names_every_column_and_how_to_be_judged(folder):
    card = (folder / "README.md").read_text()
    table = read_table(folder, "one")
    for name in table:
        assert f"`{name}`" in card or name.startswith(("base_", "effect_"))
    for name in table.filter(regex="^effect_"):
        assert f"| `{name.removeprefix('effect_').partition('@')[0]}` |" in card
    assert "socast.tools.bench.hidden.judge" in card
    assert "LICENSE" in card


def test_judge_counts_first_names(folder, tmp_path, capsys):
    truths = json.loads((folder / "truth.json").read_text())
    answers = {get_name(folder, "one"): ["headwind", "snow"], get_name(folder, "outside"): ["wet_road"]}
    scores = {score.what: (score.right, score.of) for score in judge(answers, truths)}
    assert scores["V·I, 1.5 % or more, visible: truth first"] == (1, 1)
    assert scores["truth not in the library: no effect first"] == (0, 1)
    assert scores["nothing hidden: no name"] == (1, 1)
    file = tmp_path / "answers.json"
    file.write_text(json.dumps(answers))
    assert main([str(folder), str(file)]) == 0
    assert "100.0 %" in capsys.readouterr().out
    file.write_text("[]")
    assert main([str(folder), str(file)]) == 2
    assert "not a JSON object" in capsys.readouterr().err


def test_two_effects_must_be_the_first_two():
    truth = {"truths": [["snow"], ["demisting", "humidity"]]}
    assert is_answer_right(["humidity", "snow"], truth)
    assert not is_answer_right(["snow", "age", "humidity"], truth)
    assert not is_answer_right([], truth)


@pytest.mark.parametrize("answers", [{"00009": ["snow"]}, {"00000": "snow"}])
def test_answers_that_belong_to_nothing_are_refused(answers):
    with pytest.raises(SettingsError):
        judge(answers, {"00000": {"part": "none", "truths": [["none"]], "absorbed": False}})
