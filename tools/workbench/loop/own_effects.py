"""Files of the user's own effects: read again when they change on disk, with their errors at the line."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

from socast.core import effects
from socast.core.errors import EffectError
from socast.tools.commands.effects import make_effect_record

_PLACE: Final = re.compile(r":(\d+): ")
"""The number of a line, after the name of a file in a message."""
CONTEXT: Final = 3
"""Number of lines that are shown before and after the line of an error."""


class Stamp(NamedTuple):
    """Hold what shows that a file changed: its time of change [ns] and its size [bytes]; zeros if it is gone."""

    time_ns: int
    size: int


class OwnEffects:
    """Follow the files of effects that the command line named."""

    def __init__(self, files: Sequence[Path]) -> None:
        self.files = list(files)
        self._read = {file: _stamp(file) for file in self.files}
        self._errors: dict[Path, str] = {}

    @property
    def has_changed(self) -> bool:
        """Whether a file differs from what was read last."""
        return any(_stamp(file) != self._read[file] for file in self.files)

    def read_again(self) -> list[str]:
        """Load the files that changed, and return the names of their effects.

        A file with an error keeps the effects that it had before; `list_records` tells the error.
        """
        loaded = []
        for file in self.files:
            now = _stamp(file)
            if now == self._read[file]:
                continue
            self._read[file] = now
            self._errors.pop(file, None)
            try:
                loaded += [effect.name for effect in effects.load_file(file)]
            except EffectError as error:
                self._errors[file] = str(error)
        return loaded

    def list_records(self) -> list[dict[str, Any]]:
        """Return for each file its effects, whether it changed, and its error with the lines around it."""
        by_file = effects.group_by_topic()
        return [
            {
                "file": str(file),
                "effects": [make_effect_record(effect, file.name) for effect in by_file.get(file.name, ())],
                "changed": _stamp(file) != self._read[file],
                "error": _describe_error(file, self._errors[file]) if file in self._errors else None,
                "command": f"socast effects check {file}",
            }
            for file in self.files
        ]


def _stamp(file: Path) -> Stamp:
    """Return the stamp of a file."""
    try:
        status = file.stat()
    except OSError:
        return Stamp(0, 0)
    return Stamp(status.st_mtime_ns, status.st_size)


def _describe_error(file: Path, message: str) -> dict[str, Any]:
    """Return the message of an error, its line, and the lines around it."""
    place = _PLACE.search(message)
    line = int(place[1]) if place else None
    try:
        text = file.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        text = []
    first = max((line or 1) - 1 - CONTEXT, 0)
    shown = text[first : (line or 0) + CONTEXT] if line else []
    return {"message": message, "line": line, "first": first + 1, "lines": shown}
