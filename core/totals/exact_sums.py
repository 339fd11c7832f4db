"""Named arrays of sums: of floats, and exact ones that do not depend on the order or the grouping of what is added.

For an exact sum, each value is rounded down to a multiple of 2^-80 and split into four whole numbers, which are added
as integers. Sums of parts of a fleet can therefore be added up to that of the whole fleet, to the bit, however the
fleet was divided.

References
----------
Demmel, Nguyen, IEEE Transactions on Computers 64 (2015) 2060, DOI 10.1109/TC.2014.2345391, on reproducible sums.
"""

from math import prod
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import ArrayLike

from socast.core.batch import Floats

LIMBS: Final = 4
"""Number of whole numbers that make up a sum."""
LIMB_BITS: Final = 40
"""Bits of each of them, but for the first; their units are 2^40, 1, 2^-40 and 2^-80."""
LARGEST: Final = 2.0**90
"""A value from which on, or one that is not finite, counts as 0."""
_BASE: Final = 2.0**LIMB_BITS
_LARGEST_LIMB: Final = 1 << 61
_MASK: Final = (1 << LIMB_BITS) - 1
_CARRY_AFTER: Final = 1 << 20  # values, of which each adds less than 2^40 to a limb of 63 bits


class DaySums(Protocol):
    """Hold named arrays of sums, made from the shape of each array."""

    def __init__(self, **shapes: tuple[int, ...]) -> None: ...

    def add(self, name: str, values: ArrayLike, at: Any = ()) -> None:
        """Add values to an array, or to the place `at` of it, at which no cell stands twice."""

    def get(self, name: str) -> Floats:
        """Return an array of sums."""

    def clear(self) -> None:
        """Set all sums to 0."""

    def dump(self) -> bytes:
        """Return the sums as bytes."""

    def load(self, state: bytes) -> None:
        """Replace the sums by those that `dump` returned; raise ValueError where they are none."""


class FloatSums:
    """Hold named arrays of sums of floats, in the order in which they are added.

    Parameters
    ----------
    **shapes : tuple of int
        Shape of each array.
    """

    def __init__(self, **shapes: tuple[int, ...]) -> None:
        self._parts = {name: np.zeros(shape) for name, shape in shapes.items()}

    def add(self, name: str, values: ArrayLike, at: Any = ()) -> None:
        """Add values to an array, or to the place `at` of it, at which no cell stands twice."""
        self._parts[name][at] += values

    def get(self, name: str) -> Floats:
        """Return an array of sums, which `add` changes."""
        return self._parts[name]

    def clear(self) -> None:
        """Set all sums to 0, in new arrays."""
        self._parts = {name: np.zeros(part.shape) for name, part in self._parts.items()}

    def dump(self) -> bytes:
        """Return the sums as bytes."""
        return b"".join(part.tobytes() for part in self._parts.values())

    def load(self, state: bytes) -> None:
        """Replace the sums by those that `dump` returned; raise ValueError where they are none."""
        values = np.frombuffer(state)
        if len(values) != sum(part.size for part in self._parts.values()) or np.isnan(values).any():
            raise ValueError("sums of another number, or not a number")
        for name, part in self._parts.items():
            self._parts[name], values = values[: part.size].reshape(part.shape).copy(), values[part.size :]


class ExactSums:
    """Hold named arrays of exact sums.

    Parameters
    ----------
    **shapes : tuple of int
        Shape of each array.

    Examples
    --------
    >>> sums, other = ExactSums(a=(2,)), ExactSums(a=(2,))
    >>> for value in (0.1, 1e17, -1e17):
    ...     sums.add("a", value, 0)
    >>> other.add("a", [0.2, 0.3])
    >>> sums.merge(other)
    >>> sums.get("a").tolist()
    [0.30000000000000004, 0.3]
    """

    def __init__(self, **shapes: tuple[int, ...]) -> None:
        sizes = [prod(shape) for shape in shapes.values()]
        self._limbs = np.zeros((LIMBS, sum(sizes)), np.int64)
        ends = np.cumsum(sizes).tolist()
        self._parts = {
            name: self._limbs[:, end - size : end].reshape(LIMBS, *shape)
            for (name, shape), size, end in zip(shapes.items(), sizes, ends, strict=True)
        }
        self._added = 0

    def add(self, name: str, values: ArrayLike, at: Any = ()) -> None:
        """Add values to an array, or to the place `at` of it, at which no cell stands twice."""
        rest = np.asarray(values, np.float64)
        rest = np.where(np.abs(rest) < LARGEST, rest, 0.0) / _BASE  # a comparison with NaN is false
        place = (slice(None), *at) if isinstance(at, tuple) else (slice(None), at)
        part = self._parts[name][place]
        whole = np.empty(part.shape)
        for limb in range(LIMBS):
            np.floor(rest, out=(of_limb := whole[limb, ...]))
            rest = (rest - of_limb) * _BASE
        self._parts[name][place] = part + whole.astype(np.int64)
        self._added += 1
        if self._added >= _CARRY_AFTER:
            self._carry()

    def merge(self, other: DaySums) -> None:
        """Add the exact sums of another instance with the same arrays."""
        self._carry()
        self._limbs += np.frombuffer(other.dump(), np.int64).reshape(self._limbs.shape)
        self._carry()

    def get(self, name: str) -> Floats:
        """Return an array of sums as floats, a copy."""
        self._carry()
        high, one, low, lowest = self._parts[name].astype(np.float64)
        return np.asarray(((lowest / _BASE + low) / _BASE + one) + high * _BASE)

    def clear(self) -> None:
        """Set all sums to 0."""
        self._limbs[:] = 0
        self._added = 0

    def dump(self) -> bytes:
        """Return the sums as bytes, which are equal if the sums are."""
        self._carry()
        return self._limbs.tobytes()

    def load(self, state: bytes) -> None:
        """Replace the sums by those that `dump`, or that of `FloatSums`, returned; raise ValueError for others."""
        if len(state) == 8 * self._limbs.shape[1]:
            floats = FloatSums(**{name: part.shape[1:] for name, part in self._parts.items()})
            floats.load(state)
            self.clear()
            for name in self._parts:
                self.add(name, floats.get(name))
            return
        limbs = np.frombuffer(state, np.int64).reshape(self._limbs.shape)
        if limbs.size and max(-int(limbs.min()), int(limbs.max())) > _LARGEST_LIMB:
            raise ValueError("a sum is too large")
        self._limbs[:] = limbs
        self._added = 0
        self._carry()

    def _carry(self) -> None:
        """Make every limb but the first less than its base."""
        for limb in range(LIMBS - 1, 0, -1):
            self._limbs[limb - 1] += self._limbs[limb] >> LIMB_BITS
            self._limbs[limb] &= _MASK
        self._added = 0
