"""`socast history` shows every attempt and the error after each step in the terminal, as JSON and as a page."""

import json
from io import StringIO
from typing import Any

import msgspec
import pytest
from rich.console import Console

from socast.core import models
from socast.core.diagnose.add.records import EffectTrial, list_attempts
from socast.core.models import BASIC_PHYSICAL, LinearModel
from socast.tools.report import history
from socast.tools.report.error_fall import draw_error_fall
from socast.tools.report.page import write_report
from tests.support.commands import done, refused
from tests.support.html_pages import read_page

HELPS = "it explains 10.0 % (95 % interval 8.0 % to 12.0 %) of the squared error on held-out days"


def attempt(effect: str, action: str, before: float, after: float, **more: Any) -> dict[str, Any]:
    """Return an entry of the history."""
    compared = {
        "rides": 100,
        "clusters": 30,
        "mae_before_kwh": before,
        "mae_after_kwh": after,
        "fall": 1 - after / before,
    }
    compared["change_kwh"] = {"value": after - before, "ci95": 0.01}
    coefficient = {"value": 1e-4, "ci95": [0.8e-4, 1.2e-4], "unit": "1/K", "low": 2e-5, "high": 3e-4, "plausible": True}
    return {
        "action": action, "effect": effect, "columns": [f"effect_{effect}"], **compared,
        "gain": {"value": 0.1, "ci95": 0.02}, "of_effect": compared, "on_days": compared, "on_vehicles": None,
        "final": {"dates": ["2018-05-01"], **compared}, "noise_floor_kwh": 0.2, "accepted": action == "add",
        "reason": HELPS if action == "add" else "it may be chance",
        "words": f"{effect} in words",
        "coefficient": coefficient, "by_vehicle_model": {},
    } | more  # fmt: skip


def read_trial(values: dict[str, Any]) -> EffectTrial:
    """Return a trial of JSON values."""
    return msgspec.convert(values, EffectTrial)


@pytest.fixture(scope="module")
def model() -> LinearModel:
    """A model to which two effects were added, and one was not."""
    tried = (
        {"action": "fit", "recipe": "road_load", "mae_in_sample_kwh": {"*": 0.4, "a": 0.35}},
        attempt("cold_rolling", "add", 0.42, 0.31),
        attempt("snow", "refused", 0.31, 0.36),
        attempt("headwind", "add", 0.31, 0.29, columns=["effect_headwind", "vehicle=taxi-003"], forced=True),
    )
    return msgspec.structs.replace(BASIC_PHYSICAL, name="mine", history=tried)


@pytest.fixture
def path(model, tmp_path):
    models.save(model, tmp_path / "mine.json")
    return tmp_path / "mine.json"


def printed(what, given) -> str:
    console = Console(width=120, file=StringIO(), color_system=None)
    what(given, console)
    return console.file.getvalue()


def test_history_shows_every_attempt_in_order(model):
    text = printed(history.show, model)
    parts = [
        "recipe road_load",
        "1. cold_rolling",
        "2. snow",
        "3. headwind",
        "cold_rolling in words",
        "snow was refused",
    ]
    assert [text.index(part) for part in parts] == sorted(text.index(part) for part in parts)
    row = next(line for line in text.splitlines() if line.strip().startswith("1. cold_rolling"))
    assert [word for word in row.split() if word[0].isdigit()] == [
        "1.",
        "0.4200",
        "0.3100",
        "0.0100",
        "0.2000",
        "0.4200",
        "0.3100",
    ]
    words = " ".join(text.split())
    assert "added although not accepted" in words
    assert "Added: cold_rolling, headwind (vehicle=taxi-003), 1 refused; error 0.4200 -> 0.29 kWh per ride" in words
    assert "measurement noise alone 0.2 kWh" in words


