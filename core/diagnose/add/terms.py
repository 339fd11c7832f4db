"""Build the term of an effect, and describe its scope and its coefficient."""

from collections.abc import Sequence
from typing import Final

from socast.core import effects
from socast.core.diagnose.records import EstimatedCoefficient
from socast.core.effects import Effect
from socast.core.errors import ModelError
from socast.core.models import LinearModel, Term
from socast.core.models.features import (
    ACCESSORIES_COLUMN,
    EFFECT_PREFIX,
    SINCE_SCOPE,
    VEHICLE_SCOPE,
    derive_coefficient_unit,
    get_unit,
    is_scope,
    list_scope,
)
from socast.core.records import make_interval
from socast.core.stats.scores import Estimate

_AMOUNTS: Final = frozenset(
    {"distance_km", "duration_s", "gained_m", "lost_m", "stops", "basic_kwh", ACCESSORIES_COLUMN}
)
"""Columns whose value for a ride is the sum over its windows; `effect_*` and the speed histogram are such too."""
_CONSTANTS: Final = frozenset(
    {
        "rolling_resistance",
        "drag_area_m2",
        "mass_kg",
        "nominal_capacity_kwh",
        "accessory_scale",
        "winter",
        "summer",
        "odometer_km",
        "occupants",
        "ambient_c",
        "heating_need_k",
        "deep_cold_k",
        "cooling_need_k",
    }
)
"""Columns that are equal, or nearly equal, in all windows of a ride."""


def build_term_columns(effect: str, scope: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the columns of the term of an effect that holds within a scope.

    Parameters
    ----------
    scope : sequence of str
        `vehicle=ID`, `since=YYYY-MM-DD` or both; the term holds where all parts do.

    Examples
    --------
    >>> build_term_columns("cold_rolling", ["vehicle=taxi-003"])
    ('effect_cold_rolling', 'vehicle=taxi-003')
    """
    declared = effects.get(effect)
    kinds = [part.partition("=")[0] for part in scope]
    for part, kind in zip(scope, kinds, strict=True):
        if not is_scope(part):
            raise ModelError(f"scope {part!r} is not valid: write {VEHICLE_SCOPE}ID or {SINCE_SCOPE}YYYY-MM-DD")
        get_unit(part)
        if kinds.count(kind) > 1:
            raise ModelError(f"scope {part!r}: two scopes of this kind are given: add the effect once for each")
    return (declared.energy_name, *scope)


def name_scoped(effect: str, scope: Sequence[str]) -> str:
    """Return the name of an effect, and where it holds unless that is everywhere.

    Examples
    --------
    >>> name_scoped("snow", ["vehicle=taxi-003", "since=2018-06-01"]), name_scoped("snow", [])
    ('snow (vehicle=taxi-003, since=2018-06-01)', 'snow')
    """
    return f"{effect} ({', '.join(scope)})" if scope else effect


def is_additive(terms: Sequence[Term]) -> bool:
    """Return whether the contributions of terms to the windows of a ride add up to their contribution to the ride.

    A constant is not additive, and neither is the square of a distance.
    """
    return all(sum(map(_is_amount, t.columns)) == 1 and all(map(_keeps_additive, t.columns)) for t in terms)


def _is_amount(column: str) -> bool:
    """Return whether the value of a column for a ride is the sum over its windows."""
    return column in _AMOUNTS or column.startswith((EFFECT_PREFIX, "speed_"))


def _keeps_additive(column: str) -> bool:
    """Return whether a term with one amount stays additive with this column as a factor."""
    return _is_amount(column) or column in _CONSTANTS or is_scope(column)


def build_effect_term(model: LinearModel, effect: str, columns: tuple[str, ...]) -> Term:
    """Return the term of an effect that a model does not have yet."""
    if model.correction or model.cars:
        part = "boosted trees" if model.correction else "factors of single cars"
        raise ModelError(
            f"model {model.name} has {part}, which learn every missing effect: add effects to a model without them, "
            "such as one of the recipe road_load"
        )
    scope = list_scope(columns)
    for term in model.terms:
        of_term = [c.removeprefix(EFFECT_PREFIX).partition("@")[0] for c in term.columns if c.startswith(EFFECT_PREFIX)]
        if effect.partition("@")[0] in of_term and sorted(list_scope(term.columns)) == sorted(scope):
            raise ModelError(
                f"effect {effect} is in model {model.name} already, as the term {term.name!r}: choose another, or give "
                "it a --scope"
            )
    return Term(name=", ".join([effect, *scope]), columns=columns, unit=derive_coefficient_unit(columns))


def describe_coefficient(declared: Effect, estimate: Estimate) -> EstimatedCoefficient:
    """Return the record of a coefficient."""
    begin, end = estimate.interval
    return EstimatedCoefficient(
        value=estimate.value,
        ci95=make_interval(begin, end),
        unit=declared.unit,
        low=declared.low,
        high=declared.high,
        plausible=declared.is_plausible(begin, end),
    )


def warn_if_implausible(declared: Effect, estimate: Estimate) -> str:
    """Return what an implausible coefficient may mean, or an empty text where it is plausible."""
    value, low, high = estimate.value, declared.low, declared.high
    if low <= value <= high:
        return ""
    unit = "" if declared.unit == "1" else f" {declared.unit}"
    if declared.sign * value < 0.0:
        problem = f"it would {'save' if declared.sign > 0 else 'cost'} energy, which physics forbids"
    else:
        problem = f"it is too {'small' if abs(value) < min(abs(low), abs(high)) else 'large'}"
    if declared.is_plausible(*estimate.interval):
        cause = "its interval overlaps the range, so there may be too few data"
    else:
        others = ", ".join(declared.confused_with[:4])
        cause = "it may stand for another cause" + (f", such as {others}" if others else "")
    return (
        f"coefficient {value:.3g}{unit} is outside its plausible range, {low:g} to {high:g}{unit}: {problem}; {cause}"
    )


def explain_coefficient(declared: Effect, estimate: Estimate) -> str:
    """Return the physical meaning of a coefficient in words."""
    return declared.in_words(estimate.value, estimate.ci95)
