"""Read and write batches of samples in Arrow's stream format, `application/vnd.apache.arrow.stream`.

A payload of this form begins with `PREFIX`, which no JSON text does. Its columns have the names of the fields of
`socast.core.wire.messages.Telemetry`; other columns are ignored. The payload may come from a stranger, so memory and
time are bounded by its size, and nothing is expanded before its size is checked:

- buffers must not be compressed, and only types of columns that are used are read;
- the columns of a row take `LEAST_ROW` bytes at least, because its values take many times as much;
- texts are places in the bytes of their column or dictionary, which are copied once, however many rows name them, and
  of a longer text than any name only the beginning is looked at;
- dictionaries that are sent in parts are joined up to `EXPANSION` times the payload.
"""

import struct
from collections.abc import Iterator, Sequence
from functools import lru_cache
from math import inf
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from socast.core.batch import Batch, Floats, Ints
from socast.core.compiled_cache import njit
from socast.core.wire.json_scanner import POSITION
from socast.core.wire.messages import LONGEST_TEXT
from socast.core.wire.name_lookup import NAME, Texts

PREFIX: Final = b"\xff\xff\xff\xff"
"""First bytes of a payload: the mark of a message in Arrow's stream format since version 0.15."""

LEAST_ROW: Final = 9
"""Least size of a row of a batch: a time and the code of a name. [B]"""
EXPANSION: Final = 4
"""Largest ratio of the dictionaries that are joined of several parts to the payload."""

_NAMES: Final = "vehicle_id", "ride_id"
_LONGEST: Final = {"vehicle_id": NAME, "ride_id": 4 * LONGEST_TEXT}  # a character has at most four bytes
_NUMBERS: Final = tuple(name for name in POSITION if name not in _NAMES)
_COUNTS: Final = "seq", "occupants"
_COUNT_PLACES: Final = tuple(POSITION[name] for name in _COUNTS)
_TIME: Final = POSITION["time_s"]
_NAN_BITS: Final = np.array([np.nan]).view(np.uint64)[0]
_MOST_COUNT: Final = 2.0**53
_LARGEST_HEAD: Final = 1 << 16
"""Largest size of a schema that is remembered. [B]"""
_FLOAT: Final = pa.float64()
_NEITHER: Final = pa.bool_(), pa.null(), pa.float16()
"""Types that numpy cannot take over as numbers."""
_DAMAGE: Final = (pa.ArrowException, ValueError, TypeError, LookupError, OSError, MemoryError, struct.error)


class BatchError(ValueError):
    """Tell why a batch cannot be used at all: its message is the cause, as the decoder counts it."""


class ArrowRows(NamedTuple):
    """Hold the samples of a batch.

    Parameters
    ----------
    table : (columns, n) float
        Samples in wire units, as columns of a `Batch`, NaN where unknown. Lanes and codes of rides are not written.
    vehicles, rides : Texts
        Names of the vehicle and of the ride of each row.
    is_usable : (n,) bool
        Whether the row has a name and a time, and the values of all fields are possible.
    """

    table: Floats
    vehicles: Texts
    rides: Texts
    is_usable: NDArray[np.bool_]

    def hash(self) -> NDArray[np.uint64]:
        """Return a hash of each row, which tells the car and its values and not the batch or the gateway."""
        out = np.zeros(len(self.is_usable), np.uint64)
        _hash_texts(*self.vehicles, out)
        _hash_texts(*self.rides, out)
        _hash_numbers(self.table.view(np.uint64), out)
        return out


class BatchReader:
    """Read batches once for both the filter of repetitions and the decoder.

    Parameters
    ----------
    most : float
        Largest number of rows of a batch.
    """

    def __init__(self, most: float) -> None:
        self._most = most
        self._read: dict[int, tuple[bytes, ArrowRows | str]] = {}

    def take(self, payload: bytes) -> ArrowRows | str:
        """Return the same as `read`, and forget it, so that the caller may write to it."""
        rows = self.read(payload)
        del self._read[id(payload)]
        return rows

    def read(self, payload: bytes) -> ArrowRows | str:
        """Return the samples of a batch, or the cause for which none can be used, see `read_rows`."""
        known = self._read.get(id(payload))
        if known is None or known[0] is not payload:
            try:
                known = payload, read_rows(payload, self._most)
            except BatchError as error:
                known = payload, str(error)
            self._read[id(payload)] = known
        return known[1]

    def forget(self) -> None:
        """Forget the batches that were read."""
        self._read.clear()


