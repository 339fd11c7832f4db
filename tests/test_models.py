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
from core.models import BASIC_PHYSICAL, EXTENDED_PHYSICAL, FORMAT, KNOWN, LinearModel, Term, decode, encode, load, save
from core.road_load import STANDARD_AIR_DENSITY
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
    constant = LinearModel(
        name="c", version="1", recipe="c", terms=(Term(name="one", columns=(), coefficient=0.25, unit="kWh"),)
    )
    assert constant.predict({"distance_km": np.zeros(3)}).tolist() == [0.25, 0.25, 0.25]
    assert constant.effects == ()


finite = st.floats(allow_nan=False, allow_infinity=False)
text = st.text(max_size=12)
json_values = st.recursive(
    st.none() | st.booleans() | finite | text, lambda inner: st.dictionaries(text, inner, max_size=2)
)
terms = st.lists(
    st.builds(
        Term,
        name=text,
        columns=st.lists(st.sampled_from(["effect_rolling", "odometer_km", "distance_km"]), max_size=3).map(tuple),
        coefficient=finite,
        unit=text,
    ),
    max_size=5,
    unique_by=lambda term: term.name,
).map(tuple)


@given(
    st.builds(
        LinearModel,
        name=text,
        version=text,
        recipe=text,
        terms=terms,
        history=st.lists(st.dictionaries(text, json_values, max_size=3), max_size=3).map(tuple),
    )
)
def test_model_file_is_an_exact_round_trip(model):
    content = encode(model)
    read = decode(content)
    assert read == model
    assert encode(read) == content
    assert [t.coefficient.hex() for t in read.terms] == [t.coefficient.hex() for t in model.terms]


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


TERM = {"name": "x", "columns": ["effect_rolling"], "coefficient": 1.0, "unit": "1"}


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "not JSON"),
        (b"\xff\xfe", "not JSON"),
        (encode(BASIC_PHYSICAL)[:100], "not JSON"),
        (b"[]", "no model file: it has no 'format'"),
        (b'{"a": 1}', "no model file: it has no 'format'"),
        (changed(format=FORMAT + 1), f"model file of format {FORMAT + 1}, and this version reads format {FORMAT}"),
        (changed(format="1"), "model file of format '1'"),
        (changed(terms="rolling"), "damaged: Expected `array`"),
        (
            changed(terms=[{**TERM, "coefficient": None}]),
            "damaged: Expected `float`, got `null` - at `$.terms[0].coefficient`",
        ),
        (changed(terms=[{**TERM, "colour": "red"}]), "damaged: Object contains unknown field `colour`"),
        (changed(terms=[TERM, TERM]), "term 'x' stands twice"),
        (changed(terms=[{**TERM, "columns": ["effect_roling"]}]), "effect 'roling' is unknown: did you mean rolling"),
        (changed(terms=[{**TERM, "columns": ["effect_qqq"]}]), "effect 'qqq' is unknown: known are rolling"),
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
def test_coefficients_that_are_not_finite_are_not_written(value, tmp_path):
    term = msgspec.structs.replace(BASIC_PHYSICAL.terms[0], coefficient=value)
    with pytest.raises(ModelError, match="coefficient of 'rolling' is"):
        save(msgspec.structs.replace(BASIC_PHYSICAL, terms=(term,)), tmp_path / "model.json")
    assert not (tmp_path / "model.json").exists()
