"""Test that the tables hold every effect and variant, equal to the bit for any chunking of the stream."""

from dataclasses import dataclass

import msgspec
import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from socast.core.columns import JOULES_PER_KWH
from socast.core.effects import get, get_library, list_tabulated
from socast.core.pipeline import Pipeline
from tests.support.telemetry import drive, leaf, observed, ran, telemetry, without


def shift(n=240, seed=3):
    """Return messages of a car that sends every signal in all weathers; state of charge and odometer start late."""
    base = drive(n, seed=seed)
    base["time_s"] = base["time_s"] + 13.4 * 3600  # before sunset
    columns = base | {
        "elevation_m": 60 + 30 * np.sin(base["metres"] / 700),
        "battery_voltage_v": np.full(n, 360.0),
        "battery_current_a": 4.0 + base["speed_kmh"],
        "ambient_c": np.linspace(-6.0, 31.0, n),
        "occupants": np.where(np.arange(n) < n // 2, 1, 3),
        "soc_pct": np.where(np.arange(n) < 20, np.nan, 98.0),
        "odometer_km": np.where(np.arange(n) < 9, np.nan, 60_000.0),
        "battery_temperature_c": np.where(np.arange(n) < n // 3, np.nan, np.linspace(-40.0, 45.0, n)),
        "longitude_deg": base["longitude_deg"] + 2e-5 * np.cumsum(np.sin(np.arange(n) / 9)),
        "ride_id": np.repeat(np.array(["A", "B"], dtype=object), n // 2),
    }
    start = base["time_s"][0]
    weather = [
        observed(
            time=start - 300 + 240 * i,
            temperature_c=4.0 - 6 * (i % 2),
            precipitation_mm=0.7,
            wind_speed_kmh=20.0,
            wind_from_deg=40.0 * i,
            solar_w_m2=400.0,
            humidity_pct=90.0,
        )
        for i in range(4)
    ]
    messages = [leaf(), *telemetry(columns)]
    for i, message in enumerate(weather):
        messages.insert(1 + 60 * i, message)
    return messages


MESSAGES = shift()


@pytest.fixture(scope="module")
def whole():
    """Return the ride and window tables of the shift with every effect and variant."""
    pipeline, _ = ran(MESSAGES, also=list_tabulated())
    return pipeline.take_rides(), pipeline.take_windows()


def test_tables_have_a_column_for_every_effect_and_every_variant(whole):
    for table in whole:
        assert [name for name in table if name.startswith("effect_")][: 5] == [
            *("effect_rolling", "effect_climbing", "effect_aero_drag", "effect_inertia", "effect_accessories")
        ]  # fmt: skip
        assert {f"effect_{name}" for name in list_tabulated()} <= set(table)
        assert table.columns.is_unique


def test_every_effect_is_finite_and_nonzero_in_a_shift_with_all_weathers(whole):
    rides, windows = whole
    for name in list_tabulated():
        assert np.isfinite(rides[f"effect_{name}"]).all(), name
        assert np.isfinite(windows[f"effect_{name}"]).all(), name
        assert (rides[f"effect_{name}"] != 0).any(), name


def test_windows_add_up_to_their_ride(whole):
    rides, windows = whole
    names = [f"effect_{name}" for name in list_tabulated()]
    summed = windows.groupby("ride_key")[names].sum().loc[rides["ride_key"]]
    assert summed.to_numpy() == pytest.approx(rides[names].to_numpy(), rel=1e-9, abs=1e-9)


@given(cuts=st.lists(st.integers(0, len(MESSAGES)), max_size=8))
@settings(max_examples=8)
def test_tables_do_not_depend_on_chunking_for_every_effect_and_variant(whole, cuts):
    parts, _ = ran(MESSAGES, cuts, also=list_tabulated(), keep_forecasts=False)
    pd.testing.assert_frame_equal(parts.take_rides(), whole[0], check_exact=True)
    pd.testing.assert_frame_equal(parts.take_windows(), whole[1], check_exact=True)


def test_restart_on_a_wet_road_changes_no_window(whole):
    first = Pipeline(also=list_tabulated())
    first.push(MESSAGES[:150])
    windows = first.take_windows()
    second = Pipeline(also=list_tabulated())
    second.restore(first.snapshot())
    second.push(MESSAGES[150:])
    second.finish()
    together = pd.concat([windows, second.take_windows()], ignore_index=True)
    pd.testing.assert_frame_equal(together, whole[1], check_exact=True)


def test_column_of_a_variant_is_the_effect_at_the_other_value(whole):
    """Below 5 °C for the whole ride, each increase of the reference by 5 K adds the same energy."""
    cold = without(drive(100, speed=10.0, ambient_c=-20.0), "metres")
    pipeline, _ = ran([leaf(), *telemetry(cold)], also=list_tabulated())
    ride = pipeline.take_rides().iloc[0]
    at = [ride[f"effect_cold_rolling@reference={t}"] for t in (278.15, 283.15, 288.15)]
    at.append(ride["effect_cold_rolling"])
    assert np.diff(at) == pytest.approx([at[1] - at[0]] * 3)
    assert (at[1] - at[0]) / ride["effect_rolling"] == pytest.approx(5.0)
    assert (whole[0]["effect_wet_road@depth=0.001"] < whole[0]["effect_wet_road"]).all()


@dataclass(frozen=True)
class Fitted:
    """Predict with one variant and its coefficient."""

    effects: tuple[str, ...] = ("cold_rolling@reference=283.15",)
    name: str = "fitted"
    version: str = "1"

    @property
    def needs(self):
        return tuple(f"effect_{name}" for name in self.effects)

    def predict_energy(self, columns):
        return 1e-4 * np.asarray(columns[self.needs[0]])


def test_live_path_computes_only_the_variant_that_the_model_reads():
    cold = without(drive(100, speed=10.0, ambient_c=-20.0), "metres")
    pipeline, out = ran([leaf(), *telemetry(cold)], model=Fitted())
    assert pipeline.context.effects == ["cold_rolling@reference=283.15"]
    rides = pipeline.take_rides()
    assert [name for name in rides if name.startswith("effect_")] == ["effect_cold_rolling@reference=283.15"]
    weight = (rides["mass_kg"][0] + 75) * 9.80665
    expected = 1e-4 * 30 * weight * rides["distance_km"][0] * 1000 / JOULES_PER_KWH
    assert Fitted().predict_energy(rides)[0] == pytest.approx(expected, rel=1e-3)
    predicted = [msgspec.json.decode(message.payload)["ride_energy_predicted_kwh"] for message in out]
    assert 0 < predicted[-1] <= expected * 1.001


def test_darkness_persists_while_the_position_is_unknown():
    columns = drive(300, speed=12.0)
    columns["time_s"] = columns["time_s"] + 16 * 3600
    latitude = columns["latitude_deg"].copy()
    latitude[100:180] = np.nan
    for sent in (columns, columns | {"latitude_deg": latitude}):
        pipeline, _ = ran([leaf(), *telemetry(sent)], also=["night_lights"])
        ride = pipeline.take_rides().iloc[0]
        assert ride["effect_night_lights"] == pytest.approx(ride["duration_s"] / JOULES_PER_KWH, rel=1e-6)


def test_tables_include_every_effect_of_the_library():
    assert set(get_library()) <= set(list_tabulated())
    assert all(get(name).name == name for name in list_tabulated())
