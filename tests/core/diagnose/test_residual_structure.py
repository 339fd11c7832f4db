"""Test residual structure: structure that no effect explains is detected, and noise has none."""

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from socast.core.diagnose.projection import orthonormalise
from socast.core.diagnose.residual_structure import (
    FEATURES,
    LEAST_TAKEN,
    PlainShapes,
    ResidualStructure,
    collect_features,
    compute_day_variance_ratio,
    compute_predictable_share,
    measure_residual_structure,
)
from socast.core.stats.evidence import ClusterSums
from tests.support.selections import select_effects
from tests.support.synthetic_windows import gather_with_model, make_tables, make_windows


def measure_with_selected(tables, *effects: str) -> ResidualStructure:
    """Return the residual structure with the given effects selected."""
    with threadpool_limits(1):
        return measure_residual_structure(select_effects(tables, *effects))


def outside(shape: str) -> np.ndarray:
    """Return the energy of a cause outside the library, about 6 % of the total. [kWh]"""
    table = make_windows()
    rolling = (table["effect_rolling"] * table["rolling_resistance"]).to_numpy()
    hours = table["duration_s"].to_numpy() / 3600.0
    shapes = {
        "crowded": rolling * (table["occupants"].to_numpy() > 3.0),
        "low battery": hours * np.maximum(60.0 - table["soc_start_pct"].to_numpy(), 0.0),
        "gusty": table["effect_braking"].to_numpy() * table["wind_speed_kmh"].to_numpy(),
    }
    made = shapes[shape]
    return 0.06 * make_tables(table, noise=0.0)[1]["energy_kwh"].sum() / made.sum() * made


@pytest.mark.parametrize("shape", ["crowded", "low battery", "gusty"])
def test_planted_shape_outside_library_is_detected(shape):
    structure = measure_with_selected(make_tables(make_windows(), unknown=outside(shape), of_day=0.01))
    assert structure.exists
    assert structure.q < 0.01
    words = {"crowded": "occupants", "low battery": "soc_start_pct", "gusty": "wind_speed_kmh"}
    assert words[shape] in structure.shape


def test_no_structure_without_unknown_cause():
    """One of four data sets may exceed a level of one in fifty."""
    structures = [measure_with_selected(make_tables(make_windows(3, 16, seed=seed), seed=seed)) for seed in range(4)]
    assert sum(each.exists for each in structures) <= 1
    assert np.median([each.after for each in structures]) < 0.005


def test_structure_disappears_with_its_effect():
    tables = make_tables(make_windows(), {"headwind": 0.0, "cold_rolling": 0.10}, of_day=0.01)
    before, after = measure_with_selected(tables), measure_with_selected(tables, "cold_rolling")
    assert before.exists
    assert min(before.before, after.before) > 0.02  # the weights of windows differ
    assert not after.exists
    assert after.taken > LEAST_TAKEN
    assert after.after < 0.2 * after.before


def test_wrong_effect_does_not_explain_structure():
    structure = measure_with_selected(make_tables(make_windows(), {"cold_rolling": 0.10}, of_day=0.01), "night_lights")
    assert structure.exists
    assert structure.taken < 0.3


def test_trees_predict_feature_dependence_but_not_noise(rng):
    windows, _ = gather_with_model(make_tables(make_windows()))
    features, clusters = collect_features(windows), ClusterSums(windows.day)
    assert features.shape == (len(windows.measured), len(FEATURES) + 1)
    noise = rng.normal(size=len(features))
    wave = np.sin(features[:, 1] / 8.0)
    share = np.var(wave) / (np.var(wave) + 1.0)
    with threadpool_limits(1):
        there = compute_predictable_share(features, wave - wave.mean() + noise, clusters, 0)
        nothing = compute_predictable_share(features, noise, clusters, 0)
    assert 0.6 * share < there.value < 1.1 * share
    assert there.value > 3.0 * there.error
    assert nothing.value < 0.01


def test_strongest_shape_is_off_model_and_selected_effects(rng):
    search = select_effects(make_tables(make_windows()))
    column = search.base.project_out(outside("crowded")[:, np.newaxis])
    nothing, named = np.empty((len(column), 0)), orthonormalise(column)
    noise = rng.normal(size=len(column))
    shapes = PlainShapes(search)
    shape, q, gain = shapes.find_strongest(nothing, noise + 20.0 * named[:, 0])
    assert "occupants" in shape
    assert q < 1e-4
    assert 0.04 < gain.value < 400.0 / (400.0 + len(column)) + 0.05
    assert shapes.find_strongest(nothing, noise)[1] > 0.02
    assert (
        shapes.find_strongest(named, noise + 20.0 * named[:, 0] - named[:, 0] * (named[:, 0] @ noise))[2].value < 0.02
    )


def test_excess_variance_between_days_is_detected():
    """The cause of the difference between days is unknown, and no known property of the days predicts it."""
    even, odd = (select_effects(make_tables(make_windows(), of_day=of_day)) for of_day in (0.0, 0.10))
    assert compute_day_variance_ratio(even, even.base.residual) < 1.4
    assert compute_day_variance_ratio(odd, odd.base.residual) > 2.0
    assert measure_with_selected(make_tables(make_windows(), of_day=0.10)).exists


def remaining(**changes) -> ResidualStructure:
    nothing = {"shape": "", "q": 1.0, "days": 1.0, "most_days": 1.5, "better": {}}
    return ResidualStructure(**(dict.fromkeys(ResidualStructure._fields, 0.0) | nothing | changes))


@pytest.mark.parametrize(
    ("there", "changes"),
    [
        (False, {}),
        (True, {"before": 0.5, "after": 0.4, "error": 0.01}),
        (False, {"before": 0.5, "after": 0.4, "error": 0.4}),
        (False, {"before": 0.5, "after": 0.001, "error": 0.0001}),
        (False, {"before": 0.5, "after": 0.05, "error": 0.001}),
        (False, {"before": 0.5, "after": -0.1, "error": 0.01}),
        (True, {"q": 1e-6, "gain": 0.05}),
        (False, {"q": 0.5, "gain": 0.05}),
        (False, {"q": 1e-6, "gain": 0.0001}),
        (False, {"q": 1e-6, "gain": 0.05, "gain_error": 0.03}),
        (False, {"q": 1e-6, "gain": 0.01, "explained": 0.5}),
        (True, {"days": 1.6}),
        (True, {"explained": 0.5, "better": {"cold_rolling": "rolling * occupants"}}),
    ],
)
def test_structure_exists_if_any_sign_is_significant(there, changes):
    structure = remaining(**changes)
    assert structure.exists is there
    assert 0.0 <= structure.taken <= 1.0
