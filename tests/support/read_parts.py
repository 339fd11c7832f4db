"""Find which parts of a result a function reads: it cannot depend on the others."""

from collections.abc import Callable, Iterator
from typing import Any

Path = tuple[Any, ...]


def find_read_parts(function: Callable[[Any], object], result: dict[str, Any]) -> set[Path]:
    """Return the path of each part of a result that a function reads; the function receives a copy."""
    read: set[Path] = set()
    function(_Noting(result, read, ()))
    return read


def find_read_fields(function: Callable[[Any], object], record: Any) -> set[str]:
    """Return the fields of a record that a function reads."""
    read: set[str] = set()

    class Noting:
        def __getattr__(self, name: str) -> Any:
            read.add(name)
            return getattr(record, name)

    function(Noting())
    return read


class _Noting(dict[Any, Any]):
    """Mapping that notes which of its keys are read."""

    def __init__(self, values: dict[Any, Any], read: set[Path], path: Path) -> None:
        super().__init__({key: _wrap(value, read, (*path, key)) for key, value in values.items()})
        self._read, self._path = read, path

    def _note(self, *keys: Any) -> None:
        self._read.update((*self._path, key) for key in keys)

    def __getitem__(self, key: Any) -> Any:
        self._note(key)
        return super().__getitem__(key)

    def get(self, key: Any, default: Any = None) -> Any:
        self._note(key)
        return super().get(key, default)

    def __contains__(self, key: object) -> bool:
        self._note(key)
        return super().__contains__(key)

    def __iter__(self) -> Iterator[Any]:
        self._note(*super().keys())
        return super().__iter__()

    def keys(self) -> Any:
        self._note(*super().keys())
        return super().keys()

    def values(self) -> Any:
        self._note(*super().keys())
        return super().values()

    def items(self) -> Any:
        self._note(*super().keys())
        return super().items()

    def __or__(self, other: Any) -> Any:
        self._note(*super().keys())
        return super().__or__(other)


def _wrap(value: Any, read: set[Path], path: Path) -> Any:
    """Return a value whose mappings note what is read."""
    if isinstance(value, dict):
        return _Noting(value, read, path)
    if isinstance(value, list):
        return [_wrap(each, read, (*path, place)) for place, each in enumerate(value)]
    return value
