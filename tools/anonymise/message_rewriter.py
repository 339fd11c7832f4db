"""Rewrite messages of a recording: only fields of the wire contract pass, each in its disguise; prefixes of keys go."""

from collections import Counter
from typing import Any, Final

import msgspec

from socast.core.vehicles import load_catalogue
from socast.core.wire.arrow_batch import PREFIX, BatchError
from socast.core.wire.messages import (
    BATCH,
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
from socast.tools.anonymise.batch_rewriter import rewrite_batch
from socast.tools.anonymise.disguise import Disguise

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
_UNREADABLE: Final = (msgspec.MsgspecError, UnicodeDecodeError, RecursionError)


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
        except _UNREADABLE:
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
