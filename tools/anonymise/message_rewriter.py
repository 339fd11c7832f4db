"""Rewrite messages of a recording: only fields of the wire contract pass, each in its disguise; prefixes of keys go."""

from collections import Counter
from collections.abc import Callable
from itertools import compress
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from socast.core.batch import Floats
from socast.core.files import UNREADABLE
from socast.core.settings import Limits
from socast.core.vehicles import load_catalogue
from socast.core.wire.arrow_batch import PREFIX, BatchError, read_rows, write_rows
from socast.core.wire.json_scanner import POSITION
from socast.core.wire.messages import (
    BATCH,
    IDENTITY,
    LONGEST_TEXT,
    Address,
    Message,
    Plan,
    Ride,
    Telemetry,
    Vehicle,
    Weather,
    Wire,
    address,
    encode,
)
from socast.core.wire.name_lookup import Texts
from socast.tools.anonymise.disguise import Disguise

LIMITS: Final = Limits()
"""Limits of a batch, as consumers have them: size of its payload, and number of its rows."""
_KIND_OF_NAME: Final = {"vehicle_id": "car", "ride_id": "ride"}
_TIME: Final = POSITION["time_s"]
_PLACE: Final = [POSITION["latitude_deg"], POSITION["longitude_deg"]]
KEPT: Final[dict[str, type[Wire]]] = {
    "telemetry": Telemetry,
    "vehicle": Vehicle,
    "ride": Ride,
    "plan": Plan,
    "weather": Weather,
}
"""Kind of message that passes in JSON -> its struct. What consumers publish does not: a replay makes it again."""
REFUSED_BATCHES: Final = {
    "too_large": "batches too large",
    "not_arrow": "damaged batches",
    "compressed": "compressed batches",
    "too_many_samples": "batches of too many rows",
    "empty_list": "empty batches",
    "wrong_type": "batches with a column missing or of a wrong type",
}
"""Cause for which a batch cannot be used at all -> how it is counted."""


class RewrittenBatch(NamedTuple):
    """Hold a batch in its disguise.

    Parameters
    ----------
    payload : bytes
        Batch; empty if no row of the original can be used.
    left_out : int
        Number of rows that cannot be used and were left out.
    """

    payload: bytes
    positions: int
    left_out: int


def rewrite_batch(payload: bytes, disguise: Disguise, rename: Callable[[str, str], str]) -> RewrittenBatch:
    """Return a batch in its disguise.

    Columns that are no fields of telemetry and metadata are left out. Times and positions become floats of 64 bits, and
    the other columns keep their types.
    """
    if len(payload) > LIMITS.payload_bytes:
        raise BatchError("too_large")
    rows = read_rows(payload, LIMITS.list_samples)
    names = {"vehicle_id": _Names(rows.vehicles, _is_vehicle), "ride_id": _Names(rows.rides, _is_ride)}
    is_used = rows.is_usable & names["vehicle_id"].is_possible & names["ride_id"].is_possible
    used = int(np.count_nonzero(is_used))
    left_out = len(is_used) - used
    if not used:
        return RewrittenBatch(b"", 0, left_out)
    values = rows.table[:, is_used]
    values[_TIME] = disguise.shift_all(values[_TIME])
    values[_PLACE], positions = _move(values[_PLACE], disguise)
    columns = {}
    with pa.ipc.open_stream(pa.py_buffer(payload)) as reader:
        kinds = {field.name: field.type for field in reader.schema if field.name in POSITION}
    for name, kind in kinds.items():
        if pa.types.is_null(kind):
            columns[name] = pa.nulls(used)
        elif name in names:
            columns[name] = names[name].rename(is_used, kind, _KIND_OF_NAME[name], rename)
        else:
            is_changed = POSITION[name] in {_TIME, *_PLACE}
            columns[name] = _make_numbers(values[POSITION[name]], pa.float64() if is_changed else kind)
    return RewrittenBatch(write_rows(pa.table(columns)), positions, left_out)


