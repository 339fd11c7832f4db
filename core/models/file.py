"""What makes a model file a good one, past the types of its fields."""

import re
from hashlib import sha256
from itertools import chain, pairwise
from math import isfinite
from pathlib import Path
from typing import Any, Final

import msgspec

from core.errors import EffectError, ModelError
from core.models.built_in import BUILT_IN_MODELS
from core.models.features import ACCESSORIES_COLUMN, get_unit
from core.models.linear import FORMAT, Fit, LinearModel
from core.vehicles import AccessoryCurve

_NUMBERS: Final = re.compile(rb"\[\n\s+([-+.\deE,\s]+?)\n\s+\]")
"""An array of numbers, one a line; no string matches, as JSON's strings have no line breaks."""


def _format_json(content: bytes) -> bytes:
    """Return JSON for people: indented, but an array of numbers on one line."""
    lines = msgspec.json.format(content, indent=2)
    return _NUMBERS.sub(lambda found: b"[" + b" ".join(found[1].split()) + b"]", lines) + b"\n"


def _parse(content: bytes, version: int) -> Any:
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


def load(name_or_path: str | Path) -> LinearModel:
    """Return a model by name, or from its file.

    Parameters
    ----------
    name_or_path : str or Path
        A name of `KNOWN`, else the path of a model file.

    Raises
    ------
    ModelError
        Where it is neither; where the file is not JSON, is no model, is of another version, or names a column or an
        effect that is unknown.

    Examples
    --------
    >>> load("basic_physical").effects
    ('rolling', 'climbing', 'aero_drag', 'inertia')
    """
    if (known := BUILT_IN_MODELS.get(str(name_or_path))) is not None:
        return known
    path = Path(name_or_path)
    if not path.suffix and not path.exists():
        raise ModelError(
            f"model {str(path)!r} is unknown: known are {', '.join(BUILT_IN_MODELS)}; else give the path of a model file"
        )
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ModelError(
            f"{path}: cannot read a model: {error.strerror}; name a model file, or one of {', '.join(BUILT_IN_MODELS)}"
        ) from error
    try:
        return decode_model(content)
    except ModelError as error:
        raise ModelError(f"{path}: {error}") from error


def save(model: LinearModel, path: str | Path) -> None:
    """Write a model file, to be read again exactly, and by people.

    Raises
    ------
    ModelError
        Where a coefficient is not finite, or the file cannot be written.
    """
    content = encode_model(model)
    try:
        Path(path).write_bytes(content)
    except OSError as error:
        raise ModelError(
            f"{path}: cannot write the model: {error.strerror}; name a file in a folder that can be written"
        ) from error


def encode_model(model: LinearModel) -> bytes:
    """Return the model file's content; floats as the shortest text that reads back to the same number."""
    check_model(model)
    return _format_json(msgspec.json.encode(model))


def stamp(model: LinearModel) -> LinearModel:
    """Return a model with a version that follows from all else that its file holds."""
    content = encode_model(msgspec.structs.replace(model, version=""))
    return msgspec.structs.replace(model, version=sha256(content).hexdigest()[:12])


def decode_model(content: bytes) -> LinearModel:
    """Return the model that a file's content holds.

    Raises
    ------
    ModelError
        Where it is not JSON, is no model, is of another version, or names a column or an effect that is unknown.
    """
    raw = _parse(content, FORMAT)
    try:
        model = msgspec.convert(raw, LinearModel)
    except msgspec.ValidationError as error:
        raise ModelError(f"model file is damaged: {error}") from error
    check_model(model)
    return model


def check_model(model: LinearModel) -> None:
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
            get_unit(column)
        except (EffectError, ModelError) as error:
            raise ModelError(f"{what}: {error}") from error


def _check_fit(what: str, fit: Fit, model: LinearModel) -> None:
    """Check a fit's shapes and numbers."""
    n = len(model.terms)
    if len(fit.coefficients) != n:
        raise ModelError(f"{what} has {len(fit.coefficients)} coefficients for {n} terms: fit the model anew")
    for term, coefficient in zip(model.terms, fit.coefficients, strict=True):
        _check_finite(f"{what}: coefficient of {term.name!r}", coefficient)
        if ACCESSORIES_COLUMN in term.columns and fit.curve is None:
            raise ModelError(
                f"{what} has no curve, and term {term.name!r} reads {ACCESSORIES_COLUMN}: fit the model anew"
            )
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


def _check_curve(what: str, curve: AccessoryCurve) -> None:
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
