"""What makes a model file a good one, past the types of its fields."""

import re
from itertools import chain, pairwise
from math import isfinite
from typing import TYPE_CHECKING, Any, Final

import msgspec

from core.errors import EffectError, ModelError
from core.features import ACCESSORIES, unit

if TYPE_CHECKING:
    from core.models import Curve, Fit, LinearModel


_NUMBERS: Final = re.compile(rb"\[\n\s+([-+.\deE,\s]+?)\n\s+\]")
"""An array of numbers, one a line; no string matches, as JSON's strings have no line breaks."""


def readable(content: bytes) -> bytes:
    """Return JSON for people: indented, but an array of numbers on one line."""
    lines = msgspec.json.format(content, indent=2)
    return _NUMBERS.sub(lambda found: b"[" + b" ".join(found[1].split()) + b"]", lines) + b"\n"


def parsed(content: bytes, version: int) -> Any:
    """Return a file's JSON, of the format that is wanted.

    Raises
    ------
    ModelError
        Where it is not JSON, is no model, or is of another format.
    """
    try:
        raw = msgspec.json.decode(content)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise ModelError(f"no model file: not JSON: {error}") from error
    said = raw.get("format") if isinstance(raw, dict) else None
    if said is None or "terms" not in raw:
        raise ModelError("no model file: it has no 'format' and 'terms'; `socast fit` writes model files")
    if said != version:
        raise ModelError(f"model file of format {said!r}, and this version reads format {version}: fit the model anew")
    return raw


def check(model: "LinearModel") -> None:
    """Check names that stand once, columns and effects that exist, and that every fit fits the terms.

    Raises
    ------
    ModelError
        With the name of what is wrong.
    """
    names: set[str] = set()
    for term in model.terms:
        if term.name in names:
            raise ModelError(f"model {model.name}: term {term.name!r} stands twice: add their coefficients")
        names.add(term.name)
        _check_columns(f"model {model.name}: term {term.name!r}", term.columns)
    if not model.fits:
        raise ModelError(f"model {model.name}: it has no fits: fit the model anew")
    for key, fit in model.fits.items():
        _check_fit(f"model {model.name}: fit {key!r}", fit, model)
    for key, trees in (model.correction or {}).items():
        _check_columns(f"model {model.name}: correction {key!r}", trees.needs)
    for vehicle, factor in model.cars.items():
        _check_finite(f"model {model.name}: factor of car {vehicle!r}", factor)


def _check_columns(what: str, columns: tuple[str, ...]) -> None:
    """Check that columns are known, and hold no answer."""
    for column in columns:
        try:
            unit(column)
        except (EffectError, ModelError) as error:
            raise ModelError(f"{what}: {error}") from error


def _check_fit(what: str, fit: "Fit", model: "LinearModel") -> None:
    """Check a fit's shapes and numbers."""
    n = len(model.terms)
    if len(fit.coefficients) != n:
        raise ModelError(f"{what} has {len(fit.coefficients)} coefficients for {n} terms: fit the model anew")
    for term, coefficient in zip(model.terms, fit.coefficients, strict=True):
        _check_finite(f"{what}: coefficient of {term.name!r}", coefficient)
        if ACCESSORIES in term.columns and fit.curve is None:
            raise ModelError(f"{what} has no curve, and term {term.name!r} reads {ACCESSORIES}: fit the model anew")
    if fit.covariance is not None:
        if [len(row) for row in fit.covariance] != [n] * n:
            raise ModelError(f"{what}: its covariance is not {n} by {n}: fit the model anew")
        for value in chain.from_iterable(fit.covariance):
            _check_finite(f"{what}: covariance", value)
    _check_columns(f"{what}: fill", tuple(fit.fills))
    for column, value in fit.fills.items():
        _check_finite(f"{what}: fill of {column!r}", value)
    if fit.curve is not None:
        _check_curve(what, fit.curve)


def _check_curve(what: str, curve: "Curve") -> None:
    """Check that choke points ascend: between two that do not, there is no segment."""
    points = (curve.heating_full, curve.heating_off, curve.cooling_on, curve.cooling_full)
    if not all(a < b for a, b in pairwise(points)):
        raise ModelError(f"{what}: choke points of its curve, {points} K, do not ascend: fit the model anew")
    for level in (*points, curve.heating, curve.standby, curve.cooling):
        _check_finite(f"{what}: its curve", level)


def _check_finite(what: str, value: float) -> None:
    """Check a number."""
    if not isfinite(value):
        raise ModelError(f"{what} is {value}: fit the model anew")
