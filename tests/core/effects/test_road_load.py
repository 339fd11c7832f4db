"""Test the unit, the closed form and the source of every effect of the road load."""

import inspect
import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from socast.core.columns import GRAVITY
from socast.core.effects import ROAD_LOAD, check_effect, get, get_library
from socast.core.effects.road_load import STANDARD_AIR_DENSITY
from socast.core.effects.verification import ORDINARY_DRIVING
from socast.core.vehicles import ACCESSORIES

ALL = pytest.mark.parametrize("each", ROAD_LOAD, ids=lambda e: e.name)


def rows(seed: int, count: int) -> dict[str, np.ndarray]:
    """Return random values of every signal within ordinary driving."""
    random = np.random.default_rng(seed)
    return {name: random.uniform(low, high, count) for name, (low, high) in ORDINARY_DRIVING.items()}


def power(name: str, **columns: float) -> float:
    """Return the power of an effect for one row."""
    return float(get(name).power({n: np.array([value]) for n, value in columns.items()})[0])


# Laws of every effect


@ALL
def test_effect_passes_its_check(each):
    check_effect(each)


@ALL
def test_effect_is_documented_with_a_source(each):
    assert each.formula.startswith("P = ")
    assert len(each.source) > 20
    assert each.summary.endswith(".") or each.formula in each.summary
    assert inspect.getdoc(each.function)
    assert each.energy_name == f"effect_{each.name}"


@ALL
@given(seed=st.integers(0, 2**32), cuts=st.lists(st.integers(0, 50), max_size=6))
@settings(max_examples=20)
def test_power_of_a_row_does_not_depend_on_other_rows(each, seed, cuts):
    columns = rows(seed, 50)
    whole = each.power(columns)
    edges = [0, *sorted(cuts), 50]
    parts = [each.power({n: c[a:b] for n, c in columns.items()}) for a, b in pairwise(edges)]
    assert np.concatenate(parts).tobytes() == whole.tobytes()


@pytest.mark.parametrize(
    ("each", "argument"), [(e, a) for e in ROAD_LOAD for a in e.arguments if e.name != "auxiliary"]
)
def test_unknown_argument_gives_nan_only_in_its_row(each, argument):
    columns = rows(7, 5)
    columns[argument][2] = np.nan
    assert np.isnan(each.power(columns)).tolist() == [False, False, True, False, False]


def test_library_starts_with_the_road_load_and_is_read_only():
    assert list(get_library())[: len(ROAD_LOAD)] == [e.name for e in ROAD_LOAD]
    with pytest.raises(TypeError):
        get_library()["rolling"] = None


# Closed forms


@given(st.floats(500, 3000), st.floats(-0.3, 0.3), st.floats(0, 36))
def test_rolling_and_climbing_follow_the_components_of_the_weight(mass, grade, speed):
    angle = np.arcsin(grade)
    assert power("rolling", mass=mass, grade=grade, speed=speed) == pytest.approx(
        mass * GRAVITY * np.cos(angle) * speed
    )
    climbing = power("climbing", mass=mass, grade=grade, speed=speed)
    assert climbing == pytest.approx(mass * GRAVITY * np.sin(angle) * speed, abs=1e-9)
    up, down = (power(f"climbing_{way}", mass=mass, grade=grade, speed=speed) for way in ("up", "down"))
    assert (up + down, up * down) == (climbing, 0.0)
    assert up >= 0.0 >= down


@given(st.floats(0, 36), st.floats(-20, 20), st.floats(0.9, 1.5))
def test_drag_is_half_rho_times_relative_wind_squared(speed, headwind, density):
    assert power("aero_drag", speed=speed) == pytest.approx(0.5 * STANDARD_AIR_DENSITY * speed**3)
    relative = speed + headwind
    expected = np.sign(relative) * 0.5 * density * relative**2 * speed
    assert power("aero_drag_wind", speed=speed, headwind=headwind, air_density=density) == pytest.approx(expected)


@given(st.floats(0, 36))
def test_drag_in_still_standard_air_is_the_same_with_and_without_wind(speed):
    still = power("aero_drag_wind", speed=speed, headwind=0.0, air_density=STANDARD_AIR_DENSITY)
    assert still == pytest.approx(power("aero_drag", speed=speed), rel=1e-12)


@given(st.lists(st.floats(0, 36), min_size=2, max_size=60), st.floats(500, 3000), st.floats(0.5, 10))
def test_inertia_sums_to_the_change_of_kinetic_energy(speeds, mass, dt):
    v = np.array(speeds)
    columns = {
        "mass": np.full(len(v) - 1, mass),
        "speed": (v[1:] + v[:-1]) / 2,
        "acceleration": np.diff(v) / dt,
    }
    energy = {n: float(np.sum(get(n).power(columns) * dt)) for n in ("inertia", "inertia_positive", "inertia_negative")}
    scale = 1e-9 * mass * 36**2 * len(v)
    assert energy["inertia"] == pytest.approx(mass * (v[-1] ** 2 - v[0] ** 2) / 2, abs=scale)
    assert energy["inertia_positive"] + energy["inertia_negative"] == pytest.approx(energy["inertia"], abs=scale)
    assert energy["inertia_positive"] >= 0.0 >= energy["inertia_negative"]


