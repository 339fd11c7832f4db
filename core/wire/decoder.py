"""Decode payloads to columns, and convert wire units to SI units.

No other module converts units of input. Inside core, all quantities have SI units: metres, seconds, kelvin, radians and
fractions of one.
"""

import struct
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import pairwise
from operator import itemgetter
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Batch, Floats, Ints, Lanes
from socast.core.columns import KMH, ZERO_CELSIUS
from socast.core.files import UNREADABLE
from socast.core.settings import Limits
from socast.core.wire.arrow_batch import PREFIX, ArrowRows, BatchReader
from socast.core.wire.json_scanner import POSITION, JsonScanner, ScannedSamples
from socast.core.wire.keys import identity
from socast.core.wire.message_block import KeyValues, MessageBlock
from socast.core.wire.messages import (
    BATCH,
    IDENTITY,
    KINDS,
    LONGEST_KEY,
    LONGEST_TEXT,
    OF_VEHICLES,
    Message,
    Telemetry,
    Wire,
    address,
)
from socast.core.wire.name_lookup import PENDING, NameLookup
from socast.core.wire.rate_limit import RateLimit
from socast.core.wire.rides import RideNames
from socast.core.wire.sample_losses import SampleLosses


class Event(NamedTuple):
    """Hold a message that is not telemetry, and its place among the telemetry rows.

    Parameters
    ----------
    row : int
        Number of telemetry rows of the batch that came before it.
    lane : int
        Lane of its vehicle, -1 for a message that is not about a vehicle.
    message : Message
        The message as it came; empty for an event that did not come as a message.
    number : int
        Its number among the decoded messages; -1 for an event that did not come as a message.
    """

    row: int
    lane: int
    value: Wire
    message: Message = Message("", b"", 0)
    number: int = -1


class Refused(NamedTuple):
    """Hold a message that cannot be used, or of whose samples some cannot be used.

    Parameters
    ----------
    samples : tuple of bytes or of int, optional
        Samples of its list, or numbers of rows of its batch, that cannot be used; None if that is the whole message.
    """

    message: Message
    samples: tuple[Any, ...] | None = None
    number: int = -1


_BLOCK: Final = 2000  # no power of two, at which columns would evict each other from the cache
_MOST_KEYS: Final = 1 << 20


def _prepare_column(values: tuple[Any, ...]) -> Any:
    """Return values in the form that numpy takes over fastest, with NaN for None."""
    if values[0] is None and values.count(None) == len(values):
        return np.nan
    try:
        return np.frombuffer(struct.pack(f"{len(values)}d", *values))
    except struct.error:  # some are None
        return np.array(values, np.float64)


