"""What is asked: every effect of the library that the data hold and the model has not, at each of its values."""

from dataclasses import replace

import numpy as np
import pytest

from core import effects
from core.diagnose.candidates import LEAST_SHARE, LEAST_SHARE_IN_BENDS, build_candidates
from core.effects.road_load import ROAD_LOAD
from core.fit.fitting import fit_terms
from core.fit.recipes import ROAD_LOAD_TERMS, LinearRecipe
from core.fit.ride_blocks import RideFrame
from core.models import make_physical_term
from tests.support.synthetic_windows import gather_with_model, make_tables, make_windows


@pytest.fixture(scope="module")
def found():
    return gather_with_model(make_tables(make_windows(cars=2, days=8)))


def with_columns(windows, **columns):
    return replace(windows, table=windows.table.assign(**columns))


def test_every_library_effect_is_candidate_or_excluded(found):
    asked = build_candidates(*found)
    base = {effect.name for effect in ROAD_LOAD}
    assert set(asked.names) | set(asked.excluded) == set(effects.get_library()) - base
    assert not set(asked.names) & set(asked.excluded)
    assert {"cold_rolling", "headwind", "wet_road", "payload", "solar_load"} <= set(asked.names)
    assert asked.scope == ()


def test_candidate_columns_match_table(found):
    asked = build_candidates(*found)
    assert asked.columns.shape == (len(found[0].measured), len(asked.variants))
    for at, variant in enumerate(asked.variants):
        np.testing.assert_array_equal(asked.columns[:, at], found[0].table[f"effect_{variant}"])
        assert asked.names[asked.effects[at]] == effects.get(variant).base
        assert asked.sign[at] == effects.get(variant).sign
    cold = {variant for variant in asked.variants if variant.startswith("cold_rolling")}
    assert cold == {"cold_rolling", *(each.name for each in effects.get("cold_rolling").variants)}


def test_excluded_effects_are_no_candidates(found):
    asked = build_candidates(*found, without=("cold_rolling", "headwind"))
    assert not {"cold_rolling", "headwind"} & {*asked.names, *asked.excluded}
    assert not any(variant.startswith("cold_rolling") for variant in asked.variants)
    assert set(build_candidates(*found).names) - set(asked.names) == {"cold_rolling", "headwind"}


@pytest.mark.parametrize("variant", ["cold_rolling", "cold_rolling@reference=283.15"])
def test_effects_of_model_are_candidates_within_scopes_only(found, variant):
    windows = found[0]
    terms = (*ROAD_LOAD_TERMS, make_physical_term(variant, (f"effect_{variant}",)))
    model = fit_terms(LinearRecipe("more", "", terms), RideFrame(windows.table), covariance=False)
    everywhere, places = build_candidates(windows, model), build_candidates(windows, model, scopes=True)
    assert everywhere.excluded["cold_rolling"] == "in the model"
    assert "cold_rolling" not in everywhere.names
    assert "cold_rolling" in places.names
    assert "cold_rolling" not in places.excluded


def test_effects_that_are_hardly_known_or_never_act_are_not_in_data(found):
    windows, model = found
    n = len(windows.measured)
    mostly = np.where(np.arange(n) < 0.6 * n, np.nan, 1.0)
    table = windows.table.drop(columns="effect_payload")
    table = table.assign(effect_headwind=np.nan, effect_night_lights=0.0, effect_age=mostly)
    asked = build_candidates(replace(windows, table=table), model)
    assert {asked.excluded[name] for name in ("payload", "headwind", "night_lights", "age")} == {"not in the data"}
    assert np.isfinite(asked.columns).all()


def test_unknown_effect_values_count_as_zero(found):
    windows, model = found
    some = windows.table["effect_headwind"].where(np.arange(len(windows.table)) % 4 > 0)
    asked = build_candidates(with_columns(windows, effect_headwind=some), model)
    column = asked.columns[:, asked.variants.index("headwind")]
    np.testing.assert_array_equal(column, some.fillna(0.0))


def test_restricted_candidates_are_zero_outside_scope(found):
    asked = build_candidates(*found)
    here = found[0].vehicle == 1
    inside = asked.restrict_to(here, ("vehicle=taxi-1",))
    np.testing.assert_array_equal(inside.columns[here], asked.columns[here])
    assert not inside.columns[~here].any()
    assert inside.scope == ("vehicle=taxi-1",)
    assert (inside.variants, inside.names) == (asked.variants, asked.names)
    assert asked.columns[~here].any()


def test_least_coefficient_has_least_share_of_energy(found):
    asked = build_candidates(*found)
    for each, rows in (
        (asked, slice(None)),
        (asked.restrict_to(found[0].vehicle == 1, ("vehicle=taxi-1",)), found[0].vehicle == 1),
    ):
        taken = np.abs(each.columns * each.least_coefficients).sum(axis=0)
        share = np.where(np.array(each.variants) == "cornering", LEAST_SHARE_IN_BENDS, LEAST_SHARE)
        np.testing.assert_allclose(taken, share * found[0].measured[rows].sum())
    nothing = asked.restrict_to(np.zeros(len(found[0].measured), dtype=bool), ("vehicle=none",))
    assert np.isinf(nothing.least_coefficients).all()


def test_tables_without_effects_give_no_candidates(found):
    windows, model = found
    base = {effect.energy_name for effect in ROAD_LOAD}
    gone = [name for name in windows.table if name.startswith("effect_") and name not in base]
    asked = build_candidates(replace(windows, table=windows.table.drop(columns=gone)), model)
    assert asked.names == asked.variants == ()
    assert asked.columns.shape == (len(windows.measured), 0)
    assert set(asked.excluded.values()) == {"not in the data"}
