"""Declare results as records: typed, immutable values whose fields carry their unit and meaning.

A result of a fit, a comparison, a diagnosis, a trial, a history or an evaluation is a `Record` of records. What the
command line writes with `--json`, DataFrames, and those tables of the terminal and of HTML pages whose rows are records
are made from the declared fields, so a new field is declared once.
"""

from collections.abc import Mapping, Sequence
from functools import cache
from math import isfinite
from typing import Any, Final, NamedTuple, get_type_hints

import msgspec
import numpy as np
import pandas as pd

ConfidenceInterval = tuple[float, float]
"""Lower and upper end of an interval, both known."""
SCALARS: Final = (str, int, float, bool, type(None))
_EXACT: Final = {str, int, bool, type(None)}
"""Types of values that are never turned into others."""


class Shown(NamedTuple):
    """Declare that tables show a field.

    Parameters
    ----------
    head : str
        Head of its column, with the unit.
    format : str
        Name of its format in `socast.tools.report.table`, or of one that the report of the record adds.
    interval : str
        Field that holds its 95 % interval, if any.
    """

    head: str
    format: str = "text"
    interval: str = ""


def declare(meaning: str, head: str = "", format: str = "text", interval: str = "") -> msgspec.Meta:  # noqa: A002
    """Return the declaration of a field: its meaning with the unit in brackets, and its column in tables, if any."""
    return msgspec.Meta(description=meaning, extra={"shown": Shown(head, format, interval)} if head else None)


class Record(msgspec.Struct, frozen=True, kw_only=True):
    """Hold one part of a result. Numbers are plain Python numbers; an unknown one is None, never NaN."""

    def __post_init__(self) -> None:
        """Turn numbers of NumPy into plain ones, and numbers that are not finite into None."""
        for name in self.__struct_fields__:
            value = getattr(self, name)
            if type(value) not in _EXACT:
                msgspec.structs.force_setattr(self, name, _make_plain(value))

    def to_json(self) -> dict[str, Any]:
        """Return the record as the JSON values that `--json` writes."""
        names = zip(self.__struct_encode_fields__, self.__struct_fields__, strict=True)
        return {key: to_json_values(getattr(self, name)) for key, name in names}


class PartialRecord(Record, frozen=True):
    """Hold a part of a result whose JSON leaves out the fields that have their default value."""

    def to_json(self) -> dict[str, Any]:
        """Return the fields that differ from their default as the JSON values that `--json` writes."""
        absent = {each.encode_name for each in _list_fields(type(self)) if getattr(self, each.name) == each.default}
        return {key: value for key, value in super().to_json().items() if key not in absent}


def make_interval(low: float, high: float) -> ConfidenceInterval | None:
    """Return an interval, None where an end is unknown."""
    return (float(low), float(high)) if np.isfinite(low) and np.isfinite(high) else None


def list_shown(kind: type[Record]) -> dict[str, Shown]:
    """Return the fields and then the properties of a record that tables show, in the order of their declaration."""
    hints = get_type_hints(kind, include_extras=True)
    types = {name: hints[name] for name in kind.__struct_fields__}
    for name, value in vars(kind).items():
        if isinstance(value, property) and value.fget is not None:
            types[name] = get_type_hints(value.fget, include_extras=True).get("return")
    declared = {name: getattr(each, "__metadata__", ()) for name, each in types.items()}
    return {
        name: each.extra["shown"]
        for name, notes in declared.items()
        for each in notes
        if isinstance(each, msgspec.Meta) and each.extra and "shown" in each.extra
    }


@cache
def _list_fields(kind: type[Record]) -> tuple[msgspec.structs.FieldInfo, ...]:
    """Return the fields of a record with their defaults."""
    return msgspec.structs.fields(kind)


def make_frame(records: Sequence[Record]) -> pd.DataFrame:
    """Return records as a DataFrame with one column for each field that holds a number, a text or a truth value."""
    rows = [each.to_json() for each in records]
    names = [n for n in (rows[0] if rows else ()) if all(isinstance(row[n], SCALARS) for row in rows)]
    return pd.DataFrame({name: [row[name] for row in rows] for name in names})


def to_json_values(value: Any) -> Any:
    """Return a result with the values that JSON knows: plain numbers, and None for what is unknown.

    Examples
    --------
    >>> to_json_values({"a": np.float64(1.5), "b": [float("nan"), np.int64(2)]})
    {'a': 1.5, 'b': [None, 2]}
    """
    if isinstance(value, Record):
        return value.to_json()
    if isinstance(value, msgspec.Struct):
        return msgspec.to_builtins(value)
    if isinstance(value, Mapping):
        return {str(key): to_json_values(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return list(value) if _is_plain(value) else [to_json_values(item) for item in value]
    return _make_plain(value)


def _make_plain(value: Any) -> Any:
    """Return a value of a record with plain numbers, and records and the types of sequences as they are."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, float):
        return float(value) if isfinite(value) else None
    if isinstance(value, list | tuple):
        if _is_plain(value):
            return value[:]
        return type(value)(map(_make_plain, value)) if type(value) in {list, tuple} else tuple(map(_make_plain, value))
    if isinstance(value, Mapping):
        return {str(key): _make_plain(item) for key, item in value.items()}
    return value


def _is_plain(values: Sequence[Any]) -> bool:
    """Return whether a record holds these values as they are; it is told fast of long lists of the same type."""
    kinds = set(map(type, values))
    return kinds <= _EXACT or (kinds == {float} and all(map(isfinite, values)))
