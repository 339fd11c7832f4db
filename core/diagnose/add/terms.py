"""Terms that effects become: where they hold, and whether they add up over the windows of a ride."""

from collections.abc import Sequence
from typing import Final

from core import effects
from core.errors import ModelError
from core.models import LinearModel, Term
from core.models.features import (
    ACCESSORIES_COLUMN,
    EFFECT_PREFIX,
    SINCE_SCOPE,
    VEHICLE_SCOPE,
    derive_coefficient_unit,
    get_unit,
    is_scope,
)

_AMOUNTS: Final = frozenset(
    {"distance_km", "duration_s", "gained_m", "lost_m", "stops", "basic_kwh", ACCESSORIES_COLUMN}
)
"""Columns of which a ride's is the sum of its windows', beside `effect_*` and the histogram of speeds."""
_ALIKE: Final = frozenset(
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
"""Columns that are the same, or nearly, in all windows of a ride."""


def build_term_columns(effect: str, scopes: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the columns of the term of an effect that holds within scopes.

    Raises
    ------
    EffectError, ModelError
        Where the effect is unknown, or a scope is none.

    Examples
    --------
    >>> scoped("cold_rolling", ["vehicle=taxi-003"])
    ('effect_cold_rolling', 'vehicle=taxi-003')
    """
    found = effects.get(effect)
    kinds = [scope.partition("=")[0] for scope in scopes]
    for scope, kind in zip(scopes, kinds, strict=True):
        if not is_scope(scope):
            raise ModelError(f"scope {scope!r} is none: write {VEHICLE_SCOPE}ID or {SINCE_SCOPE}YYYY-MM-DD")
        get_unit(scope)
        if kinds.count(kind) > 1:
            raise ModelError(f"scope {scope!r}: two of this kind are given: add the effect once for each")
    return (found.energy_name, *scopes)


def describe_scope(columns: Sequence[str]) -> str:
    """Return for whom and since when a term holds.

    Examples
    --------
    >>> scope_in_words(("effect_snow", "vehicle=taxi-003", "since=2018-06-01")), scope_in_words(("effect_snow",))
    ('vehicle taxi-003, since 2018-06-01', 'all')
    """
    return ", ".join(column.replace("=", " ", 1) for column in columns if is_scope(column)) or "all"


def is_additive(terms: Sequence[Term]) -> bool:
    """Tell whether what terms give to the windows of a ride adds up to what they give to the ride.

    A constant does not, nor does the square of a distance.
    """
    return all(sum(map(_is_amount, t.columns)) == 1 and all(map(_adds, t.columns)) for t in terms)


def _is_amount(column: str) -> bool:
    return column in _AMOUNTS or column.startswith((EFFECT_PREFIX, "speed_"))


def _adds(column: str) -> bool:
    return _is_amount(column) or column in _ALIKE or is_scope(column)


def build_effect_term(model: LinearModel, effect: str, columns: tuple[str, ...]) -> Term:
    """Return the term of the effect, where the model can take it."""
    if model.correction or model.cars:
        what = "boosted trees" if model.correction else "factors of single cars"
        raise ModelError(
            f"model {model.name} has {what}, which learn whatever is missing: add effects to a model without, such as "
            "one of the recipe road_load"
        )
    scopes = [column for column in columns if is_scope(column)]
    for term in model.terms:
        own = [c.removeprefix(EFFECT_PREFIX).partition("@")[0] for c in term.columns if c.startswith(EFFECT_PREFIX)]
        if effect.partition("@")[0] in own and sorted(filter(is_scope, term.columns)) == sorted(scopes):
            raise ModelError(
                f"effect {effect} is in model {model.name} already, as the term {term.name!r}: choose another, or give "
                "it a --scope"
            )
    return Term(name=", ".join([effect, *scopes]), columns=columns, unit=derive_coefficient_unit(columns))
