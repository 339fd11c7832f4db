"""Make a diagnosis as `socast.core.diagnose.diagnosis` returns it, for tests of reports."""

from typing import Any, TypeVar

import msgspec
from msgspec.structs import replace

from socast.core.diagnose.records import (
    CarDeviation,
    CauseProbability,
    Diagnosis,
    ErrorAfterEffect,
    FoundEpisode,
    LocatedLoad,
    NamedEffect,
    PartialResidual,
    RankedCar,
    ResidualProfile,
    UnknownCause,
)
from socast.core.records import Record, to_json_values

Kind = TypeVar("Kind", bound=Record)


def _convert(values: dict[str, Any], kind: type[Kind]) -> Kind:
    """Return a record from JSON values and records."""
    return msgspec.convert(to_json_values(values), kind)


def make_missing_effect(**changes: Any) -> NamedEffect:
    """Return the entry of a missing effect."""
    return _convert({
        "effect": "cold_rolling",
        "variant": "cold_rolling@reference=283.15",
        "probability": 0.87,
        "causes": make_causes(),
        "credible_set": ["cold_rolling", "air_density"],
        "scope": [],
        "columns": ["effect_cold_rolling@reference=283.15"],
        "gain": 0.031,
        "gain_ci95": [0.02, 0.042],
        "energy_share": 0.029,
        "z": 11.0,
        "coefficient": {
            "value": 1.1e-4, "ci95": [0.9e-4, 1.3e-4], "unit": "1/K", "low": 2e-5, "high": 3e-4, "plausible": True,
        },
        "words": "cold tyres: rolling resistance grows by 1.1 ± 0.2 % of 0.010 for each degree below 10 °C",
        "equivalents": ["+1.2 m/s of headwind", "+180 kg"],
        "separate": [{"effect": "air_density", "correlation": 0.83, "data": "slow drives over a year"}],
        "partial_residual": make_partial_residual(),
    } | changes, NamedEffect)  # fmt: skip


def make_causes() -> list[CauseProbability]:
    """Return the probabilities of causes."""
    rows: list[dict[str, Any]] = [
        {"effect": "cold_rolling", "probability": 0.87},
        {"effect": "air_density", "probability": 0.1},
        {"effect": "none", "probability": 0.03},
    ]
    return [_convert(row, CauseProbability) for row in rows]


def make_partial_residual() -> PartialResidual:
    """Return the bins of a partial residual whose slope is 1.1e-4, with two cars."""
    bins = {
        "x": [0.0, 1e5, 2e5], "before": [0.1, 11.2, 21.9], "after": [0.1, 0.2, -0.1], "ci95": [2.0, 1.5, None],
        "windows": [400, 380, 20], "days": [10, 9, 1],
    }  # fmt: skip
    cars = [
        {"car": "taxi-001", "slope": 1.2e-4, "slope_ci95": [0.8e-4, 1.6e-4], **bins},
        {"car": "taxi-002", "slope": 1.0e-4, "slope_ci95": [0.7e-4, 1.3e-4], **bins},
    ]
    return _convert({
        "per": "km", "quantity": "growth of the rolling resistance", "summary": "Cold tyres.", "unit": "1/K",
        "slope": 1.1e-4, "slope_ci95": [0.9e-4, 1.3e-4], **bins, "cars": cars,
    }, PartialResidual)  # fmt: skip


def make_step(effect: str | None, mae_kwh: float, **changes: Any) -> ErrorAfterEffect:
    """Return one step of the falling error."""
    unknown = {"change_kwh": None, "change_ci95_kwh": None}
    return _convert({
        "effect": effect, "scope": [], "mae_kwh": mae_kwh, "mae_ci95_kwh": 0.004, "noise_floor_kwh": 0.037,
        **unknown,
    } | changes, ErrorAfterEffect)  # fmt: skip


def make_profile(feature: str, unit: str, x: list[Any]) -> ResidualProfile:
    """Return the mean residual in three bins of a feature."""
    return _convert({
        "feature": feature, "unit": unit, "x": x, "before_w": [-300.0, 20.0, 310.0], "after_w": [-10.0, 5.0, 60.0],
        "ci95_w": [40.0, 30.0, 50.0], "windows": [900, 800, 700], "days": [10, 10, 9],
    }, ResidualProfile)  # fmt: skip


