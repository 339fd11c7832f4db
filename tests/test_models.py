"""The physical models are the paper's equations; prediction is row by row; model files are exact round trips."""

import json
from itertools import pairwise

import msgspec
import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from core import effects
from core.columns import GRAVITY, JOULES_PER_KWH, ZERO_CELSIUS
from core.errors import ModelError
from core.models import (
    ANY,
    BASIC_PHYSICAL,
    EXTENDED_PHYSICAL,
    FORMAT,
    KNOWN,
    Curve,
    Fit,
    LinearModel,
    Term,
    Training,
    decode,
    encode,
    load,
    save,
)
from core.road_load import STANDARD_AIR_DENSITY
from core.trees import Trees
from core.vehicles import ACCESSORIES, catalogue

LEAF = catalogue()["nissan-leaf-2013"]


def steps(seed: int, rows: int) -> dict[str, np.ndarray]:
    """Signals of a drive, step by step."""
    random = np.random.default_rng(seed)
    return {
        "dt": np.full(rows, 3.0),
        "speed": random.uniform(0.0, 36.0, rows),
        "acceleration": random.uniform(-2.0, 2.0, rows),
        "grade": random.uniform(-0.1, 0.1, rows),
        "ambient": random.uniform(245.0, 310.0, rows),
        "mass": np.full(rows, LEAF.mass_kg + 75.0),
        "accessory_scale": np.full(rows, 1.0),
    }


def ride_columns(model, signals) -> dict[str, np.ndarray]:
    """The columns that a model needs, of one step each."""
    columns = {
        "rolling_resistance": np.full(len(signals["dt"]), LEAF.rolling_resistance),
        "drag_area_m2": np.full(len(signals["dt"]), LEAF.drag_area_m2),
    }
    for name in model.effects:
        effect = effects.get(name)
        columns[effect.energy_name] = effect.power(signals) * signals["dt"] / JOULES_PER_KWH
    return columns


def equation_1(signals) -> np.ndarray:
    """Equation (1) as the paper prints it: v in km/h, d in km, E in kWh."""
    m, a = signals["mass"], signals["acceleration"]
    theta = np.arcsin(signals["grade"])
    f, rho, cx, area, g = (
        LEAF.rolling_resistance,
        STANDARD_AIR_DENSITY,
        LEAF.drag_coefficient,
        LEAF.frontal_area_m2,
        GRAVITY,
    )
    v = signals["speed"] * 3.6
    d = signals["speed"] * signals["dt"] / 1000
    return (
        (1 / 3600)
        * (m * g * (f * np.cos(theta) + np.sin(theta)) + 0.5 * (rho * cx * area * (v / 3.6) ** 2) + m * a)
        * d
    )


@given(st.integers(0, 2**32))
def test_basic_physical_is_equation_1(seed):
    signals = steps(seed, 50)
    predicted = BASIC_PHYSICAL.predict(ride_columns(BASIC_PHYSICAL, signals))
    np.testing.assert_allclose(predicted, equation_1(signals), rtol=1e-11, atol=1e-15)


@given(st.integers(0, 2**32))
def test_extended_physical_adds_the_accessories(seed):
    signals = steps(seed, 50)
    predicted = EXTENDED_PHYSICAL.predict(ride_columns(EXTENDED_PHYSICAL, signals))
    accessories = ACCESSORIES.power(signals["ambient"]) * 3.0 / JOULES_PER_KWH
    np.testing.assert_allclose(predicted, equation_1(signals) + accessories, rtol=1e-11, atol=1e-15)


def test_a_kilometre_at_50_kmh_in_a_leaf_by_hand():
    speed = 50 / 3.6
    signals = {
        "dt": np.array([1000 / speed]),
        "speed": np.array([speed]),
        "acceleration": np.zeros(1),
        "grade": np.zeros(1),
        "ambient": np.array([ZERO_CELSIUS + 15]),
        "mass": np.array([1600.0]),
        "accessory_scale": np.ones(1),
    }
    columns = ride_columns(EXTENDED_PHYSICAL, signals)
    # 1600 kg * 9.80665 * 0.008 = 125.5 N; 0.5 * 1.225 * 0.72 * 13.89^2 = 85.1 N; 210.6 N km / 3600 = 0.0585 kWh
    assert BASIC_PHYSICAL.predict(columns)[0] == pytest.approx(0.0585, abs=5e-5)
    # and 300 W for 72 s = 0.006 kWh
    assert EXTENDED_PHYSICAL.predict(columns)[0] == pytest.approx(0.0645, abs=5e-5)


