"""Built-in models, and model files: reading, writing, versions, and checks beyond the types of the fields.

The built-in models are the physical models of the paper that need no fitting.
"""

import re
from collections.abc import Mapping
from hashlib import sha256
from itertools import chain, pairwise
from math import isfinite
from pathlib import Path
from types import MappingProxyType
from typing import Final

import msgspec

from socast.core.errors import EffectError, ModelError, read_input
from socast.core.files import UNREADABLE, write_whole
from socast.core.models.features import ACCESSORIES_COLUMN, get_unit
from socast.core.models.interval import ANY
from socast.core.models.linear import FORMAT, Fit, LinearModel, Term
from socast.core.vehicles import AccessoryCurve

_NUMBERS: Final = re.compile(rb"\[\n\s+([-+.\deE,\s]+?)\n\s+\]")
"""Array of numbers, one per line. It matches no string, because JSON strings have no line breaks."""


def make_physical_term(name: str, columns: tuple[str, ...]) -> Term:
    """Return a term whose coefficient is 1 where physics holds."""
    return Term(name=name, columns=columns, unit="1")


BASIC_TERMS: Final = (
    make_physical_term("rolling", ("effect_rolling", "rolling_resistance")),
    make_physical_term("climbing", ("effect_climbing",)),
    make_physical_term("aero_drag", ("effect_aero_drag", "drag_area_m2")),
    make_physical_term("inertia", ("effect_inertia",)),
)
_EXTENDED_TERMS: Final = (*BASIC_TERMS, make_physical_term("accessories", ("effect_accessories",)))

BASIC_PHYSICAL: Final = LinearModel(
    name="basic_physical",
    version="1",
    recipe="basic_physical",
    terms=BASIC_TERMS,
    fits={ANY: Fit(coefficients=(1.0,) * len(BASIC_TERMS))},
)
"""Basic physical model, eq. (1) and section 4.1 of the paper: energy at the wheels with the catalogue's parameters."""

EXTENDED_PHYSICAL: Final = LinearModel(
    name="extended_physical",
    version="1",
    recipe="extended_physical",
    terms=_EXTENDED_TERMS,
    fits={ANY: Fit(coefficients=(1.0,) * len(_EXTENDED_TERMS))},
)
"""Extended physical model, section 4.2 of the paper, with the reference accessory curve; `socast.core.fit` fits one."""

BUILT_IN_MODELS: Final[Mapping[str, LinearModel]] = MappingProxyType(
    {model.name: model for model in (BASIC_PHYSICAL, EXTENDED_PHYSICAL)}
)
"""Models that come with the product and need no fitting, by name."""
HILLS_OF_BUILT_IN: Final = (
    "as in the paper, a descent returns all that the climb took, so a hill up and down costs nothing"
)
"""What readers of the predictions of `BUILT_IN_MODELS` need to know."""


def _format_json(content: bytes) -> bytes:
    """Return indented JSON for people, with each array of numbers on one line."""
    lines = msgspec.json.format(content, indent=2)
    return _NUMBERS.sub(lambda match: b"[" + b" ".join(match[1].split()) + b"]", lines) + b"\n"


def load(name_or_path: str | Path, *, verify: bool = True) -> LinearModel:
    """Return a model by name, or from its file.

    Parameters
    ----------
    name_or_path : str or Path
        Name of a built-in model (`BUILT_IN_MODELS`), or the path of a model file.
    verify : bool
        Refuse a file whose version does not follow from its content. Without it, an edited file is read as it is;
        `save` then writes it with a new version.

    Raises
    ------
    ModelError
        Where the argument is neither; where the file is not JSON, is not a model, has another format, was edited after
        it was written, or names an unknown column or effect.

    Examples
    --------
    >>> load("basic_physical").effects
    ('rolling', 'climbing', 'aero_drag', 'inertia')
    """
    if (known := BUILT_IN_MODELS.get(str(name_or_path))) is not None:
        return known
    path = Path(name_or_path)
    if path.is_dir():
        raise ModelError(
            f"{path} is a folder, not a model: name the model file that `socast fit` wrote, or one of "
            f"{', '.join(BUILT_IN_MODELS)}"
        )
    if not path.suffix and not path.exists():
        raise ModelError(
            f"model {str(path)!r} is unknown: name one of {', '.join(BUILT_IN_MODELS)}, or give the path of a file"
        )
    try:
        content = read_input(path)
    except OSError as error:
        raise ModelError(
            f"{path}: cannot read a model: {error.strerror}; name a model file, or one of {', '.join(BUILT_IN_MODELS)}"
        ) from error
    try:
        model = decode_model(content)
    except ModelError as error:
        raise ModelError(f"{path}: {error}") from error
    expected = stamp(model).version
    if verify and model.version != expected:
        raise ModelError(
            f"{path}: version {model.version!r} does not follow from the content, which has version {expected!r}: the "
            "file was edited after it was written, or an earlier release wrote it: refit the model, or accept the "
            f"content with `socast.save_model(socast.load_model({str(path)!r}, verify=False), {str(path)!r})`"
        )
    return model