def make_located_load(level="ride", *, claimed=True) -> LocatedLoad:
    """Return the entry of a constant load of ±640 W of each unit of a level."""
    size = {"size": 640.0, "low": 610.0, "high": 672.0, "unit": "W"}
    watts = {f"{name}_w": value for name, value in size.items() if name != "unit"}
    rivals = {"other_kinds": [], "other_levels": []}
    return _convert(
        {
            "level": level,
            "kind": "constant",
            **size,
            **watts,
            "gain": 90.0,
            "claimed": claimed,
            "floor_w": 50.0,
            **rivals,
        },
        LocatedLoad,
    )


def make_diagnosis(**changes: Any) -> Diagnosis:
    """Return a complete diagnosis: two missing effects, and structure that no effect explains."""
    of_one = make_missing_effect(
        effect="brake_drag", variant="brake_drag", scope=["vehicle=taxi-003"],
        columns=["effect_brake_drag", "vehicle=taxi-003"], gain=0.006, gain_ci95=[0.001, 0.011], energy_share=0.004,
        coefficient={"value": 75.0, "ci95": [50.0, 100.0], "unit": "N", "low": 0.0, "high": 60.0,
        "plausible": False}, words="brakes rub with 75 ± 25 N", equivalents=[], separate=[],
    )  # fmt: skip
    return _convert({
        "model": {"name": "road_load", "version": "abc123def456", "recipe": "road_load"},
        "data": {
            "rides": 634, "windows": 7428, "vehicles": 5, "days": 10, "first_date": "2018-01-15",
            "last_date": "2018-09-13", "measured": "vi", "resolution_s": 60.0,
            "resolution": "voltage and current, in windows of about 60 s", "left_out": {"too_short": 12},
            "held_out": {"dates": ["2018-01-17", "2018-01-22"], "rides": 140, "final": True, "in_history": False},
        },
        "episodes": [],
        "error": {
            "mae_kwh": 0.062, "relative": 0.09, "bias_kwh": -0.012, "mae_refitted_kwh": 0.055,
            "noise_floor_kwh": 0.037,
        },
        "error_location": {
            "loads": [make_located_load()],
            "estimates": [make_located_load(), make_located_load("day", claimed=False)],
            "shares": {"measurement": 0.34, "scatter": 0.26, "ride": 0.4},
            "levels": ["ride", "day"],
            "absent_kinds": [],
            "absent_signals": ["wind", "climate power"],
        },
        "slices": [
            {"where": "below 0 °C and longer than 10 km", "conditions": ["below 0 °C", "longer than 10 km"],
             "rides": 71, "bias_kwh": -0.11, "ci95": [-0.15, -0.07], "mae_kwh": 0.13, "q": 0.001},
        ],
        "missing": [make_missing_effect(), of_one],
        "candidates": [
            {"effect": "cold_rolling", "variant": "cold_rolling@reference=283.15", "z": 6.1, "probability": 0.87,
             "gain": 0.031, "status": "missing"},
            {"effect": "snow", "variant": "snow", "z": None, "probability": None, "gain": None,
             "status": "not in the data"},
            {"effect": "wet_road", "variant": "wet_road", "z": 0.4, "probability": 0.01, "gain": -0.0001,
             "status": "not there"},
        ],
        "verdict": "cold_rolling",
        "unknown": [make_unknown_cause()],
        "steps": [
            make_step(None, 0.055),
            make_step("cold_rolling", 0.048, change_kwh=-0.007, change_ci95_kwh=0.002),
            make_step("brake_drag", 0.046, scope=["vehicle=taxi-003"], change_kwh=-0.002, change_ci95_kwh=0.001),
        ],
        "profiles": [
            make_profile("average_speed_kmh", "km/h", [10.0, 30.0, 60.0]),
            make_profile("vehicle_id", "", ["taxi-001", "taxi-002", "taxi-003"]),
        ],
        "causes": make_causes(),
        "credible_set": ["cold_rolling", "air_density"],
        "further": [{"effect": "none", "probability": 0.8}, {"effect": "snow", "probability": 0.2}],
        "further_credible_set": ["none"],
        "deviations": [make_deviation()],
        "cars": [make_ranked_car("taxi-005", 0.031), make_ranked_car("taxi-002", -0.01)],
    } | changes, Diagnosis)  # fmt: skip


