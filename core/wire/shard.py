"""The shards of a fleet: each name belongs to exactly one of them, by its last characters.

Zenoh delivers by key expressions, whose wildcard `$*` stands for any characters within a chunk. `fleet/$*7/**` are
therefore the cars whose names end in 7, and a consumer that subscribes to such ends receives no others. Up to ten
shards divide the names by their last character. More shards divide names that end in a digit by their last two
characters. The numbers of digits, and the codes of all other characters, are divided by the number of shards, and the
remainder is the shard. The ends of all characters of a name on the wire are distributed, so that no name is left out.
Where numbers end the names, 2, 5, 10, 20, 25, 50 and 100 shards are equally large.
"""

import re
from dataclasses import dataclass
from string import ascii_letters, digits
from typing import Final, Literal

from socast.core.errors import SettingsError

MOST_SHARDS: Final = 100
"""Largest number of shards under a prefix, as two digits tell them apart."""
BY_ONE: Final = len(digits)
"""Number of shards up to which the last character alone decides."""
OTHERS: Final = f"{ascii_letters}_.-"
"""Characters of names on the wire, but for digits."""

By = Literal["name", "chunk"]
"""What is divided: the names of cars, or the chunk before `fleet` in the key."""


@dataclass(frozen=True)
class Shard:
    """Name the share of a fleet that a consumer serves.

    Parameters
    ----------
    by : str
        `name` divides cars by their names, `chunk` by the chunk before `fleet`.
    """

    index: int
    count: int
    by: By = "name"

    def __str__(self) -> str:
        return f"{self.index}/{self.count}"

    @property
    def chunk(self) -> str:
        """Return the shard as a chunk of a key, such as `2-of-4`."""
        return f"{self.index}-of-{self.count}"

    def has(self, name: str) -> bool:
        """Return whether a name belongs to this shard.

        Examples
        --------
        >>> [shard for shard in range(1, 5) if Shard(shard, 4).has("taxi-007")]
        [3]
        >>> [shard for shard in range(1, 17) if Shard(shard, 16).has("taxi-07")]
        [7]
        """
        return (_number(name, self.count) - self.index) % self.count == 0

    def list_ends(self) -> list[str]:
        """Return the names of this shard as chunks of key expressions, which do not overlap.

        Examples
        --------
        >>> Shard(1, 1).list_ends(), Shard(7, 10).list_ends()[:3]
        (['*'], ['$*7', '$*a', '$*k'])
        """
        if self.count == 1:
            return ["*"]
        ends = [*digits, *OTHERS]
        if self.count > BY_ONE:
            ends = [*OTHERS, *(f"{first}{last}" for first in (*digits, *OTHERS) for last in digits)]
        out = [f"$*{end}" for end in ends if self.has(end)]
        return out + [digit for digit in digits if self.count > BY_ONE and self.has(digit)]


def _number(name: str, count: int) -> int:
    """Return the number by which a name is assigned to one of a count of shards."""
    last = name[-1:]
    if last not in digits or not last:
        return ord(last or "0")
    if count <= BY_ONE or len(name) == 1:
        return int(last)
    before = name[-2]
    return 10 * (int(before) if before in digits else ord(before)) + int(last)


def parse_shard(text: str, by: By = "name") -> Shard:
    """Return the shard of a text such as `2/4`, or `2-of-4`, which is also the name of a file.

    Examples
    --------
    >>> parse_shard("2/4") == parse_shard("2-of-4") == Shard(2, 4)
    True
    """
    found = re.fullmatch(r"(\d{1,3})(?:/|-of-)(\d{1,3})", text.strip(), re.ASCII)
    index, count = (int(found[1]), int(found[2])) if found else (0, 0)
    if not 1 <= index <= count <= MOST_SHARDS:
        raise SettingsError(
            f"--shard is {text!r}; give the number of this shard and that of all, such as 2/4, up to {MOST_SHARDS}"
        )
    return Shard(index, count, by)
