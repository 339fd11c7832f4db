"""The topics that Foxglove shows: positions and warnings of cars, their recording, and a layout of plots."""

import json
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np

from socast.core.errors import RecordingError
from socast.core.files import UNREADABLE, write_whole
from socast.core.wire.messages import Finding, Forecast, Message, address
from socast.core.wire.sample_reader import holds_samples, read_samples
from socast.stream.closeable import Closeable
from socast.stream.mcap_writer import McapSink
from socast.stream.source import Source
from socast.tools.commands.ask import HIGH_RISK, LOW_RISK

LOCATION: Final = "location"
"""Last chunk of the topic of a car's positions."""
LOG: Final = "log"
"""Last chunk of the topic of a car's warnings."""
UNKNOWN_COVARIANCE: Final = 0
INFO, WARNING, ERROR = 2, 3, 4
"""Levels of a line in the log."""
LATEST_S: Final = 2.0**32
"""Unix time from which on a clock is not believed. [s]"""
QUALITY_WORDS: Final = {
    "repaired_time": (INFO, "samples with a repaired time stamp"),
    "rejected_speed": (WARNING, "samples with a rejected speed"),
    "duplicate": (INFO, "late or repeated samples"),
    "gap": (WARNING, "gaps between samples"),
    "out_of_range": (WARNING, "samples with a value out of range"),
}
"""Counter of `socast.core.wire.messages.QualityCounts` -> level and words of its warning."""
LEVEL_OF_STATUS: Final = {"proposed": INFO, "sure": WARNING, "gone": INFO}
"""Status of a finding -> level of its warning."""
MOST_CARS: Final = 20
"""Largest number of cars that have a tab."""
BLUE, ORANGE, GREY = "#0072b2", "#d55e00", "#999999"
"""Colours that colour-blind people distinguish."""
PLOTS: Final = {
    "State of charge [%]": (
        ("telemetry.soc_pct", "displayed", GREY),
        ("forecast.soc_pct", "filtered", BLUE),
        ("forecast.soc_end_of_shift_pct.mean", "end of shift", ORANGE),
        ("forecast.soc_end_of_shift_pct.p05", "end of shift, 5th percentile", ORANGE),
        ("forecast.soc_end_of_shift_pct.p95", "end of shift, 95th percentile", ORANGE),
    ),
    "Energy of the ride [kWh]": (
        ("forecast.ride_energy_predicted_kwh", "predicted", ORANGE),
        ("forecast.ride_energy_measured_kwh", "measured", BLUE),
    ),
    "Speed [km/h]": (("telemetry.speed_kmh", "speed", BLUE),),
}
"""Title of a plot -> kind of message and field, label and colour of each line."""


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


_decode_forecast = msgspec.json.Decoder(Forecast).decode
_decode_finding = msgspec.json.Decoder(Finding).decode