def make_unknown_cause(**changes: Any) -> UnknownCause:
    """Return the entry of something outside the library."""
    return _convert({
        "formula": "P = c · d · r", "probability": 0.97, "energy_share": 0.024, "energy_share_ci95": [0.01, 0.038],
        "coefficient": {"value": 3.1e8, "ci95": [1.3e8, 4.9e8], "unit": "W/(m/s)"},
        "symbols": {"d": "darkness", "r": "rain or melted snow that falls in a time"},
        "forms": {"P = c · d · r": 0.7, "P = c · d² · r": 0.25},
        "file": '"""An effect of your own."""\n',
    } | changes, UnknownCause)  # fmt: skip


def make_episode(**changes: Any) -> FoundEpisode:
    """Return the entry of an episode of three cars on two dates."""
    return _convert({
        "dates": ["2018-01-17", "2018-03-02"], "hours_utc": [16, 19], "whole_dates": False, "car": None,
        "cars": ["taxi-001", "taxi-003", "taxi-005"], "cars_driving": 4, "windows": 120,
        "rides": ["taxi-003#7", "taxi-001#9", "taxi-005#9"], "power_kw": 6.02, "power_ci95_kw": [5.66, 6.38],
        "share": 0.414, "chance": 2e-9,
    } | changes, FoundEpisode)  # fmt: skip


def make_deviation(**changes: Any) -> CarDeviation:
    """Return the entry of a car that uses more since a date."""
    return _convert({
        "who": "taxi-005", "of": "car", "kind": "step", "effect": "tyre_pressure",
        "causes": [
            {"effect": "tyre_pressure", "probability": 0.52, "shown_by": "drives with loads that differ"},
            {"effect": "brake_drag", "probability": 0.41, "shown_by": "drives with loads that differ"},
        ],
        "q": 0.0002, "z": 6.1, "evidence": 15.2, "tests": 1000,
        "coefficient": {
            "value": 0.0016, "ci95": [0.0011, 0.0021], "unit": "1", "low": 0.0003, "high": 0.006, "plausible": True,
        },
        "words": "soft tyres: rolling resistance is higher by 16 ± 5 % of 0.010",
        "since": "2018-11-14", "since_ci90": ["2018-11-12", "2018-11-16"],
        "columns": ["effect_tyre_pressure", "vehicle=taxi-005", "since=2018-11-14"],
        "share": 0.041, "share_ci95": [0.032, 0.05],
        "kwh_per_km": 0.0062, "kwh_per_km_ci95": [0.0048, 0.0076],
        "kwh_per_month": 12.1, "kwh_per_month_ci95": [9.4, 14.8],
        "shifts": [
            {"start_s": 1.5420e9 + 86_400.0 * day, "share": 0.04 * (day > 8) + 0.002 * day, "error": 0.01,
             "size": float(day > 8)} for day in range(20)
        ],
    } | changes, CarDeviation)  # fmt: skip


def make_ranked_car(car: str, share: float) -> RankedCar:
    """Return the entry of a car in the ranking."""
    return _convert({
        "car": car, "siblings": 3, "evidence": 100.0 * abs(share), "share": share,
        "share_ci95": [share - 0.02, share + 0.02], "share_spread": 0.024,
        "spreads": [
            {"direction": "rolling", "value": 40.0 * share, "error": 0.4},
            {"direction": "drag", "value": -0.2, "error": 0.8},
        ],
    }, RankedCar)  # fmt: skip


def make_empty_diagnosis(**changes: Any) -> Diagnosis:
    """Return a diagnosis without missing effects, slices and structure."""
    whole = make_diagnosis()
    empty = {
        "error_location": replace(whole.error_location, loads=()),
        "slices": [], "missing": [], "verdict": None, "unknown": [], "steps": whole.steps[:1],
        "deviations": [], "cars": [],
    }  # fmt: skip
    return make_diagnosis(**(empty | changes))
