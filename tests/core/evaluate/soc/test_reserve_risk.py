"""Test the reliability of stated risks and of alarms: planted outcomes are counted, and false risks are detected."""

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.evaluate.soc.baselines import BASELINES, compute_baselines
from socast.core.evaluate.soc.cases import select_cases
from socast.core.evaluate.soc.reserve_risk import (
    LEVELS,
    PLANNED,
    compute_reliability,
    compute_risk_below,
    evaluate_alarms,
    evaluate_reserve_risk,
    evaluate_risk,
    tabulate_levels,
)
from tests.support.soc_frames import make_frames

N = 20_000


def select_with_baselines(frames):
    """Return the cases of frames with the expectation of each baseline."""
    cases = select_cases(*frames).cases
    return pd.concat([cases, compute_baselines(cases, *frames)], axis=1)


def rows(risk, fell, baseline=np.nan):
    """Return rows with one case per shift, each in a separate cluster."""
    n = np.arange(len(risk))
    return pd.DataFrame({"risk": risk, "fell": fell, "shift": n, "cluster": n} | dict.fromkeys(BASELINES, baseline))


@pytest.fixture(scope="module")
def cases():
    return select_with_baselines(make_frames(cars=12, days=40))


@pytest.fixture(scope="module")
def evaluated(cases):
    return evaluate_reserve_risk(cases)


def test_alarm_counts_match_hand_calculation():
    risk = np.array([0.9, 0.04, 0.05, 0.0])
    fell = np.array([True, True, False, False])
    counted = evaluate_alarms(risk, fell, np.arange(4))
    assert (counted.caught, counted.missed, counted.false_alarms) == (1, 1, 1)
    assert counted.hit_rate.value == counted.false_alarm_rate.value == 0.5


def test_scores_match_hand_calculation():
    figures = evaluate_risk(rows(np.array([0.9, 0.0]), np.array([True, False]), 0.5))
    assert figures.brier == pytest.approx(0.1**2 / 2)
    assert figures.brier_base == 0.25
    assert figures.skill.value == pytest.approx(1.0 - 0.005 / 0.25)
    for baseline in figures.baselines.values():
        assert baseline.brier == 0.25
        assert baseline.forecast_brier == figures.brier
        assert baseline.forecast_alarms == figures.alarms


def test_cases_are_levels_not_yet_fallen_below(cases):
    table = tabulate_levels(cases)
    ahead = cases[cases["hours"] > 0]
    assert set(table["hours"]) == {1, 2, 4, 6}
    for level in LEVELS:
        mine = table[table["level"] == str(level)]
        above = ahead[ahead["soc_pct"] >= level]
        assert len(mine) == len(above)
        assert mine["fell"].sum() == (above["soc_end_pct"] < level).sum()
    assert (table["level"] == PLANNED).sum() == (ahead["soc_pct"] >= ahead["reserve_soc_pct"]).sum()


def test_temporary_fall_counts_unless_car_charged_later(cases):
    dipped = cases.assign(soc_pct=50.0, soc_end_pct=35.0, soc_lowest_pct=15.0)
    fell = tabulate_levels(dipped)[lambda table: table["level"].isin(["20", "30"])]["fell"]
    assert fell.all()
    assert not tabulate_levels(dipped.assign(charged_s=1.0))[lambda table: table["level"].isin(["20", "30"])][
        "fell"
    ].any()


def test_reliable_risk_lies_within_intervals_of_outcomes():
    rng = np.random.default_rng(4)
    risk = rng.beta(0.5, 0.5, N)
    classes = compute_reliability(rows(risk, rng.random(N) < risk))
    assert sum(figures.n for figures in classes) == N
    assert all(figures.low <= figures.told <= figures.high for figures in classes)
    holds = [figures.fell.low <= figures.told <= figures.fell.high for figures in classes]
    assert sum(holds) >= len(holds) - 1


def test_risk_of_half_the_true_size_lies_below_intervals_of_outcomes():
    rng = np.random.default_rng(4)
    risk = rng.uniform(0.02, 0.5, N)
    fell = rng.random(N) < 2.0 * risk
    for figures in compute_reliability(rows(risk, fell)):
        assert figures.fell.low > figures.told
    assert evaluate_risk(rows(risk, fell, 2.0 * risk)).baselines["linear"].skill.value < 0.0


def test_exact_forecasts_catch_all_cases_without_false_alarm():
    evaluated = evaluate_reserve_risk(select_with_baselines(make_frames(cars=8, days=20, sd_an_hour=1e-6)))
    assert set(evaluated.levels) == {PLANNED, *map(str, LEVELS)}
    for of in evaluated.levels.values():
        for figures in of.values():
            assert figures.alarms.caught == figures.fell
            assert figures.alarms.missed == figures.alarms.false_alarms == 0
            assert figures.brier == pytest.approx(0.0, abs=1e-9)
    assert evaluated.levels["30"]["4"].fell > 20


def test_calibrated_forecasts_are_reliable(evaluated):
    classes = [figures for figures in evaluated.reliability["levels"] if figures.n >= 100]
    holds = [figures.fell.low - 0.01 <= figures.told <= figures.fell.high + 0.01 for figures in classes]
    assert len(classes) >= 5
    assert sum(holds) >= len(holds) - 1
    for hours in ("1", "2"):
        figures = evaluated.overall[hours]
        assert figures.skill.value - figures.skill.ci95 > 0.4
    assert evaluated.overall["pooled"].n == sum(evaluated.overall[h].n for h in ("1", "2", "4", "6"))


def test_better_forecasts_have_positive_skill_relative_to_baselines():
    overall = evaluate_reserve_risk(select_with_baselines(make_frames(cars=12, days=40, sd_an_hour=0.2))).overall
    for hours in ("1", "2", "4"):
        for baseline in overall[hours].baselines.values():
            assert baseline.skill.value - baseline.skill.ci95 > 0.2
            assert baseline.forecast_alarms.false_alarms < baseline.alarms.false_alarms


def test_much_too_narrow_interval_reduces_skill(evaluated):
    narrow = evaluate_reserve_risk(select_with_baselines(make_frames(cars=12, days=40, narrow=0.2)))
    assert narrow.overall["4"].brier > evaluated.overall["4"].brier
    assert narrow.overall["4"].alarms.missed > evaluated.overall["4"].alarms.missed


PERCENT = st.floats(0.0, 100.0)


def interval(mean, below, above):
    return pd.DataFrame({"soc_mean_pct": [mean], "soc_p05_pct": [mean - below], "soc_p95_pct": [mean + above]})


@given(mean=PERCENT, below=st.floats(0.01, 30.0), above=st.floats(0.01, 30.0), levels=st.tuples(PERCENT, PERCENT))
def test_risk_follows_from_interval(mean, below, above, levels):
    cases = interval(mean, below, above)
    ends = [float(compute_risk_below(cases, level)[0]) for level in (mean - below, mean, mean + above)]
    assert ends == pytest.approx([0.05, 0.5, 0.95], abs=1e-6)
    low, high = (float(compute_risk_below(cases, level)[0]) for level in sorted(levels))
    assert 0.0 <= low <= high <= 1.0


def test_interval_of_zero_width_has_risk_zero_or_one():
    assert [float(compute_risk_below(interval(30.0, 0.0, 0.0), level)[0]) for level in (29.0, 31.0)] == [0.0, 1.0]
