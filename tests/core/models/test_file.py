"""Test that model files are exact round trips and readable, and that damaged ones are refused in one line."""

import json

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.errors import ModelError
from socast.core.models import (
    ANY,
    BASIC_PHYSICAL,
    BUILT_IN_MODELS,
    EXTENDED_PHYSICAL,
    FORMAT,
    Fit,
    LinearModel,
    Term,
    Training,
    decode_model,
    encode_model,
    load,
    save,
    stamp,
)
from tests.support.linear_models import CURVE, FLEET, STUMP, fleet, ride_columns, steps

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
    content = encode_model(model)
    read = decode_model(content)
    assert read == model
    assert encode_model(read) == content
    for key, fit in model.fits.items():
        assert [c.hex() for c in read.fits[key].coefficients] == [c.hex() for c in fit.coefficients]
    assert json.loads(content) == json.loads(msgspec.json.encode(model))


def test_model_of_several_vehicle_models_predicts_the_same_bits_after_loading(tmp_path):
    save(FLEET, tmp_path / "model.json")
    read = load(tmp_path / "model.json")
    assert read == stamp(FLEET)
    assert read.predict_energy(fleet()).tobytes() == FLEET.predict_energy(fleet()).tobytes()


def test_numbers_of_a_fit_are_written_on_one_line():
    lines = encode_model(FLEET).decode().splitlines()
    assert '      "coefficients": [0.2, 0.001, 1.0, 0.05],' in lines
    odd = msgspec.structs.replace(FLEET, history=({"said": "[\n 1,\n 2\n ]"},))
    assert decode_model(encode_model(odd)) == odd


@pytest.mark.parametrize("model", BUILT_IN_MODELS.values(), ids=lambda m: m.name)
def test_built_in_model_predicts_the_same_bits_after_loading(model, tmp_path):
    save(model, tmp_path / "model.json")
    read = load(tmp_path / "model.json")
    columns = ride_columns(model, steps(4, 7))
    assert read == stamp(model)
    assert read.predict_energy(columns).tobytes() == model.predict_energy(columns).tobytes()
    assert load(model.name) is model


def write_edited(path, **changes):
    """Write a model file, then change fields in its text."""
    save(EXTENDED_PHYSICAL, path)
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


