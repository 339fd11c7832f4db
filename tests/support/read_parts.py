"""Find which fields of a record a function reads: it cannot depend on the others."""

from collections.abc import Callable
from typing import Any


def find_read_fields(function: Callable[[Any], object], record: Any) -> set[str]:
    """Return the fields of a record that a function reads."""
    read: set[str] = set()

    class Noting:
        def __getattr__(self, name: str) -> Any:
            read.add(name)
            return getattr(record, name)

    function(Noting())
    return read
