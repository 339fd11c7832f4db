"""The coefficient of an effect that was added to a model, as it is told: interval, plausible range, words."""

from collections.abc import Mapping
from typing import Any

from core.diagnose.add.refit import CoefficientEstimate
from core.effects.declaration import Effect


def describe_coefficient(declared: Effect, found: CoefficientEstimate) -> dict[str, Any]:
    """Return a coefficient as JSON has it.

    Returns
    -------
    dict
        `value`, `ci95` (lower and upper end of the 95 % interval), `unit`, `low`, `high` (of the plausible range),
        `plausible`.
    """
    return {
        "value": found.value,
        "ci95": [found.value - found.half, found.value + found.half],
        "unit": declared.unit,
        "low": declared.low,
        "high": declared.high,
        "plausible": declared.low <= found.value <= declared.high,
    }


def warn_if_implausible(declared: Effect, found: CoefficientEstimate) -> str:
    """Return what an implausible coefficient may mean, nothing where it is plausible."""
    value, low, high = found.value, declared.low, declared.high
    if low <= value <= high:
        return ""
    unit = "" if declared.unit == "1" else f" {declared.unit}"
    if declared.sign * value < 0.0:
        what = f"it would {'save' if declared.sign > 0 else 'cost'} energy, which physics forbids"
    else:
        what = f"it is too {'small' if abs(value) < min(abs(low), abs(high)) else 'large'}"
    if value - found.half <= high and value + found.half >= low:
        why = "its interval reaches into the range, so the data may be too few to tell"
    else:
        alike = ", ".join(declared.confused_with[:4])
        why = "something else may hide behind it" + (f", such as {alike}" if alike else "")
    return f"coefficient {value:.3g}{unit} is outside its plausible range, {low:g} to {high:g}{unit}: {what}; {why}"


def put_in_words(declared: Effect, found: Mapping[str, Any]) -> str:
    """Return what a coefficient, as `told` has it, means to people."""
    low, high = found["ci95"]
    return declared.in_words(found["value"], (high - low) / 2.0)
