"""Test that the source file of every form is an effect whose energy is that of the form."""

import numpy as np
import pandas as pd
import pytest

from socast.core import effects
from socast.core.columns import GRAVITY
from socast.core.diagnose.forms.building_blocks import CARRIERS, VARIABLES
from socast.core.diagnose.forms.suggestion import derive_unit, format_formula, format_source_file, name_term
from socast.core.diagnose.forms.terms import FormTerm, list_modulators
from socast.core.effects import registry
from socast.core.signals.signals import CIVIL_DUSK
from socast.core.signals.sun import sine_of_elevation

pytestmark = pytest.mark.long

CARRIER = {each.name: each for each in CARRIERS}
VARIABLE = {each.name: each for each in VARIABLES}
BASE = (
    "effect_rolling",
    "effect_climbing_up",
    "effect_climbing_down",
    "effect_aero_drag",
    "effect_inertia_positive",
    "effect_inertia_negative",
    "effect_auxiliary",
)


def signals(count, seed=0):
    """Return the columns that effects read, each constant within a window of one minute."""
    rng = np.random.default_rng(seed)
    day = np.sort(rng.integers(0, 60, count))
    latitude, longitude = np.full(count, 0.794), np.full(count, -1.284)
    time = 1516000000.0 + 6 * 86400.0 * day + rng.uniform(0.0, 86400.0, count)
    night = np.clip(-sine_of_elevation(time, latitude, longitude) / np.sin(np.radians(CIVIL_DUSK)), 0.0, 1.0)
    ambient = 281.0 + 12.0 * np.sin(day / 60.0 * 6.28) + rng.normal(0.0, 1.0, count)
    rain = (rng.random(60) < 0.4)[day] * rng.exponential(1.0, 60)[day] / 3.6e6
    crosswind = rng.normal(0.0, 3.0, count)
    return {
        "day": day,
        "latitude": latitude,
        "longitude": longitude,
        "time": time,
        "dt": np.full(count, 60.0),
        "speed": rng.gamma(3.0, 4.0, count),
        "acceleration": rng.normal(0.0, 0.4, count),
        "grade": rng.normal(0.0, 0.02, count),
        "headwind": rng.normal(0.0, 3.0, count),
        "crosswind": crosswind,
        "ambient": ambient,
        "pack_temperature": ambient + rng.uniform(0.0, 10.0, count),
        "precipitation": rain,
        "elapsed": rng.uniform(0.0, 2400.0, count),
        "parked": rng.lognormal(8.0, 1.5, count),
        "stop_rate": rng.poisson(0.5, count) / 60.0,
        "charge": rng.uniform(0.3, 0.98, count),
        "occupants": rng.integers(1, 6, count).astype(np.float64),
        "odometer": 3e7 + 1e5 * day + rng.uniform(0.0, 1e5, count),
        "mass": np.full(count, 1500.0),
        "tyre_load": np.full(count, 1500.0 * GRAVITY),
        "darkness": night,
    }


def table(rows):
    """Return the window table of these signals."""
    slope = np.sqrt(1.0 - rows["grade"] ** 2)
    rows = rows | {"tyre_load": rows["mass"] * GRAVITY * slope}
    energy = {
        name: effects.get(name.removeprefix("effect_")).power(rows) * rows["dt"] / 3.6e6
        for name in (*BASE, "effect_climbing")
    }
    distance = rows["speed"] * rows["dt"]
    climb = rows["grade"] * distance
    return pd.DataFrame(
        {
            "start_s": rows["time"] - 30.0,
            "duration_s": rows["dt"],
            "distance_km": distance / 1000.0,
            "average_speed_kmh": rows["speed"] * 3.6,
            "gained_m": np.maximum(climb, 0.0),
            "lost_m": np.maximum(-climb, 0.0),
            "ambient_c": rows["ambient"] - 273.15,
            "battery_temperature_c": rows["pack_temperature"] - 273.15,
            "precipitation_mm_h": rows["precipitation"] * 3.6e6,
            "wind_speed_kmh": np.hypot(rows["headwind"], rows["crosswind"]) * 3.6,
            "elapsed_s": rows["elapsed"] - 30.0,
            "parked_s": rows["parked"],
            "stops": rows["stop_rate"] * rows["dt"],
            "soc_start_pct": rows["charge"] * 100.0,
            "occupants": rows["occupants"],
            "odometer_km": rows["odometer"] / 1000.0,
            "wind_from_deg": np.degrees(np.arctan2(rows["crosswind"], rows["headwind"])),
            "latitude_start_deg": np.degrees(rows["latitude"]),
            "longitude_start_deg": np.degrees(rows["longitude"]),
            "latitude_end_deg": np.degrees(rows["latitude"]) + 0.01,  # due north
            "longitude_end_deg": np.degrees(rows["longitude"]),
            **energy,
        }
    )