def test_needs_and_effects_of_the_physical_models():
    assert BASIC_PHYSICAL.effects == ("rolling", "climbing", "aero_drag", "inertia")
    assert EXTENDED_PHYSICAL.effects == (*BASIC_PHYSICAL.effects, "accessories")
    assert set(BASIC_PHYSICAL.needs) == {f"effect_{e}" for e in BASIC_PHYSICAL.effects} | {
        "rolling_resistance",
        "drag_area_m2",
    }


@given(st.integers(0, 2**32), st.lists(st.integers(0, 40), max_size=6))
def test_prediction_is_the_same_to_the_bit_however_rows_are_cut(seed, cuts):
    columns = ride_columns(EXTENDED_PHYSICAL, steps(seed, 40))
    whole = EXTENDED_PHYSICAL.predict(columns)
    edges = [0, *sorted(cuts), 40]
    parts = [EXTENDED_PHYSICAL.predict({n: c[a:b] for n, c in columns.items()}) for a, b in pairwise(edges)]
    assert np.concatenate(parts).tobytes() == whole.tobytes()


def test_prediction_learns_nothing_and_changes_nothing():
    columns = ride_columns(EXTENDED_PHYSICAL, steps(1, 10))
    before = {name: column.copy() for name, column in columns.items()}
    for column in columns.values():
        column.flags.writeable = False
    first, again = EXTENDED_PHYSICAL.predict(columns), EXTENDED_PHYSICAL.predict(columns)
    assert first.tobytes() == again.tobytes()
    assert all(columns[name].tobytes() == before[name].tobytes() for name in columns)


@pytest.mark.parametrize("name", EXTENDED_PHYSICAL.needs)
def test_nan_where_a_needed_column_is_nan_and_nowhere_else(name):
    columns = ride_columns(EXTENDED_PHYSICAL, steps(2, 5))
    columns[name][3] = np.nan
    assert np.isnan(EXTENDED_PHYSICAL.predict(columns)).tolist() == [False, False, False, True, False]


def test_a_table_will_do_and_other_columns_do_not_matter():
    columns = ride_columns(BASIC_PHYSICAL, steps(3, 5))
    table = pd.DataFrame({**columns, "driver_id": "d"})
    assert BASIC_PHYSICAL.predict(table).tobytes() == BASIC_PHYSICAL.predict(columns).tobytes()


def test_missing_column_is_named():
    with pytest.raises(ModelError, match=r"basic_physical: column 'effect_inertia' is missing"):
        BASIC_PHYSICAL.predict({n: np.ones(1) for n in BASIC_PHYSICAL.needs if n != "effect_inertia"})


def test_no_rows_and_constant_terms():
    assert BASIC_PHYSICAL.predict({n: np.empty(0) for n in BASIC_PHYSICAL.needs}).shape == (0,)
    constant = model_of(Term(name="one", columns=(), unit="kWh"), fits={ANY: Fit(coefficients=(0.25,))})
    assert constant.predict({"distance_km": np.zeros(3)}).tolist() == [0.25, 0.25, 0.25]
    assert constant.effects == ()


def model_of(*terms, **fields) -> LinearModel:
    return LinearModel(name="m", version="1", recipe="r", terms=terms, **fields)


CURVE = Curve(
    heating_full=255.0,
    heating_off=285.0,
    cooling_on=294.0,
    cooling_full=305.0,
    heating=4000.0,
    standby=250.5,
    cooling=1500.0,
)
LINEAR = (
    Term(name="distance", columns=("distance_km",), unit="kWh/km"),
    Term(name="wind", columns=("wind_from_east", "wind_speed_kmh"), unit="kWh/(km/h)"),
    Term(name="accessories", columns=("accessories_kwh",), unit="1"),
    Term(name="constant", columns=(), unit="kWh"),
)
STUMP = Trees(
    features=("occupants", "wind_from_north"),
    baseline=0.5,
    roots=(0,),
    feature=(0, -1, -1),
    threshold=(2.0, 0.0, 0.0),
    left=(1, 0, 0),
    right=(2, 0, 0),
    value=(0.0, -1.0, 1.0),
    missing_left=(1, 0, 0),
)


