"""Structured log lines for people and machines: `key=value` pairs or JSON, one event per line."""

import json
import logging
import sys
from collections.abc import Mapping
from math import floor, isfinite, log10
from typing import Any, Final, TextIO

from socast.core.formatting import format_time

DIGITS: Final = 4
"""Significant digits of a number in the log; its whole part is never cut."""
_PLAIN = frozenset("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_.:/+-")


def event_fields(**values: Any) -> dict[str, Any]:
    """Return the fields of an event in the form that `logging` takes as `extra`."""
    return {"fields": values}


def flatten_counts(counts: Mapping[str, Any], prefix: str = "", *, keep_zeros: bool = False) -> dict[str, Any]:
    """Return nested counters as one level, with names joined by dots, without zeros and empty values.

    Examples
    --------
    >>> flatten_counts({"received": {"telemetry": 3, "ride": 0}, "vehicles": 1})
    {'received.telemetry': 3, 'vehicles': 1}
    """
    out: dict[str, Any] = {}
    for name, value in counts.items():
        if isinstance(value, Mapping):
            out |= flatten_counts(value, f"{prefix}{name}.", keep_zeros=keep_zeros)
        elif value or keep_zeros:
            out[prefix + name] = value
    return out


class LineFormatter(logging.Formatter):
    """Format a log record as one line, with numbers rounded to `DIGITS` significant digits.

    Parameters
    ----------
    as_json : bool
        Whether each line is a JSON object, with null for numbers that are not finite. Otherwise a line holds
        `key=value` pairs, with quotes where a value needs them.
    """

    def __init__(self, *, as_json: bool = False) -> None:
        super().__init__()
        self._as_json = as_json

    def format(self, record: logging.LogRecord) -> str:
        """Return the line: time, level, logger and event, then the fields of the event."""
        fields: Mapping[str, Any] = getattr(record, "fields", {})
        line = {
            "time": format_time(record.created, "milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "event": record.getMessage(),
            **{name: _round(value) for name, value in fields.items()},
        }
        if record.exc_info and record.exc_info[1] is not None:
            line["error"] = repr(record.exc_info[1])
        if self._as_json:
            finite = {name: None if _is_unknown(value) else value for name, value in line.items()}
            return json.dumps(finite, ensure_ascii=False, default=str)
        return " ".join(f"{name}={_quote(value)}" for name, value in line.items())


class _Standard(logging.StreamHandler[TextIO]):
    """Write to the current standard error, so that log lines do not displace a table that redraws."""

    @property
    def stream(self) -> TextIO:
        return sys.stderr

    @stream.setter
    def stream(self, _: TextIO) -> None:
        pass


def log_lines(*, as_json: bool = False, to: TextIO | None = None, level: int = logging.INFO) -> None:
    """Send the log records of socast, from a level on, to a stream."""
    handler = logging.StreamHandler(to) if to else _Standard()
    handler.setFormatter(LineFormatter(as_json=as_json))
    root = logging.getLogger("socast")
    root.handlers = [handler]
    root.setLevel(level)
    root.propagate = False


def _is_unknown(value: Any) -> bool:
    """Return whether a value is a number that JSON cannot represent."""
    return isinstance(value, float) and not isfinite(value)


def _round(value: Any) -> Any:
    """Return a number with `DIGITS` significant digits, or more where its whole part has more; other values as given.

    Examples
    --------
    >>> _round(0.1234567), _round(12.34567), _round(123456.7), _round(1e-9), _round(7), _round("x")
    (0.1235, 12.35, 123457.0, 1e-09, 7, 'x')
    """
    if not isinstance(value, float) or not isfinite(value) or value == 0.0:
        return value
    return round(value, max(0, DIGITS - 1 - floor(log10(abs(value)))))


def _quote(value: Any) -> str:
    """Return the text of a value after the equals sign, quoted if necessary."""
    text = f"{value:.13g}" if isinstance(value, float) else str(value)
    return text if text and _PLAIN.issuperset(text) else json.dumps(text, ensure_ascii=False)
