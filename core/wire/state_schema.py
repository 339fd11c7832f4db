"""The words with which `socast.core.snapshot` declares the form of a saved state.

Each is a small object with a method `check`, which raises `Fault` if a value has another form.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import inf, isnan
from typing import Any, Protocol

import numpy as np


class Fault(ValueError):  # noqa: N818 - it is not an error of the product, but the reason of one
    """Tell what is wrong with a part of a state."""


Sizes = Mapping[str, float]
"""Numbers of lanes and the like, by which other parts of the state are checked."""


class Schema(Protocol):
    """Describe the form of a part of a state."""

    def check(self, value: Any, sizes: Sizes) -> None:
        """Raise `Fault` if a value has another form."""


@dataclass(frozen=True)
class Number:
    """Require a number from `low` to `high`, or below the size that `high` names; NaN only where it may be unknown."""

    low: float = -inf
    high: float | str = inf
    whole: bool = False
    unknown: bool = True

    def check(self, value: Any, sizes: Sizes) -> None:
        """Raise `Fault` if a value is no such number."""
        kinds = int if self.whole else (int, float)
        high = sizes[self.high] - 1 if isinstance(self.high, str) else self.high
        if not isinstance(value, kinds) or (isinstance(value, bool) and self.whole):
            raise Fault(f"{_shorten(value)} is not a {'whole ' if self.whole else ''}number")
        if not (self.low <= value <= high or (isnan(value) and self.unknown)):
            raise Fault(f"{_shorten(value)} is not from {self.low:g} to {high:g}")


@dataclass(frozen=True)
class Text:
    """Require a text of at most `longest` characters."""

    longest: int = 1 << 16

    def check(self, value: Any, _sizes: Sizes) -> None:
        """Raise `Fault` if a value is no such text."""
        if not isinstance(value, str) or len(value) > self.longest:
            raise Fault(f"{_shorten(value)} is not a text of at most {self.longest:,} characters")


@dataclass(frozen=True)
class Maybe:
    """Allow None in place of a part."""

    part: Schema

    def check(self, value: Any, sizes: Sizes) -> None:
        """Raise `Fault` if a value is neither None nor such a part."""
        if value is not None:
            self.part.check(value, sizes)


class Row:
    """Require a list of these parts."""

    def __init__(self, *parts: Schema) -> None:
        self.parts = parts

    def check(self, value: Any, sizes: Sizes) -> None:
        """Raise `Fault` if a value is no such list."""
        _check_list(value)
        _check_count(len(value), len(self.parts), sizes)
        for part, each in zip(self.parts, value, strict=True):
            part.check(each, sizes)


@dataclass(frozen=True)
class Many:
    """Require a list of equal parts: `count` of them, which may be the name of a size, or a row for each lane.

    `by_lane` names the size that is the least number of rows.
    """

    part: Schema
    count: int | str | None = None
    by_lane: str = ""
    unique: bool = False

    def check(self, value: Any, sizes: Sizes) -> None:
        """Raise `Fault` if a value is no such list."""
        _check_list(value)
        _check_count(len(value), self.count, sizes, by_lane=self.by_lane)
        check = self.part.check
        for each in value:
            check(each, sizes)
        if self.unique and len(set(value)) < len(value):
            raise Fault("a value stands twice")


@dataclass(frozen=True)
class ByName:
    """Require a mapping from texts to equal parts."""

    part: Schema

    def check(self, value: Any, sizes: Sizes) -> None:
        """Raise `Fault` if a value is no such mapping."""
        if not isinstance(value, dict):
            raise Fault(f"{_shorten(value)} is not a mapping")
        for name, each in value.items():
            Text().check(name, sizes)
            self.part.check(each, sizes)


@dataclass(frozen=True)
class Packed:
    """Require bytes that are rows of a type of numpy.

    `count` and `by_lane` are those of `Many`. `limits` holds the schema of the numbers of a field by its name, or of
    all numbers under an empty name. `vacant` does the same for the rows beyond the last lane.
    """

    dtype: Any
    count: int | str | None = None
    by_lane: str = ""
    limits: Mapping[str, Number] = field(default_factory=dict)
    vacant: Mapping[str, Number] = field(default_factory=dict)

    def check(self, value: Any, sizes: Sizes) -> None:
        """Raise `Fault` if a value is no such bytes."""
        dtype = np.dtype(self.dtype)
        if not isinstance(value, bytes) or len(value) % dtype.itemsize:
            raise Fault(f"{_shorten(value)} is not bytes of rows of {dtype.itemsize} bytes")
        rows = np.frombuffer(value, dtype)
        _check_count(len(rows), self.count, sizes, by_lane=self.by_lane)
        for part, limits in ((rows, self.limits), (rows[int(sizes["lanes"]) :], self.vacant)):
            for name, number in limits.items():
                numbers = part[name] if name else part.view("f8") if dtype.names else part
                for extreme in _find_extremes(numbers, unknown=number.unknown):
                    number.check(extreme, sizes)


class Anything:
    """Leave the check to the component, whose `load` raises an error."""

    def check(self, value: Any, sizes: Sizes) -> None:
        """Accept any value."""


def _find_extremes(values: Any, *, unknown: bool) -> list[float]:
    """Return the least and the largest of some numbers, and NaN if there is one and it may not be."""
    known = values[~np.isnan(values)] if values.dtype.kind == "f" else values
    extremes = [known.min().item(), known.max().item()] if known.size else []
    return extremes + ([np.nan] if known.size < values.size and not unknown else [])


def _check_list(value: Any) -> None:
    """Raise `Fault` if a value is not a list."""
    if not isinstance(value, list):
        raise Fault(f"{_shorten(value)} is not a list")


def _check_count(count: int, wanted: int | str | None, sizes: Sizes, *, by_lane: str = "") -> None:
    """Raise `Fault` if a number of rows is not the one wanted, or does not fit the number of lanes."""
    wanted = int(sizes[wanted]) if isinstance(wanted, str) else wanted
    if wanted is not None and count != wanted:
        raise Fault(f"{count:,} parts instead of {wanted:,}")
    if by_lane and not sizes[by_lane] <= count <= 2.0 * sizes["lanes"]:
        raise Fault(f"{count:,} rows for {sizes['lanes']:,.0f} vehicles")


def _shorten(value: Any) -> str:
    """Return a value as a text for a message: numbers and short texts as they are, other things by their type."""
    if isinstance(value, int | float) or value is None:
        return f"{value:.6g}" if isinstance(value, int | float) else "nothing"
    return f"{value[:40]!r}" if isinstance(value, str) else f"a value of type {type(value).__name__}"