def test_history_of_fitted_model_has_no_attempts(model):
    bare = msgspec.structs.replace(model, history=model.history[:1])
    assert "No effect has been tried." in printed(history.show, bare)
    assert "No effect has been tried." in printed(history.show, BASIC_PHYSICAL)
    refusals = msgspec.structs.replace(model, history=model.history[2:3])
    assert "No effect was added, 1 refused; error 0.31 kWh" in " ".join(printed(history.show, refusals).split())


def test_history_figure_is_the_picture_of_the_falling_error(model):
    [one] = history.draw_errors(model)
    assert one.svg == draw_error_fall(list_attempts(model.history))


def test_command_prints_and_writes_history(path, capsys):
    html, file = path.with_suffix(".html"), path.with_name("result.json")
    done("history", path, "--html", html, "--json", file)
    assert "error 0.4200 -> 0.29 kWh" in " ".join(capsys.readouterr().out.split())
    written = json.loads(file.read_text())
    assert (written["mae_first_kwh"], written["mae_last_kwh"], written["noise_floor_kwh"]) == (0.42, 0.29, 0.2)
    assert [step["action"] for step in written["steps"]] == ["fit", "add", "refused", "add"]
    reader = read_page(html.read_text())
    assert not reader.loaded
    assert "figure-falling" in reader.ids
    assert {"step-1", "step-2", "step-3"} <= set(reader.ids)
    assert "it may be chance" in " ".join(reader.text)


def test_incomplete_history_is_tolerated(model, tmp_path):
    entry = attempt("snow", "add", 0.3, 0.2)
    for key in entry:
        for changed in ({**entry, key: None}, {k: v for k, v in entry.items() if k != key}):
            odd = msgspec.structs.replace(model, history=({"action": "fit"}, changed, {"effect": "?"}))
            printed(history.show, odd)
            write_report(history.build_report(odd), tmp_path / "page.html")


def test_errors_of_history_are_one_line(path, capsys):
    assert "cannot read a model" in refused(capsys, "history", path.with_name("no.json"))
    assert "is read and would be overwritten" in refused(capsys, "history", path, "--html", path)


def test_trial_shows_errors_before_and_after(model):
    entry = model.history[1]
    bins = [{"where": "below 2 km", **entry["of_effect"]}]
    trial = read_trial({**entry, "warnings": ["it is too large"], "conditions": {"distance": bins}})
    text = " ".join(printed(history.print_trial, trial).split())
    for part in ("held-out days, effect refitted", "final hold-out days", "By distance", "below 2 km", "−26.2 %",
                 "warning: it is too large", "cold_rolling helps: it explains 10.0 % (95 % interval 8.0 % to",
                 "12.0 %) of the squared error on held-out days."):  # fmt: skip
        assert part in text, part
    assert "snow does not help: it may be chance." in printed(history.print_trial, read_trial(model.history[2]))
    reason = (
        "it explains 0.3 % (95 % interval 0.1 % to 0.5 %) of the squared error on held-out days, which is below 0.5 %"
    )
    below = attempt("snow", "refused", 0.3, 0.3, gain={"value": 0.003, "ci95": 0.002}, reason=reason)
    ending = "(95 % interval 0.1 % to 0.5 %) of the squared error on held-out days, which is below 0.5 %."
    assert ending in " ".join(printed(history.print_trial, read_trial(below)).split())


def test_header_of_a_trial_and_of_a_history_breaks_no_word_at_80_columns(model):
    console = Console(width=80, file=StringIO(), color_system=None)
    history.print_trial(read_trial(attempt("cold_rolling", "add", 0.42, 0.31)), console)
    history.show(model, console)
    lines = [line.split() for line in console.file.getvalue().splitlines()]
    heads = [words for words in lines if set(words) & {"before,", "change,"} or words.count("kWh") > 1]
    assert heads == [
        ["vehicle-", "before,", "after,", "change,"],
        ["evaluated", "on", "rides", "days", "kWh", "kWh", "kWh", "change"],
        ["before,", "after,"],
        ["step", "result", "kWh", "kWh"],
        ["change,", "noise,", "final,"],
        ["step", "kWh", "kWh", "kWh"],
    ]
