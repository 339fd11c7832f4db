"""Test that the reference of forecasts learns its factors, and that parts of the forecasts can be left out."""

import numpy as np
import pandas as pd
import pytest

from socast.core.forecast.learning.consumption_terms import make_prior
from socast.core.forecast.learning.plan_outcomes import PlanOutcomes
from socast.core.vehicles import load_catalogue
from socast.tools.bench.soc_ablation import PARTS, leave_out, measure
from socast.tools.bench.soc_reference import REFERENCE, compute_reference, make_terms

DAY = 86_400.0
CAPACITY = 40.0
FACTORS = np.array([1.3, 1.0, 0.7])


def make_frames(days, seed=1):
    """Return cases, forecasts and shifts of a car whose energies are those of the textbook times `FACTORS`."""
    rng, outlooks, shifts, cases = np.random.default_rng(seed), [], [], []
    for day in range(days):
        begin, hours, km = DAY * day + 36_000.0, 6.0, float(rng.uniform(60.0, 120.0))
        celsius, soc = float(rng.uniform(-15.0, 30.0)), 95.0
        drive = km / 22.0
        ahead = pd.DataFrame({"km": [km], "drive_h": [drive], "wait_h": [hours - drive], "ambient_c": [celsius]})
        used = float((make_terms(ahead) @ FACTORS)[0]) + 0.2 * rng.normal()
        key = {"vehicle_id": "a", "shift": day}
        now = {"soc_pct": soc, "ahead_km": km, "ambient_c": celsius, "planned": True}
        end = begin + 3600.0 * hours
        outlooks.append(key | {"time_s": begin, "shift_end_s": end} | now)
        last = soc - 100.0 * used / CAPACITY
        told = {"begin_s": begin, "end_s": end, "soc_end_pct": last, "charged_s": np.nan, "ride_km": km}
        shifts.append(key | told | {"capacity_kwh": CAPACITY, "vehicle_model": "m"})
        cases.append(key | {"time_s": begin})
    return pd.DataFrame(cases), pd.DataFrame(outlooks), pd.DataFrame(shifts)


def test_factors_of_the_textbook_are_learned():
    cases, outlooks, shifts = make_frames(60)
    result = compute_reference(cases, outlooks, shifts)
    off = (result[REFERENCE] - shifts["soc_end_pct"]).abs()
    assert off[40:].mean() < 0.4 * off[:5].mean()
    held = (result[f"{REFERENCE}_p05"] <= shifts["soc_end_pct"]) & (shifts["soc_end_pct"] <= result[f"{REFERENCE}_p95"])
    assert held[20:].mean() > 0.8


def test_nothing_to_forecast_gives_an_empty_table():
    cases, outlooks, shifts = make_frames(2)
    assert len(compute_reference(cases[:0], outlooks, shifts)) == 0


@pytest.mark.parametrize("part", PARTS)
def test_part_is_left_out_and_comes_back(part):
    before = make_prior, PlanOutcomes.apply_daily_update
    with leave_out(part):
        pass
    assert (make_prior, PlanOutcomes.apply_daily_update) == before
    with leave_out(""):
        outcomes = PlanOutcomes()
        outcomes.apply_daily_update()
    assert make_prior(load_catalogue()["nissan-leaf-2013"], 1.0).mean[0] > 0.0


def test_error_is_that_some_hours_ahead():
    cases = pd.DataFrame({"hours": [1, 2, 2], "soc_mean_pct": [0.0, 50.0, 40.0], "soc_end_pct": [90.0, 52.0, 36.0]})
    assert measure(cases) == 3.0