class _Names:
    """Hold a column of names by the number of each different one.

    Attributes
    ----------
    is_possible : (n,) bool
        Whether a consumer takes the name of each row; so it does where there is none.
    """

    def __init__(self, texts: Texts, is_name: Callable[[str], bool]) -> None:
        numbers: dict[str, int] = {}
        self._numbers = np.array(
            [
                numbers.setdefault(texts.get(at), len(numbers)) if is_known else -1
                for at, is_known in enumerate(texts.is_known.tolist())
            ],
            np.int64,
        )
        self._names = list(numbers)
        self.is_possible = np.array([*map(is_name, self._names), True])[self._numbers]

    def rename(self, is_used: NDArray[np.bool_], kind: Any, whose: str, rename: Callable[[str, str], str]) -> Any:
        """Return the pseudonyms of some rows as a column of a type; names of other rows are not even hashed."""
        numbers = self._numbers[is_used]
        is_named = np.isin(np.arange(len(self._names)), numbers)
        pseudonyms = pa.array([rename(whose, name) for name in compress(self._names, is_named)], pa.string())
        place = np.append(np.cumsum(is_named) - 1, 0)[numbers]
        column = pseudonyms.take(pa.array(place, mask=numbers < 0))
        return column.dictionary_encode() if pa.types.is_dictionary(kind) else column.cast(kind)


def _is_vehicle(name: str) -> bool:
    """Return whether a vehicle can have a name."""
    return IDENTITY.fullmatch(name) is not None


def _is_ride(name: str) -> bool:
    """Return whether a ride can have a name."""
    return len(name) <= LONGEST_TEXT


def _move(places: Floats, disguise: Disguise) -> tuple[Floats, int]:
    """Return positions in their disguise, (2, n), and the number of those that are known.

    One coordinate alone is no position, and only its presence remains.
    """
    is_known = ~np.isnan(places)
    is_place = is_known.all(axis=0)
    moved = np.stack(disguise.places.move_all(*places))
    return np.where(is_place, moved, np.where(is_known, 0.0, np.nan)), int(np.count_nonzero(is_place))


def _make_numbers(values: Floats, kind: Any) -> Any:
    """Return numbers as a column of a type, null where unknown; as floats if integers of the type cannot hold them."""
    unknown = np.isnan(values)
    if pa.types.is_boolean(kind):
        return pa.array(values == 1.0, mask=unknown)
    column = pa.array(values, mask=unknown)
    try:
        return column.cast(kind)
    except pa.ArrowInvalid:
        return column