def read_rows(payload: bytes, most: float) -> ArrowRows:
    """Return the samples of a batch."""
    columns = _read_columns(payload, most)
    if not {"vehicle_id", "time_s"} <= columns.keys():
        raise BatchError("wrong_type")
    count = sum(map(len, columns["time_s"]))
    values = np.full((len(Batch._fields), count), np.nan)
    try:
        for name in _NUMBERS:
            if name in columns:
                values[POSITION[name]] = _read_numbers(columns[name])
        vehicles, rides = (_read_texts(columns.get(name, []), _LONGEST[name], count) for name in _NAMES)
    except _DAMAGE as error:
        raise BatchError("not_arrow") from error
    is_usable = np.empty(count, np.bool_)
    _check_rows(values, values.view(np.uint64), is_usable)
    return ArrowRows(values, vehicles, rides, is_usable & vehicles.is_known)


def read_times(payload: bytes, most: float) -> Floats:
    """Return the time of each row of a batch, NaN where unknown, without a look at other columns. [Unix s]"""
    columns = _read_columns(payload, most, ("time_s",))
    try:
        return _read_numbers(columns["time_s"])
    except _DAMAGE as error:
        raise BatchError("not_arrow") from error


def select_rows(payload: bytes, mask: Sequence[bool]) -> bytes:
    """Return a batch with some of its rows only, and without columns that are no fields of telemetry."""
    columns = {name: pa.chunked_array(chunks) for name, chunks in _read_columns(payload, inf).items()}
    return write_rows(pa.table(columns).filter(pa.array(mask)))


def write_rows(table: pa.Table) -> bytes:
    """Return a table of samples as the payload of a batch.

    Examples
    --------
    >>> write_rows(pa.table({"vehicle_id": ["taxi-7"], "time_s": [1.7e9], "soc_pct": [55.5]})).startswith(PREFIX)
    True
    """
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, table.schema) as writer:
        writer.write_table(table)
    payload: bytes = sink.getvalue().to_pybytes()
    return payload


def _read_columns(payload: bytes, most: float, names: tuple[str, ...] = tuple(POSITION)) -> dict[str, list[pa.Array]]:
    """Return the parts of each column of a batch that has one of some names, checked."""
    try:
        _check_parts(payload)
        head = payload[: 8 + struct.unpack_from("<i", payload, 4)[0]]
        select = _select_columns if len(head) <= _LARGEST_HEAD else _select_columns.__wrapped__
        kept = select(head, names)
        parts = list(_read_batches(payload, min(most, len(payload) / LEAST_ROW), kept))
    except BatchError:
        raise
    except _DAMAGE as error:
        raise BatchError("not_arrow") from error
    if not any(len(part[0]) for part in parts):
        raise BatchError("empty_list")
    return {name: [part[at] for part in parts] for at, name in enumerate(kept)}


@lru_cache(maxsize=64)
def _select_columns(head: bytes, names: tuple[str, ...]) -> dict[str, int]:
    """Return the columns with one of some names and their places: one or more, each name once, of a type that is read.

    `head` is the first part of a batch, its schema. The batches of a gateway have the same, which is read once.
    """
    schema = pa.ipc.read_schema(pa.py_buffer(head))
    kept = [i for i, name in enumerate(schema.names) if name in names]
    if not kept or len({schema.names[i] for i in kept}) < len(kept) or not all(_is_read(schema.field(i)) for i in kept):
        raise BatchError("wrong_type")
    return {schema.names[i]: i for i in kept}


def _is_read(field: pa.Field) -> bool:
    """Return whether a column has a type of which its field is read."""
    kind = field.type
    if pa.types.is_null(kind):
        return True
    if field.name in _NAMES:
        kind = kind.value_type if pa.types.is_dictionary(kind) else kind
        return bool(pa.types.is_string(kind) or pa.types.is_large_string(kind))
    if field.name == "charging":
        return bool(pa.types.is_boolean(kind))
    return bool(pa.types.is_integer(kind) or pa.types.is_floating(kind))