class ViewerTopics:
    """Make the messages of the topics for viewers.

    The log of a car has a line when its risk to fall below the reserve enters another of the ranges of `socast ask`,
    when a counter of faulty samples of a ride reaches 1, 10, 100 and so on, and for every finding about it.
    """

    def __init__(self) -> None:
        self._level_of_risk: defaultdict[str, int] = defaultdict(lambda: INFO)
        self._digits: dict[tuple[str, str], int] = {}

    def make_messages(self, messages: Sequence[Message]) -> list[Message]:
        """Return positions and warnings.

        Returns
        -------
        list of Message
            Under `fleet/{vehicle}/location` and `fleet/{vehicle}/log` after the prefix of the key; the log of a finding
            about several vehicles is under the name of their group. The times of receipt are those of the messages.
        """
        out: list[Message] = []
        for are_samples, part in groupby(messages, holds_samples):
            several = list(part)
            out += _make_fixes(several) if are_samples else self._make_log(several)
        return out

    def _make_log(self, messages: Iterable[Message]) -> Iterator[Message]:
        """Yield the lines of the log for which forecasts and findings call."""
        for key, payload, receipt_ns in messages:
            known = address(key)
            if known is None:
                continue
            try:
                if known.kind == "forecast":
                    fleet = key.rpartition("/")[0]
                    for line in self._make_lines(known.identity, _decode_forecast(payload)):
                        yield Message(f"{fleet}/{LOG}", line, receipt_ns)
                elif known.kind == "finding":
                    prefix = key.removesuffix(f"findings/{known.identity}")
                    topic = f"{prefix}fleet/{known.identity.partition('/')[0]}/{LOG}"
                    yield Message(topic, _make_finding_line(_decode_finding(payload)), receipt_ns)
            except UNREADABLE:
                continue

    def _make_lines(self, car: str, forecast: Forecast) -> Iterator[bytes]:
        """Yield the lines of the log that a forecast calls for."""
        risk = forecast.reserve_risk
        if risk is not None:
            level = ERROR if risk > HIGH_RISK else WARNING if risk >= LOW_RISK else INFO
            if level != self._level_of_risk[car]:
                self._level_of_risk[car] = level
                line = f"{car}: the risk to fall below the reserve before the shift ends is {100.0 * risk:.0f} %"
                yield _encode_line(forecast.time_s, level, line, "reserve")
        for cause, (level, words) in QUALITY_WORDS.items():
            count = getattr(forecast.quality, cause)
            digits = len(str(count)) if count else 0
            if digits > self._digits.get((car, cause), 0):
                line = f"{car}: {words} since the ride began: {count:,}"
                yield _encode_line(forecast.time_s, level, line, "quality")
            self._digits[car, cause] = digits


def _make_fixes(messages: Sequence[Message]) -> Iterator[Message]:
    """Yield the positions of all samples of messages; none for an impossible position."""
    for vehicle_ids, numbers, columns in read_samples(messages, Counter()):
        elevation = np.nan_to_num(columns.elevation)
        for row in np.flatnonzero(columns.find_fixes()).tolist():
            key, _, receipt_ns = messages[numbers[row]]
            fleet = key.rsplit("/", 2)[0]
            time = _make_timestamp(columns.time[row].item())
            place = columns.latitude[row].item(), columns.longitude[row].item(), elevation[row].item()
            fix = LocationFix(time, vehicle_ids[row], *place)
            yield Message(f"{fleet}/{vehicle_ids[row]}/{LOCATION}", msgspec.json.encode(fix), receipt_ns)


def _make_finding_line(finding: Finding) -> bytes:
    """Return the line of a finding."""
    return _encode_line(finding.time_s, LEVEL_OF_STATUS[finding.status], finding.words, "finding")


def _encode_line(time_s: float, level: int, words: str, name: str) -> bytes:
    """Return a line of the log as JSON."""
    return msgspec.json.encode(Log(_make_timestamp(time_s), level, words, name))