class MessageRewriter:
    """Rewrite messages, and count by cause what is dropped.

    Parameters
    ----------
    disguise : Disguise
        What turns names, times and positions into others.

    Attributes
    ----------
    dropped : Counter of str
        Number of messages by cause: `unknown key`, `of consumers`, `unreadable`, and those of `REFUSED_BATCHES`. Rows
        of other batches that cannot be used are counted as `unusable rows of batches`.
    """

    def __init__(self, disguise: Disguise) -> None:
        self.kept: Counter[str] = Counter()
        self.dropped: Counter[str] = Counter()
        kinds = "car", "gateway", "station", "ride", "driver", "model"
        self.names: dict[str, set[str]] = {kind: set() for kind in kinds}
        self.positions = 0
        self._disguise = disguise
        self._models = frozenset(load_catalogue())
        self._decoders = {kind: msgspec.json.Decoder(struct) for kind, struct in KEPT.items()}
        self._samples = msgspec.json.Decoder(list[Telemetry])
        self._pseudonyms: dict[tuple[str, str], str] = {}

    def rewrite(self, message: Message) -> Message | None:
        """Return a message in its disguise; None if it is dropped."""
        known = address(message.key)
        if known is None:
            self.dropped["unknown key"] += 1
            return None
        if known.kind not in {*KEPT, BATCH}:
            self.dropped["of consumers"] += 1
            return None
        is_batch = known.kind == BATCH or (known.kind == "telemetry" and message.payload.startswith(PREFIX))
        payload = self._rewrite_batch(message.payload) if is_batch else self._rewrite_json(known, message.payload)
        if payload is None:
            return None
        self.kept[known.kind] += 1
        receipt_ns = message.receipt_ns + self._disguise.shift_s * 1_000_000_000
        if known.kind == "weather":
            return Message(f"weather/{self._rename('station', known.identity)}", payload, receipt_ns)
        sender = "gateway" if known.kind == BATCH else "car"
        return Message(f"fleet/{self._rename(sender, known.identity)}/{known.kind}", payload, receipt_ns)

    def _rewrite_batch(self, payload: bytes) -> bytes | None:
        """Return a batch in its disguise; None if none of its rows can be used, and count what is left out."""
        try:
            rewritten = rewrite_batch(payload, self._disguise, self._rename)
        except BatchError as error:
            self.dropped[REFUSED_BATCHES[str(error)]] += 1
            return None
        self.positions += rewritten.positions
        if rewritten.left_out:
            self.dropped["unusable rows of batches"] += rewritten.left_out
        return rewritten.payload or None

    def _rewrite_json(self, known: Address, payload: bytes) -> bytes | None:
        """Return a payload in JSON in its disguise; count it and return None if it cannot be read."""
        try:
            if known.kind == "telemetry" and payload.lstrip()[:1] == b"[":
                samples = [self._rewrite(each) for each in self._samples.decode(payload)]
                return b"[" + b",".join(map(encode, samples)) + b"]"
            return encode(self._rewrite(self._decoders[known.kind].decode(payload)))
        except UNREADABLE:
            self.dropped["unreadable"] += 1
            return None

    def _rewrite(self, value: Any) -> Wire:
        """Return a decoded message in its disguise."""
        disguise = self._disguise
        changes: dict[str, Any] = {"time_s": disguise.shift(value.time_s)}
        if isinstance(value, Weather):
            changes["station_id"] = self._rename("station", value.station_id)
            changes["issued_s"] = None if value.issued_s is None else disguise.shift(value.issued_s)
            if value.wind_from_deg is not None:
                changes["wind_from_deg"] = disguise.turn(value.wind_from_deg)
        else:
            changes["vehicle_id"] = self._rename("car", value.vehicle_id)
        if isinstance(value, Telemetry | Weather):
            changes |= self._move(value.latitude_deg, value.longitude_deg)
        if isinstance(value, Telemetry | Ride) and value.ride_id is not None:
            changes["ride_id"] = self._rename("ride", value.ride_id)
        if isinstance(value, Ride) and value.driver_id is not None:
            changes["driver_id"] = self._rename("driver", value.driver_id)
        if isinstance(value, Plan):
            changes["shift_end_s"] = disguise.shift(value.shift_end_s)
        if isinstance(value, Vehicle):
            changes["in_service_date"] = None
            if value.model not in self._models:
                changes["model"] = self._rename("model", value.model)
        rewritten: Wire = msgspec.structs.replace(value, **changes)
        return rewritten

    def _move(self, latitude_deg: float | None, longitude_deg: float | None) -> dict[str, float | None]:
        """Return the fields of a position; one coordinate alone is no position, and only its presence remains."""
        if latitude_deg is None or longitude_deg is None:
            alone = {"latitude_deg": latitude_deg, "longitude_deg": longitude_deg}
            return {name: None if number is None else 0.0 for name, number in alone.items()}
        self.positions += 1
        moved = self._disguise.places.move(latitude_deg, longitude_deg)
        return dict(zip(("latitude_deg", "longitude_deg"), moved, strict=True))

    def _rename(self, kind: str, name: str) -> str:
        """Return the pseudonym of a name."""
        pseudonym = self._pseudonyms.get((kind, name))
        if pseudonym is None:
            pseudonym = self._pseudonyms[kind, name] = self._disguise.rename(kind, name)
            self.names[kind].add(pseudonym)
        return pseudonym