def fleet(rows: int = 60, seed: int = 1) -> pd.DataFrame:
    """Rides of three vehicle models, one of them unknown to the model, and of a car that has not said what it is."""
    random = np.random.default_rng(seed)
    table = pd.DataFrame(
        {
            "distance_km": random.uniform(1.0, 20.0, rows),
            "wind_speed_kmh": random.uniform(0.0, 40.0, rows),
            "wind_from_deg": random.uniform(0.0, 360.0, rows),
            "duration_s": random.uniform(60.0, 3000.0, rows),
            "ambient_c": random.uniform(-30.0, 30.0, rows),
            "accessory_scale": random.choice([0.9, 1.3], rows),
            "occupants": random.integers(1, 5, rows).astype(float),
            "vehicle_model": random.choice(["leaf", "soul", "new", None], rows),
            "vehicle_id": random.choice(["a", "b", "c"], rows),
        }
    )
    table.loc[::7, "wind_from_deg"] = np.nan
    table.loc[::11, "distance_km"] = np.nan
    return table


FLEET = model_of(
    *LINEAR,
    fits={
        "leaf": Fit(coefficients=(0.2, 0.001, 1.0, 0.05), fills={"wind_from_east": 0.3}, curve=CURVE),
        "soul": Fit(coefficients=(0.1, 0.002, 0.9, -0.05), fills={"distance_km": 4.0}, curve=CURVE),
        ANY: Fit(coefficients=(0.15, 0.0, 1.1, 0.0), curve=CURVE),
    },
    cars={"b": 1.125},
    correction={"leaf": STUMP},
)


def by_hand(ride) -> float:
    """What FLEET says of a ride, written out."""
    fit = FLEET.fits.get(ride.vehicle_model, FLEET.fits[ANY])
    distance = fit.fills.get("distance_km", np.nan) if np.isnan(ride.distance_km) else ride.distance_km
    east = np.sin(np.radians(ride.wind_from_deg))
    east = fit.fills.get("wind_from_east", np.nan) if np.isnan(east) else east
    power = CURVE.to_curve().power(np.array([ride.ambient_c + ZERO_CELSIUS]))[0]
    columns = (distance, east * ride.wind_speed_kmh, ride.duration_s * power * ride.accessory_scale / 3.6e6, 1.0)
    total = sum(c * x for c, x in zip(fit.coefficients, columns, strict=True))
    if ride.vehicle_model == "leaf":
        total += 0.5 + (-1.0 if ride.occupants <= 2 else 1.0)
    return total * (1.125 if ride.vehicle_id == "b" else 1.0)


def test_each_vehicle_model_has_its_fit_and_each_car_its_factor():
    rides = fleet()
    expected = [by_hand(ride) for ride in rides.itertuples()]
    np.testing.assert_allclose(FLEET.predict(rides), expected, rtol=1e-12)
    known = ~np.isnan(expected)
    assert 10 < known.sum() < len(rides)


def test_needs_name_what_derived_columns_and_fits_read():
    assert FLEET.needs == (
        "distance_km",
        "wind_from_deg",
        "wind_speed_kmh",
        "duration_s",
        "ambient_c",
        "accessory_scale",
        "occupants",
        "vehicle_model",
        "vehicle_id",
    )
    alone = msgspec.structs.replace(FLEET, fits={ANY: FLEET.fits[ANY]}, cars={}, correction=None)
    assert "vehicle_model" not in alone.needs
    assert "vehicle_id" not in alone.needs


@given(st.integers(0, 2**32), st.lists(st.integers(0, 60), max_size=6))
def test_a_fleet_is_predicted_the_same_to_the_bit_however_rows_are_cut(seed, cuts):
    rides = fleet(60, seed)
    whole = FLEET.predict(rides)
    edges = [0, *sorted(cuts), 60]
    parts = [FLEET.predict(rides.iloc[a:b]) for a, b in pairwise(edges)]
    assert np.concatenate(parts).tobytes() == whole.tobytes()
    order = np.random.default_rng(seed).permutation(60)
    assert FLEET.predict(rides.iloc[order]).tobytes() == whole[order].tobytes()


def test_a_fleet_is_predicted_without_touching_the_table():
    rides = fleet()
    before = rides.copy(deep=True)
    FLEET.predict(rides)
    pd.testing.assert_frame_equal(rides, before)


def test_without_a_fit_for_all_others_their_energy_is_unknown():
    lone = msgspec.structs.replace(FLEET, fits={"leaf": FLEET.fits["leaf"]}, correction=None)
    rides = fleet()
    known = ~np.isnan(lone.predict(rides))
    assert set(rides["vehicle_model"][known]) == {"leaf"}


