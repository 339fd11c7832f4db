"""Models: sums of products of ride-table columns, and the JSON file that a person can read.

Every model of the paper is linear in columns; they differ in which columns, which products of them, and which
coefficients are fitted. So a model is a tuple of terms, each a coefficient times a product of columns, and a recipe is
the same before anything is fitted. A vehicle's own parameter is one more column of the product.
"""

from collections.abc import Mapping
from math import isfinite
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Protocol

import msgspec
import numpy as np

from core import effects
from core.batch import Floats
from core.errors import EffectError, ModelError

FORMAT: Final = 1
"""Version of the model file that this version of the product reads and writes."""

EFFECT_PREFIX: Final = "effect_"


class Model(Protocol):
    """What predicts the energy of rides, or of any part of one."""

    @property
    def name(self) -> str:
        """What people call it."""

    @property
    def version(self) -> str:
        """Tells it from its predecessors of the same name."""

    @property
    def needs(self) -> tuple[str, ...]:
        """Columns of the ride table that it reads."""

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of the effects whose energy it reads."""

    def predict(self, columns: Mapping[str, Floats]) -> Floats:
        """Return the energy in kWh, one a row, NaN where it cannot tell."""


class Term(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One addend of a model: a coefficient times a product of columns.

    Parameters
    ----------
    name : str
        Of the term, among those of its model.
    columns : tuple of str
        Columns of the ride table; one may stand twice. None at all is a constant.
    coefficient : float
        What the product is multiplied with.
    unit : str
        Of the coefficient, as pint spells it.
    """

    name: str
    columns: tuple[str, ...]
    coefficient: float
    unit: str


class LinearModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A model that is a sum of terms; what a model file holds.

    Parameters
    ----------
    format : int
        Version of the file.
    name, version : str
        Of the model; a forecast carries both.
    recipe : str
        What it was made by.
    terms : tuple of Term
        In the order in which they are added.
    history : tuple of dict
        What was done to it, oldest first: each a plain JSON object.
    """

    format: int = FORMAT
    name: str
    version: str
    recipe: str
    terms: tuple[Term, ...]
    history: tuple[dict[str, Any], ...] = ()

    @property
    def needs(self) -> tuple[str, ...]:
        """Columns of the ride table that it reads, each once, in the order of the terms."""
        return tuple(dict.fromkeys(column for term in self.terms for column in term.columns))

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of the effects whose energy it reads."""
        return tuple(c.removeprefix(EFFECT_PREFIX) for c in self.needs if c.startswith(EFFECT_PREFIX))

    def predict(self, columns: Mapping[str, Floats]) -> Floats:
        """Return the energy of rides, or of any part of one for which the same columns are known.

        Parameters
        ----------
        columns : mapping of str to (n,) float
            At least `needs`, as the ride table names them: `effect_<name>` [kWh per unit of its coefficient],
            `rolling_resistance` [1], `drag_area_m2` [m^2] and so on. A `DataFrame` will do.

        Returns
        -------
        (n,) float
            Row by row: the result is the same to the bit however rows are cut into blocks. NaN where a needed column
            is. [kWh]

        Raises
        ------
        ModelError
            Where a needed column is absent.
        """
        if missing := [name for name in self.needs if name not in columns]:
            raise ModelError(
                f"model {self.name}: column {missing[0]!r} is missing in the data: make the tables with this model's "
                "effects"
            )
        names = self.needs or tuple(columns)[:1]
        arrays = {name: np.asarray(columns[name], dtype=np.float64) for name in names}
        rows = len(arrays[names[0]]) if names else 0
        total = np.zeros(rows)
        for term in self.terms:
            product = np.full(rows, term.coefficient)
            for name in term.columns:
                product *= arrays[name]
            total += product
        return total


def _physical(name: str, columns: tuple[str, ...]) -> Term:
    """Return a term that holds as physics has it: coefficient 1."""
    return Term(name=name, columns=columns, coefficient=1.0, unit="1")