def save(model: LinearModel, path: str | Path) -> None:
    """Write a model file, readable by people, from which `load` reads exactly the same numbers.

    The file carries the version that follows from its content (`stamp`). Fitted models have this version already; a
    built-in model, or one that was changed in Python, gets it in the file.

    Parameters
    ----------
    model : LinearModel
        Model to write.
    path : str or Path
        File to write; an existing file is replaced as a whole, and remains if the new one cannot be written.

    Raises
    ------
    ModelError
        Where a coefficient is not finite, or the file cannot be written.
    """
    content = encode_model(stamp(model))
    try:
        write_whole(Path(path), content)
    except OSError as error:
        raise ModelError(
            f"{path}: cannot write the model: {error.strerror}; name a file in a folder that can be written"
        ) from error


def encode_model(model: LinearModel) -> bytes:
    """Return the content of a model file; floats as the shortest text that reads back to the same number.

    Raises
    ------
    ModelError
        Where the model is invalid, see `check_model`.
    """
    check_model(model)
    return _format_json(msgspec.json.encode(model))


def stamp(model: LinearModel) -> LinearModel:
    """Return a model with the version that follows from all other contents of its file, except its history.

    Entries of the history, such as a refused effect, change no prediction and so no version.

    Parameters
    ----------
    model : LinearModel
        Model with any version.
    """
    content = _format_json(msgspec.json.encode(msgspec.structs.replace(model, version="", history=())))
    return msgspec.structs.replace(model, version=sha256(content).hexdigest()[:12])


def decode_model(content: bytes) -> LinearModel:
    """Return the model of a file's content. Its version is not verified.

    Raises
    ------
    ModelError
        Where the content is not JSON, is not a model, has another format, or names an unknown column or effect.
    """
    try:
        raw = msgspec.json.decode(content)
    except UNREADABLE as error:
        raise ModelError(f"no model file: not JSON: {error}: `socast fit` writes model files") from error
    format_ = raw.get("format") if isinstance(raw, dict) else None
    if format_ is None or "terms" not in raw:
        raise ModelError("no model file: it has no 'format' and 'terms': `socast fit` writes model files")
    if format_ != FORMAT:
        raise ModelError(
            f"model file of format {format_!r}, and this version reads format {FORMAT}: fit the model again"
        )
    try:
        model = msgspec.convert(raw, LinearModel)
    except UNREADABLE as error:
        raise ModelError(f"model file is damaged: {error}: fit the model again") from error
    check_model(model)
    return model


def check_model(model: LinearModel) -> None:
    """Check that names are unique, that columns and effects exist, and that every fit matches the terms.

    Raises
    ------
    ModelError
        With the name of the invalid part.
    """
    names: set[str] = set()
    for term in model.terms:
        if term.name in names:
            raise ModelError(f"model {model.name}: term {term.name!r} occurs twice: add their coefficients")
        names.add(term.name)
        _check_columns(f"model {model.name}: term {term.name!r}", term.columns)
    if not model.fits:
        raise ModelError(f"model {model.name}: it has no fits: fit the model again")
    for key, fit in model.fits.items():
        _check_fit(f"model {model.name}: fit {key!r}", fit, model)
    for key, trees in (model.correction or {}).items():
        _check_columns(f"model {model.name}: correction {key!r}", trees.needs)
    for vehicle, factor in model.cars.items():
        _check_finite(f"model {model.name}: factor of car {vehicle!r}", factor)


def _check_columns(what: str, columns: tuple[str, ...]) -> None:
    """Check that columns are known and do not hold the answer."""
    for column in columns:
        try:
            get_unit(column)
        except (EffectError, ModelError) as error:
            raise ModelError(f"{what}: {error}") from error


def _check_fit(what: str, fit: Fit, model: LinearModel) -> None:
    """Check the shapes and numbers of a fit."""
    n = len(model.terms)
    if len(fit.coefficients) != n:
        raise ModelError(f"{what} has {len(fit.coefficients)} coefficients for {n} terms: fit the model again")
    for term, coefficient in zip(model.terms, fit.coefficients, strict=True):
        _check_finite(f"{what}: coefficient of {term.name!r}", coefficient)
        if ACCESSORIES_COLUMN in term.columns and fit.curve is None:
            raise ModelError(
                f"{what} has no curve, and term {term.name!r} reads {ACCESSORIES_COLUMN}: fit the model again"
            )
    if fit.covariance is not None:
        if [len(row) for row in fit.covariance] != [n] * n:
            raise ModelError(f"{what}: its covariance is not {n} by {n}: fit the model again")
        for value in chain.from_iterable(fit.covariance):
            _check_finite(f"{what}: covariance", value)
    for value in msgspec.structs.astuple(fit.limit) if fit.limit else ():
        _check_finite(f"{what}: its limit", value)
    _check_columns(f"{what}: fill", tuple(fit.fills))
    for column, value in fit.fills.items():
        _check_finite(f"{what}: fill of {column!r}", value)
    if fit.curve is not None:
        _check_curve(what, fit.curve)


def _check_curve(what: str, curve: AccessoryCurve) -> None:
    """Check that the choke points ascend, as segments between them need a positive width."""
    points = (curve.heating_full, curve.heating_off, curve.cooling_on, curve.cooling_full)
    if not all(a < b for a, b in pairwise(points)):
        raise ModelError(f"{what}: choke points of its curve, {points} K, do not ascend: fit the model again")
    for level in (*points, curve.heating, curve.standby, curve.cooling):
        _check_finite(f"{what}: its curve", level)


def _check_finite(what: str, value: float) -> None:
    """Refuse a number that is not finite."""
    if not isfinite(value):
        raise ModelError(f"{what} is {value}: fit the model again")