class Decoder:
    """Decode messages to columns and events.

    A message that cannot be decoded never raises an error. It is counted by cause:

    - `unknown_key`;
    - `not_json`;
    - `wrong_type`: a field is missing or has the wrong type;
    - `empty_list`: a list or a batch has no samples;
    - `not_arrow`, `compressed`: a batch is damaged, or is compressed, see `socast.core.wire.arrow_batch`;
    - `key_mismatch`: the payload names another vehicle, station or model than its key;
    - `out_of_range`: a weather station has an impossible position or time;
    - `too_long`: a key or a text is too long;
    - `too_large`, `too_many_samples`, `too_many_vehicles`, `rate_limited`: see `socast.core.settings.Limits`.

    Parameters
    ----------
    lanes : Lanes
        Lanes of the vehicles; every new vehicle gets one.

    Attributes
    ----------
    batches : BatchReader
        Reader of batches, which the filter of repetitions shares.
    """

    def __init__(self, lanes: Lanes, limits: Limits = Limits()) -> None:  # noqa: B008 - immutable
        self.lanes, self._limits = lanes, limits
        self.batches = BatchReader(limits.list_samples)
        self._rates = RateLimit(limits.key_rate, limits.key_burst)
        self.received: Counter[str] = Counter()
        self.rejected: Counter[str] = Counter()
        self.losses = SampleLosses(lanes)
        self.rides = RideNames()
        self._lane_of_key: dict[str, int] = {}
        self._lanes_of_keys = KeyValues(lambda key: self._lane_of_key.get(key, -1), np.int64, unknown=-1)
        self._names, self._generation = NameLookup(lanes), self.rides.generation
        self._scanner = JsonScanner(self._names)
        self._one = msgspec.json.Decoder(Telemetry)
        self._several = msgspec.json.Decoder(list[msgspec.Raw])  # a gateway may send lists
        self._others = {kind: msgspec.json.Decoder(struct) for kind, struct in KINDS.items()}

    def decode(self, messages: Sequence[Message], refusals: list[Refused] | None = None) -> tuple[Batch, list[Event]]:
        """Decode messages in their order.

        Parameters
        ----------
        refusals : list of Refused, optional
            It receives what cannot be decoded and what is of too many vehicles, but not what exceeds a rate.
        """
        tables: list[Floats] = []
        events: list[Event] = []
        refusals = [] if refusals is None else refusals
        if self._generation != self.rides.generation:
            self._generation = self.rides.generation
            self._names.forget_rides()
        rows, block = 0, self._rates.select(messages)
        self._count_refused("rate_limited", len(messages) - len(block))
        for start, stop, is_batch in _cut_blocks(block):
            if is_batch:
                tables.append(self._decode_batch(block[start], start, refusals))
            else:
                tables.append(self._decode_block(block[start:stop], start, events, refusals, rows))
            rows += tables[-1].shape[1]
        self.received["telemetry"] += rows
        return _join_blocks(tables), events

    def keep(self, lanes: Ints) -> None:
        """Keep the state of some lanes only, in their order."""
        self._forget_lanes()
        self.losses.keep(lanes)

    def dump(self) -> Any:
        """Return the names of rides and the counters as plain lists."""
        counters = dict(sorted(self.received.items())), dict(sorted(self.rejected.items()))
        return [self.rides.dump(), *counters, self.losses.dump()]

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned, made with the same lanes."""
        rides, received, rejected, losses = state
        self.rides.load(rides)
        self.losses.load(losses)
        self.received, self.rejected = Counter(received), Counter(rejected)
        self._forget_lanes()

    def _forget_lanes(self) -> None:
        """Forget which lanes the keys and names belong to, as lanes are numbered anew."""
        self._lane_of_key.clear()
        self._lanes_of_keys.forget()
        self._names.forget()

    def refuse(self, kind: str, cause: str) -> None:
        """Count a message as rejected that had been counted as received."""
        self.received[kind] -= 1
        self.rejected[cause] += 1

    def _decode_batch(self, message: Message, number: int, refusals: list[Refused]) -> Floats:
        """Return the samples of a batch of one vehicle or of a gateway; count and note what is refused."""
        is_short = len(message.key) <= LONGEST_KEY
        whose = address(message.key) if is_short else None
        if whose is None or whose.kind not in {BATCH, "telemetry"}:
            cause: ArrowRows | str = "unknown_key" if is_short else "too_long"
        elif len(message.payload) > self._limits.payload_bytes:
            cause = "too_large"
        else:
            cause = self.batches.take(message.payload)
        if whose is None or isinstance(cause, str):
            self.rejected[str(cause)] += 1
            refusals.append(Refused(message, None, number))
            return np.empty((len(Batch._fields), 0))
        is_used = self._find_lanes(cause, None if whose.kind == BATCH else whose.identity)
        self._write_rides(cause, is_used)
        if is_used.all():
            return cause.table
        refusals.append(Refused(message, tuple(np.flatnonzero(~is_used).tolist()), number))
        return cause.table[:, is_used]

    def _find_lanes(self, rows: ArrowRows, only: str | None) -> NDArray[np.bool_]:
        """Write the lanes of the rows of a batch; count those that cannot be used, and return which can be.

        `only` is the vehicle that all rows must be of; None for any.
        """
        numbers = range(len(rows.is_usable))
        is_long = rows.rides.is_known & (rows.rides.sizes > LONGEST_TEXT)
        for at in np.flatnonzero(is_long).tolist():  # characters count, not bytes
            is_long[at] = len(rows.rides.get(at)) > LONGEST_TEXT
        faults = {"wrong_type": ~rows.is_usable, "too_long": is_long}
        if only is not None:
            faults["key_mismatch"] = np.array([rows.vehicles.get(at) != only for at in numbers])
        is_used = np.ones(len(numbers), np.bool_)
        for cause, fault in faults.items():
            self._count_refused(cause, int(np.count_nonzero(is_used & fault)))
            is_used &= ~fault
        lanes = self._names.find_lanes(rows.vehicles)
        for at in np.flatnonzero(is_used & (lanes < 0)).tolist():  # of vehicles that may be new
            lanes[at] = self._find_new_lane(rows.vehicles.get(at))
        rows.table[POSITION["vehicle_id"]] = lanes
        return is_used & (lanes >= 0)

    def _find_new_lane(self, name: str) -> int:
        """Return the lane of a vehicle in a batch; count its sample and return -1 if it can have none."""
        if not IDENTITY.fullmatch(name):
            self.rejected["wrong_type"] += 1
            return -1
        lane = self._find_lane(name)
        return -1 if lane is None else lane

    def _write_rides(self, rows: ArrowRows, is_used: NDArray[np.bool_]) -> None:
        """Write the codes of the rides of those rows of a batch that are used."""
        codes = rows.table[POSITION["ride_id"]]
        lanes = np.where(is_used, rows.table[POSITION["vehicle_id"]], -1.0).astype(np.int64)
        self._names.find_rides(rows.rides, lanes, codes)
        for at in np.flatnonzero(is_used & (codes == PENDING)).tolist():
            name = rows.rides.get(at)
            codes[at] = self.rides[name]
            self._names.remember_ride(int(lanes[at]), name, codes[at])

    def _decode_block(
        self, block: MessageBlock, first: int, events: list[Event], refusals: list[Refused], rows: int
    ) -> Floats:
        """Decode a block: the scanner takes the usual samples of known vehicles, the others are decoded one by one.

        `first` is the number of its first message, and `rows` that of samples before it.
        """
        scan = self._scanner.scan(block, self._lanes_of_keys.get(block))
        odd = np.flatnonzero(~scan.is_scanned).tolist()
        samples: list[Telemetry] = []
        lanes: list[int] = []
        places: list[int] = []
        for number, at in enumerate(odd):
            message = block[at]
            if not self._decode_sample(message, samples, lanes):
                place = first + at, rows + at - number
                refusal = self._decode_other(message, place, samples, lanes, events)
                if refusal is not None:
                    refusals.append(refusal)
            places += [at] * (len(samples) - len(places))
        self._number_rides(scan, places, samples)
        if not odd:
            return scan.table
        taken = np.flatnonzero(scan.is_scanned)
        order = np.argsort(np.concatenate([taken, np.array(places, np.int64)]), kind="stable")
        return np.concatenate([scan.table[:, taken], self._make_table(samples, lanes)], axis=1)[:, order]

    def _number_rides(self, scan: ScannedSamples, places: list[int], samples: list[Telemetry]) -> None:
        """Give a code to each new name of a ride in the order of messages, and write those of scanned samples."""
        if not (pending := scan.list_pending()):
            return
        others = zip(places, [sample.ride_id for sample in samples], strict=True)
        for _, name in sorted([*pending, *others], key=itemgetter(0)):
            _ = self.rides[name]  # a new name receives the next code
        for at, name in pending:
            self._names.remember_ride(int(scan.table[POSITION["vehicle_id"], at]), name, self.rides[name])
        scan.write_codes({at: self.rides[name] for at, name in pending})

    def _decode_sample(self, message: Message, samples: list[Telemetry], lanes: list[int]) -> bool:
        """Add a message to the samples of its block if it is one valid sample of a known vehicle."""
        lane = self._lane_of_key.get(message.key)
        if lane is None or len(message.payload) > self._limits.payload_bytes:
            return False
        try:
            sample = self._one.decode(message.payload)
        except UNREADABLE:
            return False
        if sample.vehicle_id != self.lanes.names[lane]:
            return False
        samples.append(sample)
        lanes.append(lane)
        return True

    def _decode_other(
        self,
        message: Message,
        place: tuple[int, int],
        samples: list[Telemetry],
        lanes: list[int],
        events: list[Event],
    ) -> Refused | None:
        """Add the content of a message to the samples or events of its block; count and return what is refused.

        `place` is its number, and the number of scanned samples before it.
        """
        number, rows = place
        whose = address(message.key) if len(message.key) <= LONGEST_KEY else None
        if whose is None:
            self.rejected["unknown_key" if len(message.key) <= LONGEST_KEY else "too_long"] += 1
        elif len(message.payload) > self._limits.payload_bytes:
            self.rejected["too_large"] += 1
        elif whose.kind == BATCH:
            self.rejected["not_arrow"] += 1
        elif whose.kind == "telemetry":
            good, bad = self._decode_samples(message.payload, whose.identity)
            if good and (lane := self._find_lane(whose.identity, len(good))) is not None:
                if len(self._lane_of_key) >= _MOST_KEYS:  # strangers may make up prefixes
                    self._lane_of_key.clear()
                self._lane_of_key[message.key] = lane
                lanes += [lane] * len(good)
                samples += good
                return Refused(message, tuple(bad), number) if bad else None
        else:
            value = self._decode_object(self._others[whose.kind], message.payload, whose.identity)
            lane = self._find_lane(whose.identity) if value is not None and whose.kind in OF_VEHICLES else -1
            if value is not None and lane is not None:
                self.received[whose.kind] += 1
                events.append(Event(rows + len(lanes), lane, value, message, number))
                return None
        return Refused(message, None, number)

    def _find_lane(self, name: str, number: int = 1) -> int | None:
        """Return the lane of a vehicle; count its messages and return None where there are too many vehicles."""
        if self.lanes.find(name) is None and len(self.lanes) >= self._limits.vehicles:
            self.rejected["too_many_vehicles"] += number
            return None
        return self.lanes.lane(name)

    def _count_refused(self, cause: str, number: int) -> None:
        """Count messages that are refused."""
        if number:
            self.rejected[cause] += number

    def _decode_samples(self, payload: bytes, identity: str) -> tuple[list[Telemetry], list[Any]]:
        """Return the valid samples of a payload, which holds one sample or a list of them, and the others as bytes."""
        parts: list[Any]
        try:
            parts = self._several.decode(payload)
        except UNREADABLE:
            parts = [payload]
        if not parts:
            self.rejected["empty_list"] += 1
        if len(parts) > self._limits.list_samples:
            self.rejected["too_many_samples"] += len(parts)
            return [], parts
        decoded = [self._decode_object(self._one, part, identity) for part in parts]
        bad = [part for part, sample in zip(parts, decoded, strict=True) if sample is None]
        return [sample for sample in decoded if sample is not None], bad

    def _decode_object(self, decoder: msgspec.json.Decoder[Any], payload: Any, whose: str) -> Any:
        """Decode one object whose identity must match its key; count the cause and return None if it cannot be used."""
        try:
            value = decoder.decode(payload)
        except msgspec.ValidationError as error:
            self.rejected["too_long" if "of length <=" in str(error) else "wrong_type"] += 1
        except UNREADABLE:
            self.rejected["not_json"] += 1
        else:
            if identity(value) == whose:
                return value
            self.rejected["key_mismatch"] += 1
        return None

    def _make_table(self, samples: list[Telemetry], lanes: list[int]) -> Floats:
        """Return samples as rows of floats, in wire units."""
        names = self.rides
        table = np.empty((len(Batch._fields), len(lanes)))
        for field, values in zip(Telemetry.__struct_fields__, _transpose(samples), strict=bool(samples)):
            if field == "vehicle_id":
                table[POSITION[field]] = lanes
            elif field == "ride_id":
                table[POSITION[field]] = [names[name] for name in values]
            else:
                table[POSITION[field]] = _prepare_column(values)
        return table


def _cut_blocks(messages: MessageBlock) -> Iterator[tuple[int, int, bool]]:
    """Yield the begin and end of each block, and whether it is a batch; a batch is a block of its own."""
    maybe = np.flatnonzero(messages.get_first_bytes() == PREFIX[0]).tolist()
    batches = {at for at in maybe if messages[at].payload.startswith(PREFIX)}
    cuts = sorted({0, len(messages), *batches, *(at + 1 for at in batches)})
    for first, last in pairwise(cuts):
        yield from ((at, min(at + _BLOCK, last), first in batches) for at in range(first, last, _BLOCK))


def _transpose(samples: list[Telemetry]) -> list[tuple[Any, ...]]:
    """Return one tuple per field instead of one struct per sample."""
    return list(zip(*map(msgspec.structs.astuple, samples), strict=True))


def _join_blocks(tables: list[Floats]) -> Batch:
    """Join blocks, and convert wire units to SI units."""
    table = tables[0] if len(tables) == 1 else np.concatenate([np.empty((len(Batch._fields), 0)), *tables], axis=1)
    with np.errstate(over="ignore"):  # a huge value becomes infinite, and out of range
        for column, scale in _SCALES.items():
            table[column] *= scale
    for column, offset in _OFFSETS.items():
        table[column] += offset
    batch = Batch._make(table)  # of floats so far
    return batch._replace(lane=batch.lane.astype(np.int64), ride=batch.ride.astype(np.int64))


_SCALES: Final = {
    POSITION["latitude_deg"]: np.pi / 180,
    POSITION["longitude_deg"]: np.pi / 180,
    POSITION["speed_kmh"]: KMH,
    POSITION["odometer_km"]: 1000.0,
    POSITION["soc_pct"]: 0.01,
}
_OFFSETS: Final = {POSITION["battery_temperature_c"]: ZERO_CELSIUS, POSITION["ambient_c"]: ZERO_CELSIUS}
