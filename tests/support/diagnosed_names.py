"""Make results of diagnosis with given names, as the benchmark of hidden effects reads them."""

from collections.abc import Sequence
from typing import Any

from socast.core.diagnose.records import NONE


def make_name(
    effect: str, probability: float = 0.95, credible: Sequence[str] = (), value: float = 1.0
) -> dict[str, Any]:
    """Return a name as diagnosis gives it."""
    return {
        "effect": effect,
        "variant": effect,
        "probability": probability,
        "credible_set": list(credible) or [effect],
        "scope": [],
        "columns": [f"effect_{effect}"],
        "gain": 0.01,
        "energy_share": 0.03,
        "z": 5.0,
        "coefficient": {"value": value, "ci95": [0.5 * value, 1.5 * value], "plausible": True},
    }


def make_result(*missing: dict[str, Any], deviations: Sequence[dict[str, Any]] = ()) -> dict[str, Any]:
    """Return a result of diagnosis."""
    first = missing[0]["credible_set"] if missing else [NONE]
    return {
        "missing": list(missing),
        "candidates": [{"effect": each["effect"]} for each in missing],
        "verdict": missing[0]["effect"] if missing else None,
        "causes": [{"effect": name, "probability": 1.0 / len(first)} for name in first],
        "credible_set": first,
        "further": [],
        "further_credible_set": [NONE] if missing else [],
        "unknown": [],
        "deviations": list(deviations),
        "error": {"mae_kwh": 0.1, "noise_floor_kwh": 0.05},
    }
