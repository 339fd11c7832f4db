"""Test free-form terms: planted terms are recovered, noise gives no suggestion, and source files pass the check."""

import numpy as np
import pandas as pd
import pytest

from socast.core import effects
from socast.core.columns import GRAVITY, STANDARD_AIR_DENSITY
from socast.core.diagnose.free_form.building_blocks import CARRIERS, VARIABLES
from socast.core.diagnose.free_form.search import suggest_term
from socast.core.diagnose.free_form.suggestion import derive_unit, format_formula, format_source_file, name_term
from socast.core.diagnose.free_form.terms import FreeTerm, list_modulators
from socast.core.effects import registry
from socast.core.signals.signals import CIVIL_DUSK
from socast.core.signals.sun import sine_of_elevation

pytestmark = pytest.mark.long

CARRIER = {each.name: each for each in CARRIERS}
VARIABLE = {each.name: each for each in VARIABLES}
SD = 0.008
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
            "latitude_start_deg": np.degrees(rows["latitude"]),
            "longitude_start_deg": np.degrees(rows["longitude"]),
            **energy,
        }
    )


def suggest(windows, day, power, *, seed=1, day_sd=0.0015):
    """Return the suggestion for noise and a power in watt."""
    rng = np.random.default_rng(seed)
    sd = SD * rng.uniform(0.5, 2.0, len(windows))
    noise = rng.normal(0.0, 1.0, len(windows)) * sd + day_sd * rng.normal(0.0, 1.0, 60)[day]
    residual = noise + power * windows["duration_s"].to_numpy() / 3.6e6
    return suggest_term(windows, residual, sd**-2, day, windows[list(BASE)].to_numpy())


@pytest.fixture(scope="module")
def driving():
    rows = signals(4000)
    return rows, table(rows)


ROLLING = 1500.0 * GRAVITY
PLANTED = {
    "auxiliary": ({"darkness", "precipitation"}, lambda r: 3e9 * r["darkness"] ** 2 * r["precipitation"]),
    "rolling": ({"occupants"}, lambda r: 2e-4 * r["occupants"] ** 2 * ROLLING * r["speed"]),
    "braking": (
        {"charge"},
        lambda r: 4.0 * np.maximum(r["charge"] - 0.8, 0.0) * 1500.0 * np.maximum(-r["acceleration"], 0.0) * r["speed"],
    ),
    "drag": (
        {"pack_temperature"},
        lambda r: (
            0.01 * np.maximum(278.0 - r["pack_temperature"], 0.0) * (0.5 * STANDARD_AIR_DENSITY * r["speed"] ** 3)
        ),
    ),
    "stopping": ({"occupants"}, lambda r: 9e3 * r["occupants"] * r["stop_rate"]),
}


@pytest.mark.parametrize("carrier", PLANTED)
def test_planted_term_outside_library_is_recovered(driving, carrier):
    rows, windows = driving
    variables, power = PLANTED[carrier]
    true = power(rows)
    suggestion = suggest(windows, rows["day"], true)
    assert suggestion.term.carrier.name == carrier
    assert suggestion.term.variables == variables
    assert suggestion.gain_ci95[0] < suggestion.gain < suggestion.gain_ci95[1]
    assert suggestion.gain_ci95[0] > 0.0
    assert suggestion.ci95[0] < suggestion.coefficient < suggestion.ci95[1]
    assert suggestion.formula == format_formula(suggestion.term)
    suggested = suggestion.coefficient * suggestion.column * 3.6e6 / 60.0
    base = np.column_stack([windows[list(BASE)].to_numpy(), np.ones(len(windows))])
    new, truly = (x - base @ np.linalg.lstsq(base, x, rcond=None)[0] for x in (suggested, true))
    assert np.corrcoef(new, truly)[0, 1] > 0.9
    assert np.sum(new * truly) / np.sum(truly**2) == pytest.approx(1.0, abs=0.2)


def test_interval_of_coefficient_covers_true_value_of_correct_term(driving):
    rows, windows = driving
    covered = 0
    for seed in range(8):
        suggestion = suggest(windows, rows["day"], 3.0 * rows["occupants"] * ROLLING * rows["speed"] * 1e-4, seed=seed)
        assert format_formula(suggestion.term) == "P = c · N · m g cos θ v"
        covered += suggestion.ci95[0] <= 3e-4 <= suggestion.ci95[1]
    assert covered >= 6


def test_noise_gives_no_suggestion():
    rows = signals(900, seed=2)
    windows = table(rows)
    silence = np.zeros(len(windows))
    suggested = [suggest(windows, rows["day"], silence, seed=seed, day_sd=0.0015 * (seed % 3)) for seed in range(50)]
    assert sum(suggestion is not None for suggestion in suggested) <= 2


