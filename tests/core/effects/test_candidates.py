"""Test the laws of every candidate effect: unit, source, sign, confusions and variants."""

import inspect
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from socast.core.columns import SIGNALS
from socast.core.effects import CANDIDATES, ROAD_LOAD, check_effect, get, get_library, group_by_topic, list_tabulated
from socast.core.effects.verification import ORDINARY_DRIVING
from socast.core.errors import EffectError

EACH = [effect for names in CANDIDATES.values() for effect in names]
ALL = pytest.mark.parametrize("each", EACH, ids=lambda e: e.name)


def rows(seed: int, count: int) -> dict[str, np.ndarray]:
    """Return random values of every signal within ordinary driving."""
    random = np.random.default_rng(seed)
    return {name: random.uniform(low, high, count) for name, (low, high) in ORDINARY_DRIVING.items()}


def test_library_has_road_load_first_then_candidates_by_topic():
    assert list(get_library())[: len(ROAD_LOAD) + len(EACH)] == [e.name for e in (*ROAD_LOAD, *EACH)]
    assert list(group_by_topic())[: 1 + len(CANDIDATES)] == ["road load", *CANDIDATES]
    assert [each.name for of_topic in group_by_topic().values() for each in of_topic] == list(get_library())


@ALL
def test_effect_passes_its_check(each):
    check_effect(each)


@ALL
def test_effect_is_documented(each):
    assert each.formula.startswith("P = ")
    assert len(each.source) > 20
    assert "estimate" in each.source or "range: " in each.source
    assert each.summary.endswith(".")
    assert each.shown_by
    assert "{value}" in each.words
    assert inspect.getdoc(each.function)


@ALL
def test_physics_demands_a_positive_coefficient(each):
    if each.name == "payload":  # passengers may be lighter than the 75 kg that are counted
        assert each.low < 0.0 < each.high
        return
    assert each.sign == 1
    assert 0.0 < each.low < each.high


@ALL
@given(seed=st.integers(0, 2**32), cuts=st.lists(st.integers(0, 50), max_size=6))
@settings(max_examples=10)
def test_power_of_a_row_does_not_depend_on_other_rows(each, seed, cuts):
    columns = rows(seed, 50)
    edges = [0, *sorted(cuts), 50]
    for variant in (each, *each.variants):
        whole = variant.power(columns)
        parts = [variant.power({n: c[a:b] for n, c in columns.items()}) for a, b in pairwise(edges)]
        assert np.concatenate(parts).tobytes() == whole.tobytes()


@pytest.mark.parametrize(("each", "argument"), [(e, a) for e in EACH for a in e.arguments if e.name != "standby"])
def test_unknown_argument_gives_nan_only_in_its_row(each, argument):
    columns = rows(7, 5)
    columns[argument][2] = np.nan
    assert np.isnan(each.power(columns)).tolist() == [False, False, True, False, False]


@ALL
def test_only_an_effect_per_time_takes_power_of_a_standing_car(each):
    still = dict.fromkeys(("speed", "traction", "wheel_power", "braking_force", "turn_rate"), np.zeros(200))
    assert each.power(rows(1, 200) | still).any() == (each.per == "time")


@ALL
def test_docstring_says_where_power_can_be_negative(each):
    if each.power(rows(3, 2000)).min() < 0.0:
        assert "negative" in each.documentation


@pytest.mark.parametrize(
    "name",
    [
        *("headwind", "crosswind_yaw", "air_density", "cold_rolling", "wet_road", "snow", "cornering", "cabin_heating"),
        *("cabin_cooling", "cabin_warmup", "solar_load", "humidity", "demisting", "payload", "age", "night_lights"),
        *("cold_battery_heating", "cold_regen_limit", "regen_full_battery"),
    ],
)
def test_effect_of_conditions_is_zero_in_mild_still_weather_by_day(name):
    mild = rows(5, 100)
    for column, value in {
        "ambient": 293.15, "pack_temperature": 298.15, "headwind": 0.0, "crosswind": 0.0, "air_density": 1.225,
        "water": 0.0, "snow": 0.0, "sun_sine": 0.5, "solar": 0.0, "charge": 0.5, "vapour_pressure": 1000.0,
        "turn_rate": 0.0, "odometer": 0.0, "occupants": 1.0, "parked": 0.0,
    }.items():  # fmt: skip
        mild[column] = np.full(100, value)
    assert not get(name).power(mild).any()


