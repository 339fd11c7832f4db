"""The gate of honesty: structure that no effect explains is noticed, and of none nothing is said."""

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from core.diagnose.candidates import library
from core.diagnose.evidence import Clusters
from core.diagnose.forward_selection import Named, Search
from core.diagnose.projection import Base, orthonormal
from core.diagnose.residual_structure import KNOWN, LEAST_TAKEN, Remains, Shapes, known, predicted, remains, uneven
from tests.support.drives import drives, measured, seen


def searched(tables, *effects: str) -> Search:
    """Return a search with those effects named."""
    windows, model = seen(tables)
    asked, clusters = library(windows, model), [Clusters(windows.day), Clusters(windows.date)]
    found = Search(Base(windows, model), asked, clusters, 0.002, 6, 0)
    found.named = [Named(asked, asked.variants.index(name), 0.0) for name in effects]
    return found


def looked(tables, *effects: str) -> Remains:
    """Return what is left with those effects named."""
    search = searched(tables, *effects)
    with threadpool_limits(1):
        return remains(search, search.findings())


def outside(shape: str) -> np.ndarray:
    """Return energy by a cause that is no effect of the library, some 6 % of all. [kWh]"""
    table = drives()
    rolling = (table["effect_rolling"] * table["rolling_resistance"]).to_numpy()
    hours = table["duration_s"].to_numpy() / 3600.0
    shapes = {
        "crowded": rolling * (table["occupants"].to_numpy() > 3.0),
        "low battery": hours * np.maximum(60.0 - table["soc_start_pct"].to_numpy(), 0.0),
        "gusty": table["effect_braking"].to_numpy() * table["wind_speed_kmh"].to_numpy(),
    }
    made = shapes[shape]
    return 0.06 * measured(table, noise=0.0)[1]["energy_kwh"].sum() / made.sum() * made


@pytest.mark.parametrize("shape", ["crowded", "low battery", "gusty"])
def test_a_planted_shape_outside_the_library_is_noticed(shape):
    found = looked(measured(drives(), unknown=outside(shape), of_day=0.01))
    assert found.there
    assert found.q < 0.01
    words = {"crowded": "occupants", "low battery": "soc_start_pct", "gusty": "wind_speed_kmh"}
    assert words[shape] in found.shape


def test_where_nothing_is_left_nothing_remains():
    """At a level of one in fifty, one of four data sets may pass."""
    found = [looked(measured(drives(3, 16, seed=seed), seed=seed)) for seed in range(4)]
    assert sum(each.there for each in found) <= 1
    assert np.median([each.after for each in found]) < 0.005


def test_structure_goes_with_the_effect_that_made_it():
    tables = measured(drives(), {"headwind": 0.0, "cold_rolling": 0.10}, of_day=0.01)
    before, after = looked(tables), looked(tables, "cold_rolling")
    assert before.there
    assert before.before > 0.02
    assert after.before == before.before
    assert not after.there
    assert after.taken > LEAST_TAKEN
    assert after.after < 0.2 * before.before


def test_a_wrong_effect_does_not_take_it():
    found = looked(measured(drives(), {"cold_rolling": 0.10}, of_day=0.01), "night_lights")
    assert found.there
    assert found.taken < 0.3


def test_trees_predict_what_depends_on_what_is_known_and_nothing_of_noise(rng):
    windows, _ = seen(measured(drives()))
    features, clusters = known(windows), Clusters(windows.day)
    assert features.shape == (len(windows.measured), len(KNOWN) + 1)
    noise = rng.normal(size=len(features))
    wave = np.sin(features[:, 1] / 8.0)
    share = np.var(wave) / (np.var(wave) + 1.0)
    with threadpool_limits(1):
        there, error = predicted(features, wave - wave.mean() + noise, clusters, 0)
        nothing, _ = predicted(features, noise, clusters, 0)
    assert 0.6 * share < there < 1.1 * share
    assert there > 3.0 * error
    assert nothing < 0.01


def test_the_shape_of_most_gain_is_off_the_model_and_what_is_named(rng):
    search = searched(measured(drives()))
    column = search.base.off(outside("crowded")[:, np.newaxis])
    nothing, named = np.empty((len(column), 0)), orthonormal(column)
    noise = rng.normal(size=len(column))
    shapes = Shapes(search)
    shape, q, gain = shapes.most(nothing, noise + 20.0 * named[:, 0])
    assert "occupants" in shape
    assert q < 1e-4
    assert 0.04 < gain < 400.0 / (400.0 + len(column)) + 0.05
    assert shapes.most(nothing, noise)[1] > 0.02
    assert shapes.most(named, noise + 20.0 * named[:, 0] - named[:, 0] * (named[:, 0] @ noise))[2] < 0.02


def test_days_that_differ_more_than_chance_has_it_are_noticed():
    """Whatever it was that some days had, and nothing that is known of them tells it."""
    even, odd = (searched(measured(drives(), of_day=of_day)) for of_day in (0.0, 0.10))
    assert uneven(even, even.base.residual) < 1.4
    assert uneven(odd, odd.base.residual) > 2.0
    assert looked(measured(drives(), of_day=0.10)).there


def test_shapes_are_for_people_and_as_long_as_each_other():
    found = looked(measured(drives(), unknown=outside("crowded")))
    units = dict(KNOWN)
    assert {"ambient_c", "occupants", "average_speed_kmh"} <= {each["feature"] for each in found.shapes}
    for each in found.shapes:
        assert each["unit"] == units[each["feature"]]
        assert len(each["x"]) == len(each["y_kwh"]) >= 2
        assert each["x"] == sorted(each["x"])
        assert np.isfinite(each["y_kwh"]).all()
    (crowd,) = (each for each in found.shapes if each["feature"] == "occupants")
    assert crowd["y_kwh"][-1] > max(crowd["y_kwh"][:-1]) > -0.01


def remaining(**changes) -> Remains:
    nothing = {"shape": "", "q": 1.0, "days": 1.0, "most_days": 1.5, "better": {}, "shapes": []}
    return Remains(**(dict.fromkeys(Remains._fields, 0.0) | nothing | changes))


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
        (False, {"q": 1e-6, "gain": 0.01, "named": 0.5}),
        (True, {"days": 1.6}),
        (True, {"named": 0.5, "better": {"cold_rolling": "rolling * occupants"}}),
    ],
)
def test_structure_remains_where_much_is_left_beyond_chance_or_a_name_is_in_doubt(there, changes):
    found = remaining(**changes)
    assert found.there is there
    assert 0.0 <= found.taken <= 1.0
