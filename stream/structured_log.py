"""Log lines that a machine reads too: `key=value` or JSON, one event a line."""

import json
import logging
import sys
from collections.abc import Mapping
from datetime import UTC, datetime
from math import isfinite
from typing import Any, TextIO

_PLAIN = frozenset("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_.:/+-")


def event_fields(**values: Any) -> dict[str, Any]:
    """Return what `logging` takes as `extra`: the fields of an event."""
    return {"fields": values}


def flatten_counts(counts: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested counters as one level, their names joined by dots; zeros and empty ones left out.

    >>> flat({"received": {"telemetry": 3, "ride": 0}, "vehicles": 1})
    {'received.telemetry': 3, 'vehicles': 1}
    """
    out: dict[str, Any] = {}
    for name, value in counts.items():
        if isinstance(value, Mapping):
            out |= flatten_counts(value, f"{prefix}{name}.")
        elif value:
            out[prefix + name] = value
    return out


class LineFormatter(logging.Formatter):
    """Format a log record as one line.

    Parameters
    ----------
    as_json : bool
        One JSON object a line, what is not finite as null, else `key=value` pairs, quoted where they must be.
    """

    def __init__(self, *, as_json: bool = False) -> None:
        super().__init__()
        self._as_json = as_json

    def format(self, record: logging.LogRecord) -> str:
        """Return the line: time, level, source and event, then the event's fields."""
        moment = datetime.fromtimestamp(record.created, UTC)
        line = {
            "time": moment.isoformat(timespec="milliseconds").replace("+00:00", "Z"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "event": record.getMessage(),
            **getattr(record, "fields", {}),
        }
        if record.exc_info and record.exc_info[1] is not None:
            line["error"] = repr(record.exc_info[1])
        if self._as_json:
            finite = {name: None if _unknown(value) else value for name, value in line.items()}
            return json.dumps(finite, ensure_ascii=False, default=str)
        return " ".join(f"{name}={_quoted(value)}" for name, value in line.items())


class _Standard(logging.StreamHandler[TextIO]):
    """Writes to what standard error is at the time, so that a table that redraws keeps its place."""

    @property
    def stream(self) -> TextIO:
        return sys.stderr

    @stream.setter
    def stream(self, _: TextIO) -> None:
        pass


def log_lines(*, as_json: bool = False, to: TextIO | None = None, level: int = logging.INFO) -> None:
    """Send what is logged, from a level on, to a stream; to standard error unless told otherwise."""
    handler = logging.StreamHandler(to) if to else _Standard()
    handler.setFormatter(LineFormatter(as_json=as_json))
    root = logging.getLogger("socast")
    root.handlers = [handler]
    root.setLevel(level)
    root.propagate = False


def _unknown(value: Any) -> bool:
    """Say whether a value is a number that JSON does not have."""
    return isinstance(value, float) and not isfinite(value)


def _quoted(value: Any) -> str:
    """Return a value as it stands after the equals sign."""
    text = f"{value:.13g}" if isinstance(value, float) else str(value)
    return text if text and _PLAIN.issuperset(text) else json.dumps(text, ensure_ascii=False)