def some_terms():
    """Yield carriers alone, with every variable in alternating shapes, and with pairs of variables."""
    windows = table(signals(300))
    kinds = [list({each.shape: each for each in list_modulators(v, v.value(windows))}.values()) for v in VARIABLES]
    for i, carrier in enumerate(CARRIERS):
        yield FormTerm(carrier)
        for j, shapes in enumerate(kinds):
            yield FormTerm(carrier, (shapes[(i + j) % len(shapes)],))
        yield FormTerm(carrier, (kinds[i][0], kinds[i + 2][-1]))


TERMS = list(some_terms())


def checked(term, path):
    """Return the effect that the source file of a term declares, after its check that the power is in watt."""
    path.write_text(format_source_file(term, -0.123, 4000), encoding="utf-8")
    (suggestion,) = registry._run(path)
    effects.check_effect(suggestion)
    return suggestion


def test_every_source_file_passes_check_and_matches_its_column(tmp_path):
    rows = signals(300)
    windows = table(rows)
    rows["tyre_load"] = 1500.0 * GRAVITY * np.sqrt(1.0 - rows["grade"] ** 2)
    for term in TERMS:
        suggestion = checked(term, tmp_path / "suggested.py")
        assert (suggestion.name, suggestion.unit, suggestion.formula) == (
            name_term(term),
            derive_unit(term),
            format_formula(term),
        )
        assert suggestion.sign == -1
        column = term.carrier.energy(windows)
        for each in term.modulators:
            column = column * each.evaluate(each.variable.value(windows))
        np.testing.assert_allclose(
            suggestion.power(rows) * 60.0 / 3.6e6, column, rtol=1e-6, atol=1e-12 * np.abs(column).max()
        )


def test_source_file_loads_as_effect(tmp_path, monkeypatch):
    monkeypatch.setattr(registry, "_library", dict(registry._library))
    monkeypatch.setattr(registry, "_brought_by", {})
    charge = VARIABLE["charge"]
    (hinge, *_) = (each for each in list_modulators(charge, charge.value(table(signals(300)))) if each.shape == "above")
    path = tmp_path / "suggested.py"
    path.write_text(format_source_file(FormTerm(CARRIER["braking"], (hinge,)), 4.0, 4000), encoding="utf-8")
    (effect,) = effects.load_file(path)
    assert effect.name == "suggested_braking_and_charge"
    assert effect.low < 4.0 < effect.high
    assert {each.name for each in effect.variants}  # the limit is profiled on tables


def test_formulas_and_units_are_readable():
    (hinge,) = (
        each
        for each in list_modulators(VARIABLE["ambient"], np.array([270.0, 283.0, 283.0, 290.0]))
        if (each.shape, each.at) == ("below", 283.0)
    )
    term = FormTerm(CARRIER["rolling"], (hinge,))
    assert format_formula(term) == "P = c · max(T0 − T, 0) · m g cos θ v, T0 = 283 K"
    assert (derive_unit(term), name_term(term)) == ("1/K", "suggested_rolling_and_ambient")
    rain = next(
        each for each in list_modulators(VARIABLE["precipitation"], np.linspace(0.0, 1e-6, 9)) if each.shape == "square"
    )
    assert derive_unit(FormTerm(CARRIER["auxiliary"], (rain, hinge))) == "W/(m/s)^2/K"
    assert format_formula(FormTerm(CARRIER["auxiliary"], (rain,))) == "P = c · r²"
