"""The messages that Foxglove draws without configuration: positions on its map, and lines in its log.

References
----------
Foxglove schemas `foxglove.LocationFix` and `foxglove.Log`, https://docs.foxglove.dev/docs/sdk/schemas. The names of the
fields are theirs; fields that they leave optional are left out.
"""

from typing import Any, Final

import msgspec

LOCATION: Final = "location"
"""Last chunk of the topic of a car's positions."""
LOG: Final = "log"
"""Last chunk of the topic of a car's warnings."""
UNKNOWN_COVARIANCE: Final = 0
INFO, WARNING, ERROR = 2, 3, 4
"""Levels of a line in the log."""


class Timestamp(msgspec.Struct, frozen=True):
    """Hold a Unix time: whole seconds [s], and the rest [ns]."""

    sec: int
    nsec: int


class LocationFix(msgspec.Struct, frozen=True):
    """Hold a position of a car.

    Parameters
    ----------
    timestamp : Timestamp
        Time on the clock of the logger.
    latitude, longitude : float
        WGS 84. [deg]
    altitude : float
        Elevation above sea level, 0 where it is unknown. [m]
    position_covariance : tuple of 9 float
        Covariance of east, north and up, row by row. [m2]
    position_covariance_type : int
        `UNKNOWN_COVARIANCE`, because loggers do not tell it.
    """

    timestamp: Timestamp
    frame_id: str
    latitude: float
    longitude: float
    altitude: float
    position_covariance: tuple[float, ...] = (0.0,) * 9
    position_covariance_type: int = UNKNOWN_COVARIANCE


class Log(msgspec.Struct, frozen=True):
    """Hold a line of the log.

    Parameters
    ----------
    name : str
        What the line is about: `reserve`, `quality` or `finding`.
    file, line : str, int
        Place in a program, which these lines do not have.
    """

    timestamp: Timestamp
    level: int
    message: str
    name: str
    file: str = ""
    line: int = 0


def _describe(kind: str, words: str, **also: Any) -> dict[str, Any]:
    """Return the JSON schema of a field."""
    return {"type": kind, "description": words, **also}


def _enumerate(title: str, words: str, names: tuple[str, ...]) -> dict[str, Any]:
    """Return the JSON schema of a field that takes one of several named numbers, from 0 on."""
    return {
        "title": title,
        "description": words,
        "oneOf": [{"title": name, "const": number} for number, name in enumerate(names)],
    }


def _describe_object(title: str, words: str, properties: dict[str, Any]) -> dict[str, Any]:
    """Return the JSON schema of an object all of whose fields are required."""
    return _describe("object", words, title=title, properties=properties, required=list(properties))


_TIMESTAMP: Final = _describe_object(
    "time",
    "Unix time, UTC.",
    {
        "sec": _describe("integer", "Whole seconds. [s]", minimum=0),
        "nsec": _describe("integer", "Rest of the second. [ns]", minimum=0, maximum=999_999_999),
    },
)
SCHEMAS: Final[dict[str, dict[str, Any]]] = {
    LOCATION: _describe_object(
        "foxglove.LocationFix",
        "Position of a car, as its logger reports it.",
        {
            "timestamp": _TIMESTAMP,
            "frame_id": _describe("string", "Identity of the car."),
            "latitude": _describe("number", "Latitude, WGS 84. [deg]"),
            "longitude": _describe("number", "Longitude, WGS 84. [deg]"),
            "altitude": _describe("number", "Elevation above sea level; 0 where it is unknown. [m]"),
            "position_covariance": _describe(
                "array",
                "Covariance of east, north and up, row by row. [m2]",
                items={"type": "number"},
                minItems=9,
                maxItems=9,
            ),
            "position_covariance_type": _enumerate(
                "foxglove.PositionCovarianceType",
                "What is known of the covariance.",
                ("UNKNOWN", "APPROXIMATED", "DIAGONAL_KNOWN", "KNOWN"),
            ),
        },
    ),
    LOG: _describe_object(
        "foxglove.Log",
        "Warning about a car.",
        {
            "timestamp": _TIMESTAMP,
            "level": _enumerate(
                "foxglove.LogLevel", "Severity.", ("UNKNOWN", "DEBUG", "INFO", "WARNING", "ERROR", "FATAL")
            ),
            "message": _describe("string", "What is the matter."),
            "name": _describe("string", "What it is about: reserve, quality or finding."),
            "file": _describe("string", "Empty: the warning has no place in a program."),
            "line": _describe("integer", "0, likewise.", minimum=0),
        },
    ),
}
"""Last chunk of a topic -> JSON schema of its messages."""