def test_an_interval_is_asked_for_only_where_there_is_one():
    with pytest.raises(ModelError, match="has no prediction interval"):
        FLEET.predict_interval(fleet())


finite = st.floats(allow_nan=False, allow_infinity=False)
positive = st.floats(0.0, 1e6)
text = st.text(max_size=12)
json_values = st.recursive(
    st.none() | st.booleans() | finite | text, lambda inner: st.dictionaries(text, inner, max_size=2)
)
terms = st.lists(
    st.builds(
        Term,
        name=text,
        columns=st.lists(st.sampled_from(["effect_rolling", "odometer_km", "wind_from_north"]), max_size=3).map(tuple),
        unit=text,
    ),
    max_size=4,
    unique_by=lambda term: term.name,
).map(tuple)
trainings = st.builds(
    Training,
    rides=st.integers(0, 9),
    first_date=text,
    last_date=text,
    vehicle_models=st.dictionaries(text, st.integers(0, 9), max_size=2),
    fingerprint=text,
)


@st.composite
def models(draw):
    parts = draw(terms)
    n = len(parts)
    row = st.lists(finite, min_size=n, max_size=n).map(tuple)
    fit = st.builds(
        Fit,
        coefficients=row,
        covariance=st.none() | st.lists(row, min_size=n, max_size=n).map(tuple),
        fills=st.dictionaries(st.sampled_from(["distance_km", "ambient_c"]), finite, max_size=2),
        curve=st.none() | st.just(CURVE),
        rides=st.integers(0, 10**9),
        residual_sd_kwh=st.none() | positive,
        held=st.sampled_from([(), tuple(term.name for term in parts)]),
    )
    return LinearModel(
        name=draw(text),
        version=draw(text),
        recipe=draw(text),
        terms=parts,
        fits=draw(st.dictionaries(text | st.just(ANY), fit, min_size=1, max_size=3)),
        cars=draw(st.dictionaries(text, finite, max_size=2)),
        correction=draw(st.none() | st.just({ANY: STUMP})),
        training=draw(st.none() | trainings),
        history=tuple(draw(st.lists(st.dictionaries(text, json_values, max_size=3), max_size=2))),
    )


@given(models())
def test_model_file_is_an_exact_round_trip(model):
    content = encode(model)
    read = decode(content)
    assert read == model
    assert encode(read) == content
    for key, fit in model.fits.items():
        assert [c.hex() for c in read.fits[key].coefficients] == [c.hex() for c in fit.coefficients]
    assert json.loads(content) == json.loads(msgspec.json.encode(model))


def test_a_fleet_saved_and_loaded_predicts_the_same_to_the_bit(tmp_path):
    save(FLEET, tmp_path / "model.json")
    read = load(tmp_path / "model.json")
    assert read == FLEET
    assert read.predict(fleet()).tobytes() == FLEET.predict(fleet()).tobytes()


def test_numbers_of_a_fit_stand_on_one_line():
    lines = encode(FLEET).decode().splitlines()
    assert '      "coefficients": [0.2, 0.001, 1.0, 0.05],' in lines
    odd = msgspec.structs.replace(FLEET, history=({"said": "[\n 1,\n 2\n ]"},))
    assert decode(encode(odd)) == odd


@pytest.mark.parametrize("model", KNOWN.values(), ids=lambda m: m.name)
def test_saved_and_loaded_it_predicts_the_same(model, tmp_path):
    save(model, tmp_path / "model.json")
    read = load(tmp_path / "model.json")
    columns = ride_columns(model, steps(4, 7))
    assert read == model
    assert read.predict(columns).tobytes() == model.predict(columns).tobytes()
    assert load(model.name) is model


def test_model_file_is_read_by_people(tmp_path):
    save(BASIC_PHYSICAL, tmp_path / "model.json")
    lines = (tmp_path / "model.json").read_text().splitlines()
    assert '  "name": "basic_physical",' in lines
    assert '      "unit": "1"' in lines


def changed(**changes) -> bytes:
    return json.dumps({**json.loads(encode(BASIC_PHYSICAL)), **changes}).encode()


def fleet_file(**changes) -> bytes:
    return json.dumps({**json.loads(encode(FLEET)), **changes}).encode()


def fit_file(**changes) -> bytes:
    fit = {**json.loads(encode(FLEET))["fits"]["leaf"], **changes}
    return fleet_file(fits={ANY: fit})