def _read_batches(payload: bytes, most: float, kept: dict[str, int]) -> Iterator[list[pa.Array]]:
    """Yield some columns of the parts of a batch; refuse it at the part that exceeds the number of rows."""
    rows = 0
    options = pa.ipc.IpcReadOptions(included_fields=list(kept.values()))
    with pa.ipc.open_stream(pa.py_buffer(payload), options=options) as reader:
        for batch in reader:
            rows += batch.num_rows
            if rows > most:
                raise BatchError("too_many_samples")
            batch.validate()
            columns = batch.columns
            for column in columns:  # a dictionary is checked once, not for each part, see `_read_texts`
                (column.indices if pa.types.is_dictionary(column.type) else column).validate(full=True)
            yield columns


def _read_numbers(chunks: list[pa.Array]) -> Floats:
    """Return a column of numbers, NaN where unknown."""
    parts = [
        (chunk.cast(_FLOAT) if chunk.type in _NEITHER else chunk).to_numpy(zero_copy_only=False) for chunk in chunks
    ]
    return np.asarray(parts[0] if len(parts) == 1 else np.concatenate(parts), np.float64)


def _read_texts(chunks: list[pa.Array], longest: int, count: int) -> Texts:
    """Return a column of text, with no more of each than shows that it is too long."""
    places, sizes, is_known = np.zeros(count, np.int32), np.zeros(count, np.int32), np.zeros(count, np.bool_)
    if not chunks or pa.types.is_null(chunks[0].type):
        return Texts(places, sizes, np.zeros(1, np.uint8), is_known)
    if pa.types.is_dictionary(chunks[0].type):
        values, number = _join_dictionaries(chunks)
    else:
        values, number = _join(chunks), np.arange(count)
    _, ends, text = values.buffers()
    kind = np.int64 if pa.types.is_large_string(values.type) else np.int32
    ends = np.frombuffer(ends, kind, len(values) + 1, values.offset * kind().itemsize) if len(values) else np.zeros(1)
    _locate_texts(number, ends.astype(np.int32), _find_known(values), longest, places, sizes, is_known)
    return Texts(places, sizes, np.frombuffer(text or bytes(1), np.uint8), is_known)


def _join(chunks: list[pa.Array]) -> pa.Array:
    """Return the parts of a column as one; a single part is not copied."""
    return chunks[0] if len(chunks) == 1 else pa.concat_arrays(chunks)


def _find_known(values: pa.Array) -> NDArray[np.bool_]:
    """Return which values of a column are known."""
    if not values.null_count:
        return np.ones(len(values), np.bool_)
    return np.asarray(values.is_valid().to_numpy(zero_copy_only=False))


def _join_dictionaries(chunks: list[pa.DictionaryArray]) -> tuple[pa.Array, Ints]:
    """Return the texts of the dictionaries of parts, and which of them each row has, one more than the last for none.

    Parts that follow one another share a dictionary, and its texts are not repeated.
    """
    dictionaries: list[pa.Array] = []
    firsts, counts = np.zeros((2, len(chunks)), np.int64)  # of the texts of each part
    last, begin, end = None, 0, 0
    for at, chunk in enumerate(chunks):
        values = chunk.dictionary
        memory = *(buffer.address if buffer else 0 for buffer in values.buffers()), values.offset, len(values)
        if memory != last:
            values.validate(full=True)
            dictionaries.append(values)
            last, begin, end = memory, end, end + len(values)
        firsts[at], counts[at] = begin, len(values)
    sizes = [len(chunk) for chunk in chunks]
    codes = _join([chunk.indices for chunk in chunks])
    is_known = _find_known(codes)
    number: Ints = codes.fill_null(0).to_numpy(zero_copy_only=False).astype(np.int64)
    if (((number < 0) | (number >= np.repeat(counts, sizes))) & is_known).any():
        raise ValueError("a code of a text that its dictionary lacks")
    return _join(dictionaries), np.where(is_known, number + np.repeat(firsts, sizes), end)