@given(
    st.lists(st.tuples(st.floats(-0.3, 0.3), st.floats(1, 36)), min_size=1, max_size=40),
    st.floats(0.8, 1.8),
    st.floats(0, 1.0),
)
def test_round_trip_over_hills_never_costs_less_than_the_level_road(profile, paid, regained):
    """Drive equal map distances at equal speeds there and back; climbing costs at least what descending returns."""
    paid = max(paid, regained)
    grade, speed = (np.array(column) for column in zip(*profile, strict=True))
    grade, speed = np.r_[grade, -grade[::-1]], np.r_[speed, speed[::-1]]
    columns = {"mass": np.full(len(grade), 1600.0), "speed": speed}
    coefficients = {"rolling": 0.01, "aero_drag": 0.7, "climbing_up": paid, "climbing_down": regained}

    def cost(grades: np.ndarray) -> float:
        time = 100.0 / np.sqrt(1.0 - grades**2) / speed  # each step is 100 m on the map
        terms = (c * np.sum(get(n).power({**columns, "grade": grades}) * time) for n, c in coefficients.items())
        return float(sum(terms))

    level = cost(np.zeros(len(grade)))
    assert cost(grade) >= level * (1 - 1e-9)
    if np.ptp(grade) > 0.01 and paid > regained + 0.01:
        assert cost(grade) > level


@given(st.floats(233, 318), st.floats(0, 2))
def test_accessory_power_is_the_curve_times_the_scale_of_the_car(ambient, scale):
    expected = scale * ACCESSORIES.power(np.array([ambient]))[0]
    assert power("accessories", ambient=ambient, accessory_scale=scale) == expected


def test_parameters_can_be_changed_for_one_call():
    columns = {"ambient": np.array([200.0]), "accessory_scale": np.array([1.0])}
    assert get("accessories").power(columns, {"heating": 5000.0}).tolist() == [5000.0]
    assert get("accessories").power(columns).tolist() == [ACCESSORIES.heating]


def test_effects_act_per_time_or_per_distance():
    assert {e.name for e in ROAD_LOAD if e.per == "time"} == {"accessories", "auxiliary"}
    assert power("auxiliary", dt=3.0) == 1.0
    standing = {**rows(1, 4), "speed": np.zeros(4)}
    for each in ROAD_LOAD:
        if each.per == "distance":
            assert not each.power(standing).any(), each.name


def test_text_of_braking_is_for_users():
    braking = get("braking")
    assert "core." not in braking.documentation
    assert "share" not in braking.coefficient  # it may exceed 1


def test_expectation_of_braking_follows_from_the_figures_of_its_source():
    """Fiori et al. 2016: driveline 0.92, motor 0.91, and brakes that regain exp(-0.0411 / d) at a deceleration d."""
    efficiency = 0.92 * 0.91
    lost = 1.0 / efficiency - efficiency * math.exp(-0.0411 / 0.7)
    assert get("braking").expected.mean == pytest.approx(lost, abs=0.01)


def test_braking_is_the_power_of_the_braking_force():
    force, speed = np.array([500.0, 0.0]), np.full(2, 20.0)
    assert get("braking").power({"braking_force": force, "speed": speed}).tolist() == [1e4, 0.0]


@given(st.floats(0.7, 0.95), st.floats(0.0, 0.9), st.integers(0, 1000))
def test_road_load_with_braking_is_that_of_a_powertrain_that_loses_both_ways(forth, back, seed):
    """All effects cost 1/forth at every sign, and braking the difference to what it gives back."""
    columns = rows(seed, 20)
    parts = ("rolling", "climbing", "aero_drag", "inertia_positive", "inertia_negative")
    shares = {"rolling": 0.008, "aero_drag": 0.7}
    wheel = sum(shares.get(name, 1.0) * get(name).power(columns) for name in parts)
    columns["braking_force"] = np.maximum(-wheel / columns["speed"], 0.0)
    found = wheel / forth + (1.0 / forth - back) * get("braking").power(columns)
    np.testing.assert_allclose(found, np.maximum(wheel, 0.0) / forth + np.minimum(wheel, 0.0) * back, atol=1e-6)


def test_priors_of_the_road_load_agree_on_the_efficiency_of_the_powertrain():
    """With 0.84 both ways, speeding up and slowing cost the same, and braking at most what only friction brakes do."""
    forth, slowing, braking = (get(name) for name in ("inertia_positive", "inertia_negative", "braking"))
    assert slowing.expected.mean == forth.expected.mean
    assert slowing.high == forth.high
    for car in (0.75, 0.84, 0.95):
        assert abs(1.0 / car - forth.expected.mean) < 2.0 * slowing.expected.sd
        assert braking.low <= 1.0 / car - car < 1.0 / car < braking.high
