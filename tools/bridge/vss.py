"""Signals of the COVESA Vehicle Signal Specification (VSS) over Zenoh, one signal per key.

A signal is published under `{prefix}/{vehicle}/Vehicle/...`, with slashes in place of the dots of its path. A current
or power that flows into the battery is positive, against the wire contract.

References
----------
COVESA, Vehicle Signal Specification, releases 4.0 to 6.0, `spec/Vehicle/Vehicle.vspec` and
`spec/Powertrain/TractionBattery.vspec`, https://github.com/COVESA/vehicle_signal_specification.
Eclipse KUKSA, `zenoh-kuksa-provider`, https://github.com/eclipse-kuksa/kuksa-incubation.
"""

import time
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any, Final

import msgspec

from socast.core.errors import SettingsError
from socast.core.files import UNREADABLE
from socast.core.wire.messages import IDENTITY
from socast.stream.zenoh_signals import MOST_TAKEN, SignalSample, ZenohSignals
from socast.tools.bridge.row_assembler import RowAssembler, Signal, Value, make_signal, parse_number, read_signals

NEWEST: Final = 6
"""Default major version of VSS."""
METRES_SINCE: Final = 6
"""Major version since which the distance travelled is in metres; before, it is in kilometres."""
LONGEST_PAYLOAD: Final = 4096
"""Largest size of a payload. [B]"""
TARGET: Final = b"targetValue"
"""Attachment of a wish, which is no state of the car."""
_VALUE_NAMES: Final = "value", "v"
_TIME_NAMES: Final = "timestamp", "ts", "time"


def make_signals(version: int = NEWEST) -> dict[str, Signal]:
    """Return the signals that are read, by their paths below `Vehicle/`."""
    if not 3 <= version <= 7:
        raise SettingsError(
            f"--vss-version is {version}, must be from 3 to 7; give the major version that the cars use"
        )
    signals = {path.removeprefix("Vehicle/"): signal for path, signal in read_signals("vss").items()}
    return signals | {"TraveledDistance": make_signal("odometer_km", "m" if version >= METRES_SINCE else "km")}


class VssReader:
    """Read samples of Zenoh into an assembler.

    Parameters
    ----------
    assembler : RowAssembler
        Receives values, and counts what gives none: `bad_key`, `other_signal`, `target_value`, `too_large`, `no_value`
        (null) and `bad_value`.
    prefix : str
        Chunks before the vehicle, with a slash at their end, or empty.
    vehicle : str, optional
        The only car; keys then have no chunk for the vehicle, as within a car.
    """

    def __init__(
        self, assembler: RowAssembler, prefix: str = "", vehicle: str | None = None, version: int = NEWEST
    ) -> None:
        if vehicle is not None and not IDENTITY.fullmatch(vehicle):
            raise SettingsError(f"--vehicle is {vehicle!r}, must be up to 64 letters, digits, _, . and -; rename it")
        self._assembler, self._prefix, self._vehicle = assembler, prefix, vehicle
        self._signals = make_signals(version)

    def name_keys(self) -> str:
        """Return the key expression to subscribe to."""
        return f"{self._prefix}{'' if self._vehicle else '*/'}Vehicle/**"

    def read(self, sample: SignalSample) -> None:
        """Read a sample."""
        key, payload, attachment, stamp_s, received_s = sample
        rest = key.removeprefix(self._prefix)
        vehicle, _, path = (self._vehicle, "", rest) if self._vehicle else rest.partition("/")
        if not key.startswith(self._prefix) or not vehicle or not path.startswith("Vehicle/"):
            self._assembler.drop("bad_key")
        elif (signal := self._signals.get(path.removeprefix("Vehicle/"))) is None:
            self._assembler.drop("other_signal")
        elif attachment == TARGET:
            self._assembler.drop("target_value")
        elif len(payload) > LONGEST_PAYLOAD:
            self._assembler.drop("too_large")
        else:
            value, time_s = parse_payload(payload)
            if value is None:
                self._assembler.drop("no_value")
            elif (number := parse_number(signal, value)) is None:
                self._assembler.drop("bad_value")
            else:
                time_s = time_s if time_s is not None else stamp_s
                self._assembler.take(Value(vehicle, signal.field, number, received_s, time_s, signal.rank))


class VssSource:
    """Feed the samples of a subscriber to a reader, as `socast.tools.bridge.bridge_loop.SignalSource`.

    Zenoh keeps nothing for a subscriber, so nothing is acknowledged.
    """

    def __init__(self, source: ZenohSignals, reader: VssReader) -> None:
        self._source, self._reader = source, reader
        self._samples = 0

    def feed(self, wait_s: float) -> float:
        """Read what has come, after a wait for it, and return the time up to which everything was read. [Unix s]"""
        samples = self._source.take(wait_s)
        for sample in samples:
            self._reader.read(sample)
        self._samples += len(samples)
        return samples[-1].received_s if len(samples) == MOST_TAKEN else time.time()

    def is_stalled(self) -> bool:
        """Return False: publishers wait for no acknowledgement."""
        return False

    def acknowledge(self, tickets: Sequence[Any]) -> None:
        """Do nothing."""

    def count(self) -> Mapping[str, int]:
        """Return the number of samples."""
        return {"messages": self._samples}


def parse_payload(payload: bytes) -> tuple[object, float | None]:
    """Return the value and the time of a payload.

    Units: time_s [s].

    Parameters
    ----------
    payload : bytes
        A number, a truth value or a text, as JSON or plain text; or a JSON object with the value as `value` and
        optionally its time as `timestamp`, `ts` or `time`. VISS puts this object into `dp`, or into `data` and `dp`.

    Examples
    --------
    >>> parse_payload(b"23.5"), parse_payload(b'{"value": "23.5", "timestamp": 1700000000000}')
    ((23.5, None), ('23.5', 1700000000.0))
    >>> parse_payload(b'{"path": "Vehicle.Speed", "dp": {"value": "7", "ts": "2023-11-14T22:13:20Z"}}')
    ('7', 1700000000.0)
    """
    try:
        value: Any = msgspec.json.decode(payload)
    except UNREADABLE:
        return payload.decode("utf-8", "replace"), None
    for name in ("data", "dp"):
        if isinstance(value, Mapping) and isinstance(value.get(name), Mapping):
            value = value[name]
    if not isinstance(value, Mapping):
        return value, None
    stamp = next((value[name] for name in _TIME_NAMES if name in value), None)
    return next((value[name] for name in _VALUE_NAMES if name in value), None), parse_stamp(stamp)


def parse_stamp(stamp: object) -> float | None:
    """Return the Unix time of a stamp: ISO 8601, or a number of seconds, milliseconds, microseconds or nanoseconds. [s]

    Examples
    --------
    >>> parse_stamp("2023-11-14T22:13:20Z"), parse_stamp(1_700_000_000_000), parse_stamp("noon")
    (1700000000.0, 1700000000.0, None)
    """
    if isinstance(stamp, str):
        try:
            moment = datetime.fromisoformat(stamp)
            return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
        except (ValueError, OverflowError):
            return None
    if isinstance(stamp, bool) or not isinstance(stamp, int | float) or not 0 < stamp < 1e20:
        return None
    value = float(stamp)
    while value >= 1e11:  # 1e11 s is the year 5138, and 1e11 ms is 1973
        value /= 1000.0
    return value