# Confusions


@pytest.mark.parametrize("each", get_library().values(), ids=lambda e: e.name)
def test_confusions_name_known_effects_and_are_mutual(each):
    for name in each.confused_with:
        assert name != each.name
        assert each.name in get(name).confused_with, name


def test_every_candidate_names_a_confusion():
    assert [each.name for each in EACH if not each.confused_with] == []


# Parameters and variants


@ALL
def test_grids_are_small_and_within_bounds(each):
    for name, parameter in each.parameters.items():
        low, high = parameter.bounds
        assert (low < high) or not parameter.grid, name
        if parameter.grid:
            assert 3 <= len(parameter.grid) <= 5
            assert low <= parameter.grid[0] < parameter.grid[-1] <= high


def test_variants_evaluate_the_function_at_other_values():
    columns = rows(11, 60)
    seen = 0
    for each in EACH:
        for variant in each.variants:
            (moved,) = [n for n in each.constants if variant.constants[n] != each.constants[n]]
            assert variant.name == f"{each.name}@{moved}={variant.constants[moved]:.10g}"
            assert np.array_equal(variant.power(columns), each.power(columns, {moved: variant.constants[moved]}))
            assert not np.array_equal(variant.power(columns), each.power(columns)), variant.name
            assert get(variant.name).constants == variant.constants
            assert (variant.base, variant.energy_name) == (each.name, f"effect_{variant.name}")
            seen += 1
    assert seen + len(get_library()) == len(list_tabulated()) == len(set(list_tabulated()))


def test_variant_with_any_values_within_bounds_has_a_unique_name():
    tuned = get("cabin_warmup@decay=450,soak=1800.5")
    assert (tuned.constants["decay"], tuned.constants["soak"]) == (450.0, 1800.5)
    assert get("cabin_warmup").variant({"soak": 1800.5, "decay": 450.0}).name == tuned.name
    assert tuned.variant({"soak": 3600.0}).name == "cabin_warmup@decay=450"
    assert tuned.variant({"soak": 3600.0, "decay": 600.0}).name == "cabin_warmup"
    assert get("cabin_warmup").variant({"decay": 600.0}) is get("cabin_warmup")
    assert get("wet_road").variant({"depth": 0.00005}).name == "wet_road@depth=0.00005"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("cold_rolling@reference=500", "parameter reference is 500 K, but must be from 268.15 to 303.15"),
        ("cold_rolling@reference=nan", "parameter reference is nan K, but must be from"),
        ("cold_rolling@refrence=283.15", "it has no parameter 'refrence'; it has reference"),
        ("cold_rolling@reference=warm", "'warm' is not a number: write cold_rolling@parameter=value"),
        ("cold_rolling@", "'' is not a number"),
        ("cold_rolling@reference=283.150", "is known as 'cold_rolling@reference=283.15': write that"),
        ("cold_rolling@reference=293.15", "is known as 'cold_rolling': write that"),
        ("cabin_warmup@soak=1800,decay=450", "is known as 'cabin_warmup@decay=450,soak=1800': write that"),
        ("tyre_pressure@x=1", "it has no parameter 'x'; it has none"),
        ("rolling@gravity=9", "parameter gravity is fixed at 9.80665"),
        ("cold_roling@reference=283.15", "did you mean cold_rolling"),
    ],
)
def test_invalid_variant_is_refused_in_one_line(name, message):
    with pytest.raises(EffectError) as caught:
        get(name)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_coefficient_is_described_in_words():
    cold = get("cold_rolling@reference=283.15")
    assert cold.in_words(1.1e-4, 2e-5) == (
        "cold tyres: rolling resistance grows by 1.1 ± 0.2 % of 0.010 for each degree below 10 °C"
    )
    assert get("standby").in_words(150.0) == "something takes 150 W all the time"
    assert get("auxiliary").in_words(150.0, 20.0) == "constant power 150 ± 20 W"
    assert get("auxiliary").in_words(150.0, 2e4) == "constant power: these data do not determine it"
    assert replace(get("rolling"), words="").in_words(0.0123) == "rolling resistance coefficient 0.012"


def test_no_candidate_reads_measured_energy():
    assert {column.name for column in SIGNALS} >= {"hvac", "current", "soc"}
    for each in EACH:
        assert not {"hvac", "current", "soc"} & set(each.arguments), each.name
