"""Test candidates: every effect of the library that is in the data and not in the model, with each of its variants."""

from dataclasses import replace

import numpy as np
import pytest

from socast.core import effects
from socast.core.diagnose.candidates import NEVER_ACTS, NO_COLUMN, NO_SIGNAL, build_candidates
from socast.core.effects import ROAD_LOAD
from socast.core.fit.fitting import fit_terms
from socast.core.fit.recipes import ROAD_LOAD_TERMS, LinearRecipe
from socast.core.fit.ride_blocks import RideFrame
from socast.core.models import make_physical_term
from tests.support.synthetic_windows import gather_with_model, make_tables, make_windows


@pytest.fixture(scope="module")
def diagnosed():
    return gather_with_model(make_tables(make_windows(cars=2, days=8)))


def with_columns(windows, **columns):
    return replace(windows, table=windows.table.assign(**columns))


def test_every_library_effect_is_candidate_or_excluded(diagnosed):
    candidates = build_candidates(*diagnosed)
    base = {effect.name for effect in ROAD_LOAD}
    assert set(candidates.names) | set(candidates.excluded) == set(effects.get_library()) - base
    assert not set(candidates.names) & set(candidates.excluded)
    assert {"cold_rolling", "headwind", "wet_road", "payload", "solar_load"} <= set(candidates.names)


def test_candidate_columns_match_table(diagnosed):
    candidates = build_candidates(*diagnosed)
    assert candidates.columns.shape == (len(diagnosed[0].measured), len(candidates.variants))
    for at, variant in enumerate(candidates.variants):
        np.testing.assert_array_equal(candidates.columns[:, at], diagnosed[0].table[f"effect_{variant}"])
        assert candidates.names[candidates.effects[at]] == effects.get(variant).base
        assert candidates.sign[at] == effects.get(variant).sign
    cold = {variant for variant in candidates.variants if variant.startswith("cold_rolling")}
    assert cold == {"cold_rolling", *(each.name for each in effects.get("cold_rolling").variants)}


def test_excluded_effects_are_no_candidates(diagnosed):
    candidates = build_candidates(*diagnosed, without=("cold_rolling", "headwind"))
    assert not {"cold_rolling", "headwind"} & {*candidates.names, *candidates.excluded}
    assert not any(variant.startswith("cold_rolling") for variant in candidates.variants)
    assert set(build_candidates(*diagnosed).names) - set(candidates.names) == {"cold_rolling", "headwind"}


@pytest.mark.parametrize("variant", ["cold_rolling", "cold_rolling@reference=283.15"])
def test_effects_of_model_are_no_candidates(diagnosed, variant):
    windows = diagnosed[0]
    terms = (*ROAD_LOAD_TERMS, make_physical_term(variant, (f"effect_{variant}",)))
    model = fit_terms(LinearRecipe("more", "", terms), RideFrame(windows.table), covariance=False)
    candidates = build_candidates(windows, model)
    assert candidates.excluded["cold_rolling"] == "in the model"
    assert "cold_rolling" not in candidates.names


def test_effects_without_column_signal_or_energy_are_excluded_for_this_reason(diagnosed):
    windows, model = diagnosed
    n = len(windows.measured)
    mostly = np.where(np.arange(n) < 0.6 * n, np.nan, 1.0)
    table = windows.table.drop(columns="effect_payload")
    table = table.assign(effect_headwind=np.nan, effect_age=mostly)
    table = table.assign(**{name: 0.0 for name in table if name.startswith("effect_night_lights")})
    candidates = build_candidates(replace(windows, table=table), model)
    assert candidates.excluded["payload"] == NO_COLUMN
    assert candidates.excluded["headwind"] == candidates.excluded["age"] == NO_SIGNAL
    assert candidates.excluded["night_lights"] == NEVER_ACTS
    assert np.isfinite(candidates.columns).all()


def test_unknown_effect_values_count_as_zero(diagnosed):
    windows, model = diagnosed
    some = windows.table["effect_headwind"].where(np.arange(len(windows.table)) % 4 > 0)
    candidates = build_candidates(with_columns(windows, effect_headwind=some), model)
    column = candidates.columns[:, candidates.variants.index("headwind")]
    np.testing.assert_array_equal(column, some.fillna(0.0))


def test_tables_without_effects_give_no_candidates(diagnosed):
    windows, model = diagnosed
    base = {effect.energy_name for effect in ROAD_LOAD}
    gone = [name for name in windows.table if name.startswith("effect_") and name not in base]
    candidates = build_candidates(replace(windows, table=windows.table.drop(columns=gone)), model)
    assert candidates.names == candidates.variants == ()
    assert candidates.columns.shape == (len(windows.measured), 0)
    assert set(candidates.excluded.values()) == {NO_COLUMN}