def test_terms_that_model_can_refit_are_not_suggested(driving):
    rows, windows = driving
    assert suggest(windows, rows["day"], 0.004 * ROLLING * rows["speed"] + 300.0) is None


def test_term_with_too_small_gain_is_not_suggested(driving):
    rows, windows = driving
    residual = np.random.default_rng(0).normal(0.0, SD, len(windows))
    residual += windows["effect_rolling"].to_numpy() * rows["occupants"] * 3e-4
    base, weight = windows[list(BASE)].to_numpy(), np.full(len(windows), SD**-2)
    suggestion = suggest_term(windows, residual, weight, rows["day"], base)
    assert suggestion.gain > 0.01
    assert suggest_term(windows, residual, weight, rows["day"], base, least_gain=2.0 * suggestion.gain) is None


def test_suggestion_handles_unknown_values_few_clusters_and_row_order(driving):
    rows, windows = driving
    holed = windows.assign(occupants=np.nan, battery_temperature_c=np.nan)
    holed.loc[::9, ["parked_s", "precipitation_mm_h", "wind_speed_kmh"]] = np.nan
    true = PLANTED["braking"][1](rows)
    residual = np.random.default_rng(0).normal(0.0, SD, len(windows)) + true * 60.0 / 3.6e6
    residual[::13] = np.nan
    base, weight = windows[list(BASE)].to_numpy(), np.ones(len(windows))
    suggestion = suggest_term(holed, residual, weight, rows["day"], base)
    assert (suggestion.term.carrier.name, set(suggestion.term.variables)) == ("braking", {"charge"})
    assert np.array_equal(np.isnan(suggestion.column), np.isnan(residual))
    order = np.random.default_rng(1).permutation(len(windows))
    shuffled = suggest_term(holed.iloc[order], residual[order], weight, rows["day"][order], base[order])
    assert shuffled.formula == suggestion.formula
    assert shuffled.coefficient == pytest.approx(suggestion.coefficient)
    np.testing.assert_allclose(shuffled.column, suggestion.column[order])
    assert suggest_term(holed, residual, weight, rows["day"] % 5, base) is None
    assert suggest_term(holed, residual, weight, rows["day"], base[:, :0]).term.carrier.name == "braking"
    assert suggest_term(holed.iloc[:0], residual[:0], weight[:0], rows["day"][:0], base[:0]) is None


def some_terms():
    """Yield carriers alone, with every variable in alternating shapes, and with pairs of variables."""
    windows = table(signals(300))
    kinds = [list({each.shape: each for each in list_modulators(v, v.value(windows))}.values()) for v in VARIABLES]
    for i, carrier in enumerate(CARRIERS):
        yield FreeTerm(carrier)
        for j, shapes in enumerate(kinds):
            yield FreeTerm(carrier, (shapes[(i + j) % len(shapes)],))
        yield FreeTerm(carrier, (kinds[i][0], kinds[i + 2][-1]))


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
    rows["tyre_load"] = ROLLING * np.sqrt(1.0 - rows["grade"] ** 2)
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


def test_source_file_loads_as_effect(driving, tmp_path, monkeypatch):
    monkeypatch.setattr(registry, "_library", dict(registry._library))
    monkeypatch.setattr(registry, "_brought_by", {})
    rows, windows = driving
    suggestion = suggest(windows, rows["day"], PLANTED["braking"][1](rows))
    path = tmp_path / "suggested.py"
    path.write_text(suggestion.file, encoding="utf-8")
    (effect,) = effects.load_file(path)
    assert effect.name == "suggested_braking_and_charge"
    assert effect.low < suggestion.coefficient < effect.high
    assert {each.name for each in effect.variants}  # the limit is profiled on tables


def test_formulas_and_units_are_readable():
    (hinge,) = (
        each
        for each in list_modulators(VARIABLE["ambient"], np.array([270.0, 283.0, 283.0, 290.0]))
        if (each.shape, each.at) == ("below", 283.0)
    )
    term = FreeTerm(CARRIER["rolling"], (hinge,))
    assert format_formula(term) == "P = c · max(T0 − T, 0) · m g cos θ v, T0 = 283 K"
    assert (derive_unit(term), name_term(term)) == ("1/K", "suggested_rolling_and_ambient")
    rain = next(
        each for each in list_modulators(VARIABLE["precipitation"], np.linspace(0.0, 1e-6, 9)) if each.shape == "square"
    )
    assert derive_unit(FreeTerm(CARRIER["auxiliary"], (rain, hinge))) == "W/(m/s)^2/K"
    assert format_formula(FreeTerm(CARRIER["auxiliary"], (rain,))) == "P = c · r²"
