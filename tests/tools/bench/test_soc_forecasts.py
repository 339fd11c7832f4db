"""The harness judges a simulated fleet from its messages and measures each goal."""

import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from socast.core.evaluate.soc.records import ImpossibleBounds
from socast.core.wire.messages import Message
from socast.tools.bench import soc_forecasts, soc_goals
from socast.tools.bench.soc_forecasts import leave_out_plans, list_fleets, main
from socast.tools.bench.soc_goals import Judged
from socast.tools.simulator.conditions import ABSENT, Conditions, DisplayFault
from socast.tools.simulator.settings import get_fleet


@pytest.fixture
def _small(monkeypatch):
    """Make each fleet one of four cars, eight days and an hour, one of whose displays is absent."""

    def make(_, seed, __):
        conditions = Conditions(coulomb_display=True, display_faults=(DisplayFault(1, ABSENT, 2, 9),))
        return replace(get_fleet("small", seed), vehicles=4, days=8, shift_hours=1.1, conditions=conditions)

    monkeypatch.setattr(soc_forecasts, "make_simulation", make)


def make_judged(fleet, bias=0.0, width=8.0, n=400, change=0.0):
    """Return forecasts with a normal error of 2 %, beside a regression with one of 4 %."""
    rng = np.random.default_rng(1)
    day, became = np.arange(n) // 8, rng.uniform(20.0, 60.0, n)
    mean, theirs = became + bias + rng.normal(0.0, 2.0, n), became + rng.normal(0.0, 4.0, n)
    cases = pd.DataFrame(
        {
            "vehicle_id": "taxi-009", "shift": day, "begin_s": 86400.0 * (day + 10.0) + 30000.0, "end_s": 86400.0 * day,
            "time_s": 86400.0 * day, "hours": 2, "cluster": np.arange(n) // 2, "ambient_c": 5.0, "fault": "",
            "charged_s": np.nan, "soc_pct": 90.0, "soc_end_pct": became, "soc_lowest_pct": became,
            "soc_mean_pct": mean, "soc_p05_pct": mean - width / 2, "soc_p95_pct": mean + width / 2,
            "reserve_soc_pct": 10.0, "reserve_risk": 0.01, "regression": theirs, "regression_p05": theirs - 7.0,
            "regression_p95": theirs + 7.0, "reference": theirs, "linear": 0.0, "model_mean": 0.0, "rating": 0.0,
        }
    )  # fmt: skip
    forecasts = cases[["vehicle_id", "time_s", "soc_mean_pct", "soc_p05_pct", "soc_p95_pct"]].drop_duplicates("time_s")
    forecasts = forecasts.assign(soc_mean_pct=forecasts["soc_mean_pct"] + change)
    bounds = ImpossibleBounds(n=10, above=0, largest=0.0)
    return Judged(fleet, 1, 86400.0 * 10, cases, cases[:0], cases[:0], forecasts, bounds, 1.0)


def find(lines, text):
    """Return the first line whose subject begins with a text."""
    return next(line for line in lines if line.what.startswith(text))


def test_good_forecasts_meet_the_goals():
    lines = soc_goals.check_goals([make_judged("autumn", width=6.7)])
    assert find(lines, "2 h ahead: MAE against regression").verdict == "met"
    assert find(lines, "2 h ahead: MAE against best person").verdict == "met"
    assert find(lines, "2 h ahead: interval score").verdict == "met"
    assert find(lines, "2 h ahead: median width of").measured == "14.0"
    assert find(lines, "upper bound").verdict == "met"


def test_biased_forecasts_miss_the_cold_snap():
    lines = soc_goals.check_goals([make_judged("autumn", bias=20.0)])
    first = f"first day of the cold snap, {soc_goals.AHEAD} h ahead"
    assert find(lines, f"{first}: bias").verdict == "missed"
    assert find(lines, "2 h ahead: MAE against regression").verdict == "missed"


def test_recording_without_plans_is_judged_by_its_intervals_alone():
    """Without a plan no person and no regression knows what is ahead."""
    lines = soc_goals.check_goals([make_judged("leaf" + soc_goals.NO_PLANS)])
    assert find(lines, "0.5 to 6 h ahead: coverage").verdict == "met"
    assert not [line for line in lines if "against" in line.what]


def test_plans_are_left_out():
    keys = ["fleet/a/vehicle", "fleet/a/plan", "fleet/a/telemetry"]
    blocks = [[Message(key, b"{}", 0) for key in keys], []]
    assert [[m.key for m in block] for block in leave_out_plans(blocks)] == [[keys[0], keys[2]], []]


def test_change_of_healthy_cars_is_found():
    same = [make_judged("autumn-faults"), make_judged("autumn-short")]
    assert find(soc_goals.check_goals(same), "healthy cars").verdict == "met"
    other = [make_judged("autumn-faults", change=1.3), make_judged("autumn-short")]
    assert find(soc_goals.check_goals(other), "healthy cars").measured.startswith("at most 1.30")


def test_last_leg_before_a_charge_is_judged():
    one = make_judged("autumn-charges")
    legs = one.cases.assign(leg=0, minutes=45.0, charges=True, vehicle_id=one.cases["cluster"].astype(str))
    early = legs.assign(leg=-1, soc_end_pct=0.0)  # an earlier leg of the same query, which does not count
    lines = soc_goals.check_goals([replace(one, legs=pd.concat([early, legs], ignore_index=True))])
    assert find(lines, "last leg before a charge: MAE").verdict == "met"
    none = soc_goals.check_goals([replace(one, legs=legs.assign(charges=False))])
    assert find(none, "last leg before a charge: coverage").measured == "no forecast"


def test_forecasts_around_planned_charges_are_judged():
    one = make_judged("autumn-charges", width=6.7)
    cases = one.cases.assign(linear=0.0)
    lines = soc_goals.check_goals([replace(one, to_charge=cases, over_charge=cases)])
    for what in ("coverage", "MAE against regression", "MAE against best person"):
        assert find(lines, f"to the next charge, 2 h ahead: {what}").verdict == "met"
    assert find(lines, "end after a planned charge, 2 h ahead: coverage").verdict == "met"
    assert find(lines, "end after a planned charge, 2 h ahead: MAE against a person").verdict == "met"
    assert find(soc_goals.check_goals([one]), "to the next charge: coverage").measured == "no forecast"


def test_parts_name_fleets():
    assert list_fleets("small,preset") == ["small", "preset"]
    assert len(list_fleets("all")) == len(set(list_fleets("all"))) == 12


@pytest.mark.usefixtures("_small")
def test_harness_judges_messages_and_keeps_them(tmp_path, capsys):
    arguments = ["--fleet", "autumn-faults", "--seeds", "3"]
    main([*arguments, "--keep", str(tmp_path / "kept"), "--json", str(tmp_path / "once.json")])
    assert "absent SOC: coverage" in capsys.readouterr().out
    assert {path.name for path in (tmp_path / "kept").iterdir()} == {
        "autumn-faults-3.mcap",
        "autumn-faults-3.displays.json",
    }
    main([*arguments, "--json", str(tmp_path / "streamed.json")])
    once, streamed = (json.loads((tmp_path / f"{name}.json").read_text()) for name in ("once", "streamed"))
    assert once == streamed