def _make_timestamp(time_s: float) -> Timestamp:
    """Return a Unix time as seconds and nanoseconds; 0 for a time that no clock shows."""
    if not 0.0 <= time_s < LATEST_S:
        return Timestamp(0, 0)
    micros = round(time_s * 1e6)  # a float of Unix time resolves 0.25 µs
    return Timestamp(micros // 1_000_000, micros % 1_000_000 * 1000)


class FoxgloveRecording(Closeable):
    """Write what is replayed as it is, and beside it, for viewers only, forecasts, positions and warnings.

    The readers of socast leave out what is for viewers, so that a replay of this recording equals one of the original.

    Parameters
    ----------
    sink : McapSink
        Writer of the recording, with the schemas of `socast.tools.foxglove.topics`.
    """

    def __init__(self, sink: McapSink) -> None:
        self._sink = sink
        self._topics = ViewerTopics()
        self._cars: dict[str, None] = {}

    def record_source(self, source: Source) -> Iterator[Sequence[Message]]:
        """Yield the messages of a source, after they are recorded."""
        for messages in source:
            self._sink.put(messages)
            self._sink.put(self._topics.make_messages([each for each in messages if _is_input(each)]), for_viewers=True)
            yield messages

    def put(self, messages: Sequence[Message]) -> None:
        """Record forecasts and errors of models for viewers."""
        self._sink.put([*messages, *self._topics.make_messages(messages)], for_viewers=True)
        for key in {message.key for message in messages}:
            known = address(key)
            if known and known.kind == "forecast":
                self._cars[key.rpartition("/")[0]] = None

    def close(self) -> None:
        """Write the summary and close the file; a second call has no effect."""
        self._sink.close()

    def write_layout(self, path: Path) -> None:
        """Write a layout that shows the cars of the recording."""
        text = json.dumps(make_layout(sorted(self._cars)), indent=2) + "\n"
        try:
            write_whole(path, text.encode())
        except OSError as error:
            raise RecordingError(f"{path} cannot be written: {error.strerror}; make room") from error


def _is_input(message: Message) -> bool:
    """Return whether a message is no forecast of an earlier run."""
    known = address(message.key)
    return known is not None and known.kind != "forecast"


def make_layout(cars: Sequence[str]) -> dict[str, Any]:
    """Return a layout as Foxglove imports it.

    Parameters
    ----------
    cars : sequence of str
        Topics of cars without their last chunk, such as `montreal/fleet/taxi-7`. The first `MOST_CARS` have a tab.
    """
    panels: dict[str, Any] = {
        "map!fleet": {
            "foxglovePanelTitle": "Cars",
            "customTileUrl": "",
            "disabledTopics": [],
            "followTopic": f"{cars[0]}/{LOCATION}" if cars else "",
            "layer": "map",
            "topicColors": {},
            "zoomLevel": 11,
        }
    }
    tabs = [
        {"title": car.rpartition("/")[2], "layout": _add_car(panels, f"car{number}", car)}
        for number, car in enumerate(cars[:MOST_CARS], 1)
    ]
    panels["Tab!cars"] = {"activeTabIdx": 0, "tabs": tabs}
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": _split("row", "map!fleet", "Tab!cars", 40),
    }


def _add_car(panels: dict[str, Any], name_of_car: str, car: str) -> dict[str, Any]:
    """Add the panels of a car, and return how they divide its tab."""
    soc, energy, speed = (f"Plot!{name_of_car}{kind}" for kind in ("soc", "energy", "speed"))
    for name, (title, lines) in zip((soc, energy, speed), PLOTS.items(), strict=True):
        panels[name] = _make_plot(car, title, lines)
    log = f"RosOut!{name_of_car}log"
    panels[log] = {"topicToRender": f"{car}/{LOG}", "minLogLevel": INFO, "searchTerms": []}
    return _split("column", _split("column", soc, energy, 60), _split("column", speed, log, 50), 60)


def _make_plot(car: str, title: str, lines: Sequence[tuple[str, str, str]]) -> dict[str, Any]:
    """Return a plot over time; topics are in quotes because names of cars may have hyphens and dots."""
    paths = []
    for field, label, colour in lines:
        kind, _, rest = field.partition(".")
        value = f'"{car}/{kind}".{rest}'
        paths.append(
            {"value": value, "label": label, "color": colour, "enabled": True, "timestampMethod": "receiveTime"}
        )
    return {
        "foxglovePanelTitle": title,
        "paths": paths,
        "xAxisVal": "timestamp",
        "isSynced": True,
        "showLegend": True,
        "legendDisplay": "floating",
        "showXAxisLabels": True,
        "showYAxisLabels": True,
    }


def _split(direction: str, first: Any, second: Any, percentage: float) -> dict[str, Any]:
    """Return two parts of the window side by side (`row`) or one above the other (`column`)."""
    return {"direction": direction, "first": first, "second": second, "splitPercentage": percentage}
