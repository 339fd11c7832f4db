"""Read times, positions and displays of telemetry as columns, from single samples, lists and batches alike.

It is for viewers and commands that need no more of a sample. `socast.core.wire.decoder` decodes all fields for the
pipeline.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from functools import lru_cache
from itertools import compress
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Batch, Floats
from socast.core.files import UNREADABLE
from socast.core.settings import Limits
from socast.core.wire.arrow_batch import PREFIX, BatchError, read_rows
from socast.core.wire.json_scanner import POSITION
from socast.core.wire.messages import BATCH, IDENTITY, Message, address
from socast.core.wire.name_lookup import Texts

LIMITS: Final = Limits()
"""Limits of a batch: size of its payload, and number of its rows."""


class _Sample(msgspec.Struct):
    """Hold the parts of a telemetry sample that are read."""

    time_s: float
    latitude_deg: float | None = None
    longitude_deg: float | None = None
    speed_kmh: float | None = None
    soc_pct: float | None = None
    charging: bool | None = None
    elevation_m: float | None = None


_KINDS: Final = "telemetry", BATCH
_ENDS: Final = tuple(f"/{kind}" for kind in _KINDS)
_decode = msgspec.json.Decoder(_Sample | list[_Sample]).decode
_PLACES: Final = tuple(POSITION[name] for name in _Sample.__struct_fields__)


class SampleColumns(NamedTuple):
    """Hold n samples in wire units, NaN where unknown.

    Parameters
    ----------
    time : (n,) float. [Unix s]
    latitude, longitude : (n,) float. [deg]
    speed : (n,) float. [km/h]
    soc : (n,) float. [%]
    charging : (n,) float. 1 while the car charges, 0 while it does not.
    elevation : (n,) float. [m]
    """

    time: Floats
    latitude: Floats
    longitude: Floats
    speed: Floats
    soc: Floats
    charging: Floats
    elevation: Floats

    def find_fixes(self) -> NDArray[np.bool_]:
        """Return which samples have a position that can be that of a car, see `is_possible_fix`."""
        return is_possible_fix(self.latitude, self.longitude)


class Samples(NamedTuple):
    """Hold n samples of some cars.

    Parameters
    ----------
    numbers : sequence of int
        Number of the message of each sample, among those that are read.
    """

    vehicle_ids: Sequence[str]
    numbers: Sequence[int]
    columns: SampleColumns


def holds_samples(message: Message) -> bool:
    """Return whether the key of a message is one of telemetry or of batches."""
    return message.key.endswith(_ENDS)


def read_samples(messages: Iterable[Message], counts: Counter[str]) -> Iterator[Samples]:
    """Yield the samples of messages in their order; messages of other kinds are left out.

    Parameters
    ----------
    messages : iterable of Message
        Samples, lists of samples and batches. Rows of other vehicles than that of the key are left out.
    counts : Counter
        Number of messages by kind, which is added to; `undecodable` are those without any sample that can be used.
    """
    vehicle_ids: list[str] = []
    numbers: list[int] = []
    rows: list[tuple[Any, ...]] = []
    for number, (key, payload, _) in enumerate(messages):
        where = address(key)
        if where is None or where.kind not in _KINDS:
            continue
        is_batch = where.kind == BATCH
        if payload.startswith(PREFIX):
            if rows:
                yield _make_samples(vehicle_ids, numbers, rows)
                vehicle_ids, numbers, rows = [], [], []
            batch = _read_batch(payload, number, None if is_batch else where.identity)
            is_decoded = len(batch.vehicle_ids) > 0
            if is_decoded:
                yield batch
        else:
            decoded = [] if is_batch else _read_json(payload)
            is_decoded = len(decoded) > 0
            vehicle_ids += [where.identity] * len(decoded)
            numbers += [number] * len(decoded)
            rows += decoded
        counts[where.kind if is_decoded else "undecodable"] += 1
    if rows:
        yield _make_samples(vehicle_ids, numbers, rows)


def is_possible_fix(latitude: Floats, longitude: Floats) -> NDArray[np.bool_]:
    """Return which positions can be those of a car: known, on the map, and not the zero of a logger without a fix.

    Units: latitude [deg], longitude [deg].

    Examples
    --------
    >>> is_possible_fix(np.array([45.5, 0.0, 90.0, np.nan]), np.array([-73.6, 0.0, 0.0, 8.5])).tolist()
    [True, False, False, False]
    """
    is_on_map = (abs(latitude) < 85.0) & (abs(longitude) <= 180.0)
    return is_on_map & ((abs(latitude) > 0.01) | (abs(longitude) > 0.01))


def _read_json(payload: bytes) -> list[tuple[Any, ...]]:
    """Return the fields of a sample or of a list of samples, nothing if the payload cannot be decoded."""
    try:
        value = _decode(payload)
    except UNREADABLE:
        return []
    return [msgspec.structs.astuple(sample) for sample in (value if isinstance(value, list) else [value])]


def _make_samples(vehicle_ids: list[str], numbers: list[int], rows: list[tuple[Any, ...]]) -> Samples:
    """Return samples, given as the fields of each, as columns."""
    table = np.array(rows, np.float64)
    return Samples(vehicle_ids, numbers, SampleColumns(*np.ascontiguousarray(table.T)))


def _read_batch(payload: bytes, number: int, only: str | None) -> Samples:
    """Return the samples of a batch, a message of a number, that can be used; of one vehicle only if one is given."""
    vehicle_ids: list[str] = []
    table, is_used = np.empty((len(Batch._fields), 0)), np.zeros(0, np.bool_)
    if len(payload) <= LIMITS.payload_bytes:
        with suppress(BatchError):
            read = read_rows(payload, LIMITS.list_samples)
            vehicle_ids, table = _list_vehicles(read.vehicles), read.table
            is_named = [_is_name(name) if only is None else name == only for name in vehicle_ids]
            is_used = read.is_usable & is_named
    columns = SampleColumns(*(table[place][is_used] for place in _PLACES))
    vehicle_ids = list(compress(vehicle_ids, is_used))
    return Samples(vehicle_ids, [number] * len(vehicle_ids), columns)


def _list_vehicles(names: Texts) -> list[str]:
    """Return the names of vehicles as text; those with other than ASCII characters become other invalid names."""
    text = names.text.tobytes().decode("latin-1")
    places = names.places.tolist()
    return [text[begin : begin + size] for begin, size in zip(places, names.sizes.tolist(), strict=True)]


@lru_cache(maxsize=1 << 16)
def _is_name(name: str) -> bool:
    """Return whether a vehicle can have a name."""
    return IDENTITY.fullmatch(name) is not None