@pytest.mark.parametrize(
    "changes",
    [
        {"version": "1"},
        {"name": "mine"},
        {"cars": {"taxi-1": 1.1}},
        {"fits": {"*": {"coefficients": [1.0, 1.0, 1.0, 1.0, 1.5]}}},
    ],
)
def test_edited_file_is_refused_with_both_versions_and_the_remedy(changes, tmp_path):
    path = tmp_path / "model.json"
    write_edited(path, **changes)
    edited = decode_model(path.read_bytes())
    with pytest.raises(ModelError) as caught:
        load(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: version {edited.version!r} does not follow from the content, ")
    assert f"which has version {stamp(edited).version!r}: the file was edited after it was written" in message
    assert "refit the model, or accept the content with `socast.save_model(" in message
    assert "\n" not in message


def test_edited_file_is_accepted_once_it_is_saved_again(tmp_path):
    path = tmp_path / "model.json"
    write_edited(path, cars={"taxi-1": 1.1})
    edited = load(path, verify=False)
    assert edited.cars == {"taxi-1": 1.1}
    save(edited, path)
    assert load(path) == stamp(edited)


def test_layout_of_a_file_and_its_history_do_not_change_its_version(tmp_path):
    path = tmp_path / "model.json"
    write_edited(path, history=[{"action": "refused"}])
    read = load(path)
    assert read.version == stamp(EXTENDED_PHYSICAL).version
    assert read.history == ({"action": "refused"},)


@given(models())
def test_stamped_model_keeps_its_version_through_a_file(model):
    stamped = stamp(model)
    assert stamp(decode_model(encode_model(stamped))) == stamped


def test_model_file_has_one_readable_field_per_line(tmp_path):
    save(BASIC_PHYSICAL, tmp_path / "model.json")
    lines = (tmp_path / "model.json").read_text().splitlines()
    assert '  "name": "basic_physical",' in lines
    assert '      "unit": "1"' in lines


def changed(**changes) -> bytes:
    return json.dumps({**json.loads(encode_model(BASIC_PHYSICAL)), **changes}).encode()


def fleet_file(**changes) -> bytes:
    return json.dumps({**json.loads(encode_model(FLEET)), **changes}).encode()


def fit_file(**changes) -> bytes:
    fit = {**json.loads(encode_model(FLEET))["fits"]["leaf"], **changes}
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
    ("content", "message"),
    [
        (b"", "not JSON"),
        (b"\xff\xfe", "not JSON"),
        (encode_model(BASIC_PHYSICAL)[:100], "not JSON"),
        (b"[]", "no model file: it has no 'format'"),
        (b'{"a": 1}', "no model file: it has no 'format'"),
        (FORMAT_1, "model file of format 1, and this version reads format 2: fit the model again"),
        (changed(format=FORMAT + 1), f"model file of format {FORMAT + 1}, and this version reads format {FORMAT}"),
        (changed(format="1"), "model file of format '1'"),
        (changed(terms="rolling"), "damaged: Expected `array`"),
        (changed(fits={}), "it has no fits"),
        (changed(terms=[{**TERM, "colour": "red"}]), "damaged: Object contains unknown field `colour`"),
        (changed(terms=[TERM, TERM]), "term 'x' occurs twice"),
        (changed(terms=[{**TERM, "columns": ["effect_roling"]}]), "effect 'roling' is unknown: did you mean rolling"),
        (changed(terms=[{**TERM, "columns": ["effect_qqq"]}]), "effect 'qqq' is unknown: known are rolling"),
        (
            changed(terms=[{**TERM, "columns": ["distanse_km"]}]),
            "column 'distanse_km' is not one that a model can read",
        ),
        (changed(terms=[{**TERM, "columns": ["soc_end_pct"]}]), "column 'soc_end_pct' holds what is to be predicted"),
        (changed(terms=[{**TERM, "columns": ["energy_vi_kwh"]}]), "'energy_vi_kwh' holds what is to be predicted"),
        (fit_file(coefficients=[1.0, 2.0, 3.0]), "fit '*' has 3 coefficients for 4 terms"),
        (fit_file(coefficients=[1.0, None, 3.0, 4.0]), "damaged: Expected `float`, got `null`"),
        (fit_file(curve=None), "fit '*' has no curve, and term 'accessories' reads accessories_kwh"),
        (fit_file(curve={**msgspec.to_builtins(CURVE), "heating_off": 250.0}), "choke points of its curve"),
        (fit_file(covariance=[[1.0]]), "its covariance is not 4 by 4"),
        (fit_file(fills={"distanse_km": 1.0}), "fill: column 'distanse_km' is not one that a model can read"),
        (
            fleet_file(correction={ANY: {**msgspec.to_builtins(STUMP), "features": ["hvac_kwh", "lost_m"]}}),
            "correction '*': column 'hvac_kwh' holds what is to be predicted",
        ),
    ],
)
def test_bad_model_file_is_refused_in_one_line(content, message, tmp_path):
    path = tmp_path / "model.json"
    path.write_bytes(content)
    with pytest.raises(ModelError) as caught:
        load(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_unknown_name_absent_file_and_folder_are_refused(tmp_path):
    with pytest.raises(ModelError, match=r"model 'hybird' is unknown: name one of basic_physical, extended_physical"):
        load("hybird")
    with pytest.raises(ModelError, match=r"no\.json: cannot read a model: No such file"):
        load(tmp_path / "no.json")
    with pytest.raises(
        ModelError, match="is a folder, not a model: name the model file that `socast fit` wrote, or one of basic"
    ):
        load(tmp_path)
    with pytest.raises(ModelError, match="cannot write the model"):
        save(BASIC_PHYSICAL, tmp_path / "no" / "model.json")


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_model_with_non_finite_numbers_is_not_written(value, tmp_path):
    bad = Fit(coefficients=(value, 1.0, 1.0, 1.0))
    with pytest.raises(ModelError, match=r"coefficient of 'rolling' is (nan|inf)"):
        save(msgspec.structs.replace(BASIC_PHYSICAL, fits={ANY: bad}), tmp_path / "model.json")
    with pytest.raises(ModelError, match="factor of car 'b'"):
        save(msgspec.structs.replace(FLEET, cars={"b": value}), tmp_path / "model.json")
    odd = Fit(coefficients=(1.0,) * 4, fills={"distance_km": value})
    with pytest.raises(ModelError, match="fill of 'distance_km' is"):
        save(msgspec.structs.replace(BASIC_PHYSICAL, fits={ANY: odd}), tmp_path / "model.json")
    assert not (tmp_path / "model.json").exists()