BASIC_PHYSICAL: Final = LinearModel(
    name="basic_physical",
    version="1",
    recipe="basic_physical",
    terms=(
        _physical("rolling", ("effect_rolling", "rolling_resistance")),
        _physical("climbing", ("effect_climbing",)),
        _physical("aero_drag", ("effect_aero_drag", "drag_area_m2")),
        _physical("inertia", ("effect_inertia",)),
    ),
)
"""Basic physical model, eq. (1) and section 4.1 of the paper: energy at the wheels, with the catalogue's parameters."""

EXTENDED_PHYSICAL: Final = msgspec.structs.replace(
    BASIC_PHYSICAL,
    name="extended_physical",
    recipe="extended_physical",
    terms=(*BASIC_PHYSICAL.terms, _physical("accessories", ("effect_accessories",))),
)
"""Extended physical model, section 4.2 of the paper: the basic one and accessory power by outside temperature."""

KNOWN: Final[Mapping[str, LinearModel]] = MappingProxyType({m.name: m for m in (BASIC_PHYSICAL, EXTENDED_PHYSICAL)})
"""Models that need no fitting and come with the product, by name."""


def load(name_or_path: str | Path) -> LinearModel:
    """Return a model by name, or from its file.

    Parameters
    ----------
    name_or_path : str or Path
        A name of `KNOWN`, else the path of a model file.

    Raises
    ------
    ModelError
        Where it is neither; where the file is not JSON, is no model, is of another version, or names an effect that is
        unknown.

    Examples
    --------
    >>> load("basic_physical").effects
    ('rolling', 'climbing', 'aero_drag', 'inertia')
    """
    if (known := KNOWN.get(str(name_or_path))) is not None:
        return known
    path = Path(name_or_path)
    if not path.suffix and not path.exists():
        raise ModelError(
            f"model {str(path)!r} is unknown: known are {', '.join(KNOWN)}; else give the path of a model file"
        )
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ModelError(
            f"{path}: cannot read a model: {error.strerror}; name a model file, or one of {', '.join(KNOWN)}"
        ) from error
    try:
        return decode(content)
    except ModelError as error:
        raise ModelError(f"{path}: {error}") from error


def save(model: LinearModel, path: str | Path) -> None:
    """Write a model file, to be read again exactly, and by people.

    Raises
    ------
    ModelError
        Where a coefficient is not finite, or the file cannot be written.
    """
    content = encode(model)
    try:
        Path(path).write_bytes(content)
    except OSError as error:
        raise ModelError(
            f"{path}: cannot write the model: {error.strerror}; name a file in a folder that can be written"
        ) from error


def encode(model: LinearModel) -> bytes:
    """Return the model file's content; floats as the shortest text that reads back to the same number."""
    _check(model)
    return msgspec.json.format(msgspec.json.encode(model), indent=2) + b"\n"


def decode(content: bytes) -> LinearModel:
    """Return the model that a file's content holds.

    Raises
    ------
    ModelError
        Where it is not JSON, is no model, is of another version, or names an effect that is unknown.
    """
    try:
        raw = msgspec.json.decode(content)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise ModelError(f"no model file: not JSON: {error}") from error
    version = raw.get("format") if isinstance(raw, dict) else None
    if version is None or "terms" not in raw:
        raise ModelError("no model file: it has no 'format' and 'terms'; `socast` writes model files")
    if version != FORMAT:
        raise ModelError(
            f"model file of format {version!r}, and this version reads format {FORMAT}: fit the model anew"
        )
    try:
        model = msgspec.convert(raw, LinearModel)
    except msgspec.ValidationError as error:
        raise ModelError(f"model file is damaged: {error}") from error
    _check(model)
    return model


def _check(model: LinearModel) -> None:
    """Check what types cannot: finite coefficients, names that stand once, effects that exist."""
    names: set[str] = set()
    for term in model.terms:
        if not isfinite(term.coefficient):
            raise ModelError(
                f"model {model.name}: coefficient of {term.name!r} is {term.coefficient}: fit the model anew"
            )
        if term.name in names:
            raise ModelError(f"model {model.name}: term {term.name!r} stands twice: add their coefficients")
        names.add(term.name)
    for name in model.effects:
        try:
            effects.get(name)
        except EffectError as error:
            raise ModelError(f"model {model.name}: {error}") from error
