"""Test that shared-out energies add up, and that the segment model learns a planted relation reproducibly."""

import numpy as np
import pytest

from socast.core.errors import ModelError
from socast.core.fit.segment_network import SEGMENT_FEATURES, SegmentRecipe, build_segments, share_out_energy
from tests.support.segment_windows import segment_windows


@pytest.fixture(scope="module")
def table():
    return segment_windows()


def test_shared_out_energies_add_up_to_the_energy_of_the_ride(table):
    frame, rides, _ = table
    ride = frame["ride_key"].str.removeprefix("car#").astype(int).to_numpy()
    features, energy = frame[["effect_climbing_up", "distance_km"]].to_numpy(), rides["energy_kwh"].to_numpy()
    shares = share_out_energy(features, frame["duration_s"].to_numpy(), ride, energy)
    np.testing.assert_allclose(np.bincount(ride, weights=shares), energy, rtol=1e-9)


def test_linear_energy_is_shared_out_exactly(table):
    frame, _, _ = table
    ride = frame["ride_key"].str.removeprefix("car#").astype(int).to_numpy()
    features = frame[["effect_climbing_up", "distance_km"]].to_numpy()
    true = features @ [0.7, 0.2] + 0.01
    shares = share_out_energy(features, frame["duration_s"].to_numpy(), ride, np.bincount(ride, weights=true))
    np.testing.assert_allclose(shares, true, rtol=1e-6)


def test_planted_nonlinear_relation_is_learned(table):
    frame, rides, _ = table
    train, test = rides.iloc[::2], rides.iloc[1::2]
    predicted = SegmentRecipe(build_segments(frame)).fit(train).predict_energy(test)
    error = np.abs(predicted - test["energy_kwh"]).mean()
    assert error < 0.35 * np.abs(test["energy_kwh"] - train["energy_kwh"].mean()).mean()
    assert not np.isnan(predicted).any()


def test_equal_seeds_give_equal_predictions_in_any_order_of_rides(table):
    frame, rides, _ = table
    recipe = SegmentRecipe(build_segments(frame.sample(frac=1.0, random_state=3)))
    one, two = (recipe.fit(rides.iloc[:200]) for _ in range(2))
    predicted = one.predict_energy(rides)
    np.testing.assert_array_equal(predicted, two.predict_energy(rides))
    back = rides.sample(frac=1.0, random_state=4)
    np.testing.assert_allclose(one.predict_energy(back), predicted[back.index], rtol=1e-12)


def test_unseen_vehicle_model_is_predicted_by_the_network_of_all_rides(table):
    frame, rides, _ = table
    model = SegmentRecipe(build_segments(frame)).fit(rides)
    new = model.predict_energy(rides.assign(vehicle_model="horse"))
    assert not np.isnan(new).any()
    assert not np.array_equal(new, model.predict_energy(rides))


def test_ride_without_windows_is_nan_and_unknown_values_are_accepted(table):
    frame, rides, _ = table
    frame = frame[frame["ride_key"] != "car#7"].copy()
    frame.loc[frame.index[::5], "precipitation_mm_h"] = np.nan
    frame["wind_speed_kmh"] = np.nan
    predicted = SegmentRecipe(build_segments(frame)).fit(rides).predict_energy(rides)
    assert np.flatnonzero(np.isnan(predicted)).tolist() == [7]


def test_too_few_rides_and_missing_columns_are_refused(table):
    frame, rides, _ = table
    with pytest.raises(ModelError, match="needs 50: give more rides"):
        SegmentRecipe(build_segments(frame)).fit(rides.iloc[:20])
    with pytest.raises(ModelError, match="'stops' is missing in the window table"):
        build_segments(frame.drop(columns="stops"))


def test_no_feature_holds_the_answer():
    names = {name for product in SEGMENT_FEATURES for name in product}
    assert not any(name.startswith(("energy", "soc", "hvac")) for name in names)