TERM = {"name": "x", "columns": ["effect_rolling"], "unit": "1"}
FORMAT_1 = json.dumps(
    {
        "format": 1,
        "name": "basic_physical",
        "version": "1",
        "recipe": "basic_physical",
        "terms": [{**TERM, "coefficient": 1.0}],
        "history": [],
    }
).encode()


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "not JSON"),
        (b"\xff\xfe", "not JSON"),
        (encode(BASIC_PHYSICAL)[:100], "not JSON"),
        (b"[]", "no model file: it has no 'format'"),
        (b'{"a": 1}', "no model file: it has no 'format'"),
        (FORMAT_1, "model file of format 1, and this version reads format 2: fit the model anew"),
        (changed(format=FORMAT + 1), f"model file of format {FORMAT + 1}, and this version reads format {FORMAT}"),
        (changed(format="1"), "model file of format '1'"),
        (changed(terms="rolling"), "damaged: Expected `array`"),
        (changed(fits={}), "it has no fits"),
        (changed(terms=[{**TERM, "colour": "red"}]), "damaged: Object contains unknown field `colour`"),
        (changed(terms=[TERM, TERM]), "term 'x' stands twice"),
        (changed(terms=[{**TERM, "columns": ["effect_roling"]}]), "effect 'roling' is unknown: did you mean rolling"),
        (changed(terms=[{**TERM, "columns": ["effect_qqq"]}]), "effect 'qqq' is unknown: known are rolling"),
        (changed(terms=[{**TERM, "columns": ["distanse_km"]}]), "column 'distanse_km' is none that a model can read"),
        (changed(terms=[{**TERM, "columns": ["soc_end_pct"]}]), "column 'soc_end_pct' holds what is to be predicted"),
        (changed(terms=[{**TERM, "columns": ["energy_vi_kwh"]}]), "'energy_vi_kwh' holds what is to be predicted"),
        (fit_file(coefficients=[1.0, 2.0, 3.0]), "fit '*' has 3 coefficients for 4 terms"),
        (fit_file(coefficients=[1.0, None, 3.0, 4.0]), "damaged: Expected `float`, got `null`"),
        (fit_file(curve=None), "fit '*' has no curve, and term 'accessories' reads accessories_kwh"),
        (fit_file(curve={**msgspec.to_builtins(CURVE), "heating_off": 250.0}), "choke points of its curve"),
        (fit_file(covariance=[[1.0]]), "its covariance is not 4 by 4"),
        (fit_file(fills={"distanse_km": 1.0}), "fill: column 'distanse_km' is none that a model can read"),
        (
            fleet_file(correction={ANY: {**msgspec.to_builtins(STUMP), "features": ["hvac_kwh", "lost_m"]}}),
            "correction '*': column 'hvac_kwh' holds what is to be predicted",
        ),
    ],
)
def test_bad_model_file_says_what_in_one_line(content, said, tmp_path):
    path = tmp_path / "model.json"
    path.write_bytes(content)
    with pytest.raises(ModelError) as caught:
        load(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_unknown_name_absent_file_and_folder(tmp_path):
    with pytest.raises(ModelError, match=r"model 'hybird' is unknown: known are basic_physical, extended_physical"):
        load("hybird")
    with pytest.raises(ModelError, match=r"no\.json: cannot read a model: No such file"):
        load(tmp_path / "no.json")
    with pytest.raises(ModelError, match="cannot read a model: Is a directory"):
        load(tmp_path)
    with pytest.raises(ModelError, match="cannot write the model"):
        save(BASIC_PHYSICAL, tmp_path / "no" / "model.json")


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_numbers_that_are_not_finite_are_not_written(value, tmp_path):
    bad = Fit(coefficients=(value, 1.0, 1.0, 1.0))
    with pytest.raises(ModelError, match=r"coefficient of 'rolling' is (nan|inf)"):
        save(msgspec.structs.replace(BASIC_PHYSICAL, fits={ANY: bad}), tmp_path / "model.json")
    with pytest.raises(ModelError, match="factor of car 'b'"):
        save(msgspec.structs.replace(FLEET, cars={"b": value}), tmp_path / "model.json")
    odd = Fit(coefficients=(1.0,) * 4, fills={"distance_km": value})
    with pytest.raises(ModelError, match="fill of 'distance_km' is"):
        save(msgspec.structs.replace(BASIC_PHYSICAL, fits={ANY: odd}), tmp_path / "model.json")
    assert not (tmp_path / "model.json").exists()