def _check_parts(payload: bytes) -> None:
    """Refuse a stream with compressed buffers, or with dictionaries in too many parts, by the metadata of each part.

    References
    ----------
    Apache Arrow, format/Message.fbs; the metadata are flatbuffers.
    """
    at = joined = 0
    dictionaries: dict[int, int] = {}
    while at + 8 <= len(payload):
        mark, size = struct.unpack_from("<Ii", payload, at)
        if mark != 0xFFFFFFFF or size < 0:
            raise ValueError("no mark of a message")
        if size == 0:
            return
        message = payload[at + 8 : at + 8 + size]
        root = _follow(message, 0)
        kind = _find_member(message, root, 1)
        header = _find_member(message, root, 2)
        body = _find_member(message, root, 3)
        length = struct.unpack_from("<q", message, body)[0] if body else 0
        if length < 0:
            raise ValueError("a body of negative size")
        table = _follow(message, header) if header else 0
        if header and kind and message[kind] == _DICTIONARY:
            number = _find_member(message, table, 0)
            whose = struct.unpack_from("<q", message, number)[0] if number else 0
            more = _find_member(message, table, 2)
            before = dictionaries.get(whose, 0) if more and message[more] else 0
            dictionaries[whose] = before + length
            joined += before and before + length  # all of it is copied
            if joined > EXPANSION * len(payload):
                raise BatchError("too_large")
            if data := _find_member(message, table, 1):
                table = _follow(message, data)
        if header and kind and message[kind] in {_RECORDS, _DICTIONARY} and _find_member(message, table, 3):
            raise BatchError("compressed")
        at += 8 + size + length


_DICTIONARY, _RECORDS = 2, 3


def _follow(data: bytes, at: int) -> int:
    """Return the place to which an offset of a flatbuffer leads."""
    return at + int(struct.unpack_from("<I", data, at)[0])


def _find_member(data: bytes, table: int, number: int) -> int:
    """Return the place of a member of a table of a flatbuffer, 0 if it is absent."""
    members = table - struct.unpack_from("<i", data, table)[0]
    if members < 0:
        raise ValueError("a table of members outside the message")
    if 4 + 2 * number + 2 > struct.unpack_from("<H", data, members)[0]:
        return 0
    offset = int(struct.unpack_from("<H", data, members + 4 + 2 * number)[0])
    return table + offset if offset else 0


@njit(cache=True)
def _check_rows(values: Any, bits: Any, is_usable: Any) -> None:
    """Give every unknown value the same bits, as they are hashed, and write which rows have possible values."""
    for i in range(len(is_usable)):
        is_usable[i] = not np.isnan(values[_TIME, i])
    for k in range(len(values)):
        is_count = k == _COUNT_PLACES[0] or k == _COUNT_PLACES[1]
        for i in range(len(is_usable)):
            value = values[k, i]
            if np.isnan(value):
                bits[k, i] = _NAN_BITS
            elif np.isinf(value) or (is_count and not (0.0 <= value <= _MOST_COUNT and value == np.floor(value))):
                is_usable[i] = False


@njit(cache=True)
def _locate_texts(number: Any, ends: Any, is_value: Any, longest: int, places: Any, sizes: Any, is_known: Any) -> None:
    """Write the place and size of the text of each row among n values; number n is that of none."""
    for i in range(len(number)):
        k = number[i]
        places[i] = ends[k]
        is_known[i] = k < len(is_value) and is_value[k]
        if is_known[i]:
            sizes[i] = min(ends[k + 1] - ends[k], longest + 1)


@njit(cache=True)
def _hash_texts(places: Any, sizes: Any, text: Any, is_known: Any, out: Any) -> None:
    """Add texts to the hashes of their rows."""
    factor, shift = np.uint64(0x9E3779B97F4A7C15), np.uint64(29)
    for i in range(len(out)):
        mixed = (out[i] ^ np.uint64(is_known[i])) * factor
        if is_known[i]:
            for at in range(places[i], places[i] + sizes[i]):
                mixed = (mixed ^ np.uint64(text[at])) * factor
                mixed ^= mixed >> shift
        out[i] = (mixed ^ factor) * factor


@njit(cache=True)
def _hash_numbers(values: Any, out: Any) -> None:
    """Add the bits of numbers to the hashes of their rows."""
    factor, shift = np.uint64(0x9E3779B97F4A7C15), np.uint64(29)
    for k in range(2, len(values)):  # the first columns are the lane and the code of the ride
        for i in range(len(out)):
            mixed = (out[i] ^ values[k, i]) * factor
            out[i] = mixed ^ (mixed >> shift)
