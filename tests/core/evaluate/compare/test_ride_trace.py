"""Test the trace of a ride: sums over windows, planted divergences, and refusals."""

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.errors import ModelError
from socast.core.evaluate.compare.ride_trace import accumulate_windows, find_ride, locate_divergence, trace_ride
from socast.core.models import BASIC_PHYSICAL, EXTENDED_PHYSICAL, Term
from socast.core.models.features import FEATURES
from socast.tools.terminal.ride_source import RideSource
from tests.support.linear_models import make_model
from tests.support.paths import ROOT

SHIFT = ROOT / "recordings" / "shift.mcap"


seeds = st.integers(0, 2**32 - 1)


@pytest.fixture(scope="module")
def shift():
    return RideSource([SHIFT]).read(EXTENDED_PHYSICAL.effects, library=False)


def test_accumulated_windows_end_with_values_of_ride(shift):
    rides, windows = shift
    for i in range(0, len(rides), 5):
        ride = rides.iloc[[i]].reset_index(drop=True)
        of_ride = windows[windows["ride_key"] == ride["ride_key"].iloc[0]]
        result = accumulate_windows(ride, of_ride)
        for name in (name for name in FEATURES if name in ride):
            tolerance = {"rtol": 0.02} if name in {"wind_from_deg", "wind_speed_kmh"} else {"rtol": 1e-9, "atol": 1e-9}
            np.testing.assert_allclose(result[name].iloc[-1], ride[name].iloc[0], err_msg=name, **tolerance)
        assert result["distance_km"].iloc[0] == 0.0


def test_trace_adds_up_to_measured_and_predicted_energy(shift):
    rides, windows = shift
    ride = find_ride(rides[rides["distance_km"] > 5.0], rides.loc[rides["distance_km"] > 5.0, "ride_key"].iloc[0])
    result = trace_ride(ride, windows, {"plain": EXTENDED_PHYSICAL, "with": _with_constant()})
    assert sum(result.windows.measured_kwh) == pytest.approx(ride["energy_kwh"].iloc[0])
    assert result.windows.end_km[-1] == pytest.approx(ride["distance_km"].iloc[0])
    for name, of_model in result.models.items():
        assert of_model.start_kwh + sum(of_model.energy_kwh) == pytest.approx(of_model.predicted_kwh), name
        np.testing.assert_allclose(np.sum(list(of_model.terms.values()), axis=0), of_model.energy_kwh, atol=1e-12)
        assert sum(of_model.start_terms.values()) == pytest.approx(of_model.start_kwh)
    assert result.models["plain"].start_kwh == 0.0
    assert result.models["with"].start_kwh == 0.5
    expected_note = (
        "with is not a sum over windows: each window shows what it adds to the prediction of the ride so far; "
        "+0.500 kWh are predicted before the first window"
    )
    assert [note for note in result.notes if "not a sum over windows" in note] == [expected_note]


def _with_constant():
    terms = (*EXTENDED_PHYSICAL.terms, Term(name="constant", columns=(), unit="kWh"))
    return make_model("with", terms, [1.0] * 5 + [0.5])


def test_windows_without_needed_column_are_refused(shift):
    rides, windows = shift
    ride = find_ride(rides, rides.loc[rides["distance_km"] > 5.0, "ride_key"].iloc[0])
    with pytest.raises(ModelError, match="column 'effect_climbing' is missing in the data: make the tables"):
        trace_ride(ride, windows.drop(columns="effect_climbing"), {"m": BASIC_PHYSICAL})


def test_ride_without_measured_energy_has_no_trace(shift):
    rides, windows = shift
    ride = find_ride(rides, rides["ride_key"].iloc[0]).assign(energy_kwh=np.nan)
    with pytest.raises(ModelError, match="it has no measured energy to compare with"):
        trace_ride(ride, windows, {"m": BASIC_PHYSICAL})


def test_ride_is_found_by_key_or_identifier_and_error_names_similar_keys(shift):
    rides, _ = shift
    key, name = rides["ride_key"].iloc[4], rides["ride_id"].iloc[4]
    assert find_ride(rides, key)["ride_id"].iloc[0] == name
    assert find_ride(rides, name)["ride_key"].iloc[0] == key
    with pytest.raises(ModelError, match=r"ride 'taxi-01#0' is not among \d+ rides: did you mean taxi-001#0"):
        find_ride(rides, "taxi-01#0")
    twice = pd.concat([rides, rides.assign(ride_key="other#" + rides["ride_key"])])
    with pytest.raises(ModelError, match="2 rides are named so: give the ride_key"):
        find_ride(twice, name)


def test_ride_measured_by_soc_is_traced_in_steps_with_note(shift):
    rides, windows = shift
    soc = rides[(rides["energy_kwh"] == rides["energy_soc_kwh"]) & (rides["distance_km"] > 3.0)]
    result = trace_ride(find_ride(rides, soc["ride_key"].iloc[0]), windows, {"m": EXTENDED_PHYSICAL})
    assert result.notes[0].startswith("measured by the state of charge: in steps")
    assert sum(result.windows.measured_kwh) == pytest.approx(soc["energy_kwh"].iloc[0])


def test_unmeasured_windows_take_mean_power(shift):
    rides, windows = shift
    ride = find_ride(rides, rides.loc[rides["energy_kwh"] == rides["energy_vi_kwh"], "ride_key"].iloc[3])
    of_ride = windows.index[windows["ride_key"] == ride["ride_key"].iloc[0]]
    gone = windows.assign(energy_vi_kwh=windows["energy_vi_kwh"].mask(windows.index == of_ride[1]))
    result = trace_ride(ride, gone, {"m": EXTENDED_PHYSICAL})
    assert any(note.startswith(f"1 of {len(of_ride)} windows were not measured") for note in result.notes)
    assert sum(result.windows.measured_kwh) == pytest.approx(ride["energy_kwh"].iloc[0])
    with pytest.raises(ModelError, match="none of the windows of this ride has a measured energy"):
        trace_ride(ride, windows.assign(energy_vi_kwh=np.nan), {"m": EXTENDED_PHYSICAL})


@given(seeds, st.integers(0, 15), st.integers(2, 6), st.sampled_from([-1.0, 1.0]))
def test_located_divergence_matches_planted_windows(seed, first, length, sign):
    rng = np.random.default_rng(seed)
    windows = {"duration_s": rng.uniform(50.0, 70.0, 24), "distance_km": rng.uniform(0.2, 1.2, 24)}
    error = sign * 0.004 + rng.normal(0.0, 0.001, 24)  # all along, and here
    error[first : first + length] += 0.1 * sign
    result = locate_divergence(error, windows, float(error.sum()))
    assert (result.first, result.last) == (first, first + length - 1)
    assert result.share == pytest.approx(0.1 * length / (0.1 * length + 0.1), abs=0.1)
    assert result.minute == pytest.approx(windows["duration_s"][:first].sum() / 60.0)
    assert result.km == pytest.approx(windows["distance_km"][:first].sum())


@given(st.floats(-1.0, 1.0))
def test_constant_error_has_no_divergence(rate):
    windows = {"duration_s": np.full(20, 60.0), "distance_km": np.ones(20)}
    assert locate_divergence(np.full(20, rate), windows, 20.0 * rate) is None
