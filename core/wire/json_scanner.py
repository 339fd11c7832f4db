"""Scan samples in JSON to columns without an object per sample, as far as their form is the usual one.

The scanner takes a sample only if its result is certain to be that of `msgspec`: an object of known fields, each once,
with plain strings, and with numbers whose digits a float holds exactly. Everything else it leaves to the decoder: other
fields, escapes, exponents, numbers of more digits, and everything that is no valid sample.

Notes
-----
A number of digits `m` with `k` digits after the point is `m / 10^k`. Both are exact if `m` is at most 2^53 and `k` at
most 22, so that their quotient is rounded once, as the number itself (Clinger 1990, doi:10.1145/93542.93557).
"""

from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from socast.core.batch import NO_RIDE, Batch, Floats, Ints, grown
from socast.core.columns import TELEMETRY
from socast.core.compiled_cache import njit, watch_sources
from socast.core.files import UNREADABLE
from socast.core.wire import name_lookup
from socast.core.wire.message_block import Bytes, MessageBlock
from socast.core.wire.messages import LONGEST_TEXT, Telemetry
from socast.core.wire.name_lookup import NAME, PENDING, NameLookup, is_ride_of

COLUMN_OF: Final = {"vehicle_id": "lane", "ride_id": "ride"} | {column.source: column.name for column in TELEMETRY}
POSITION: Final = {field: Batch._fields.index(column) for field, column in COLUMN_OF.items()}
"""Telemetry field -> its column among those of a batch."""
LONGEST: Final = 4096
"""Largest sample that is scanned. [B]"""

_FIELDS: Final = Telemetry.__struct_fields__
_FIELD_SIZE: Final = 24  # less than `PADDING`, as words are read at the end of a payload
_POWERS: Final = np.array([float(10**k) for k in range(19)])


class ScannedSamples(NamedTuple):
    """Hold the scanned samples of a block of messages.

    Parameters
    ----------
    table : (columns, n) float
        Samples in wire units, as columns of a `Batch`; undefined where a message could not be scanned.
    is_scanned : (n,) bool
        Whether the message is a sample that was scanned.
    rides : (n, 2) int
        Begin and end of the name of the ride in `text`, where the code of the ride is `PENDING`.
    first : (n,) int
        There, number of the message from which on the vehicle names this ride.
    """

    table: Floats
    is_scanned: NDArray[np.bool_]
    text: Bytes
    rides: Ints
    first: Ints

    def list_pending(self) -> list[tuple[int, str]]:
        """Return the number of each message from which on a vehicle names a ride without a code, with this name."""
        pending = np.flatnonzero(self.is_scanned & (self.table[POSITION["ride_id"]] == PENDING))
        at = pending[self.first[pending] == pending].tolist()
        return [(i, self.text[slice(*self.rides[i])].tobytes().decode()) for i in at]

    def write_codes(self, codes: dict[int, float]) -> None:
        """Write the codes of the rides that `list_pending` returned, by the numbers of their messages."""
        column = self.table[POSITION["ride_id"]]
        column[list(codes)] = list(codes.values())
        pending = np.flatnonzero(self.is_scanned & (column == PENDING))
        column[pending] = column[self.first[pending]]


class JsonScanner:
    """Scan the usual samples of known vehicles.

    Parameters
    ----------
    names : NameLookup
        Names of the vehicles and of their rides.
    """

    def __init__(self, names: NameLookup) -> None:
        self._names = names
        self._count = 0  # of messages so far
        self._named_at = np.zeros(0, np.int64)  # where each vehicle began to name its pending ride

    def scan(self, messages: MessageBlock, lanes: Ints) -> ScannedSamples:
        """Scan the messages of a block.

        Parameters
        ----------
        lanes : (n,) int
            Lanes of the vehicles of their keys; -1 for a message that is not to be scanned.
        """
        known, columns, n = self._names, messages.columns, len(messages)
        known.update()
        lanes = np.where(columns.sizes <= LONGEST, lanes, -1)
        table = np.empty((len(Batch._fields), n))
        is_scanned, rides, first = np.empty(n, np.bool_), np.empty((n, 2), np.int64), np.empty(n, np.int64)
        self._named_at = grown(self._named_at, len(known.cars), -1)
        stops = columns.starts + columns.sizes
        _scan(
            columns.text, columns.words, columns.starts, stops, lanes,
            known.cars, known.rides, known.ride_sizes, known.ride_codes, table, is_scanned, rides,
            first, self._named_at, self._count,
        )  # fmt: skip
        self._count += n
        return ScannedSamples(table, is_scanned, columns.text, rides, first)


class _Stamp(msgspec.Struct, gc=False):
    """Hold the only field that `read_time` looks for."""

    time_s: float


_stamp = msgspec.json.Decoder(_Stamp | list[_Stamp]).decode


def read_time(payload: bytes) -> float:
    """Return the `time_s` of a message of any kind, the first one of a list; NaN if it has none. [s]"""
    try:
        stamp = _stamp(payload)
        time_s: float = (stamp[0] if isinstance(stamp, list) else stamp).time_s
    except (*UNREADABLE, IndexError):
        return np.nan
    return time_s


def read_each_time(messages: MessageBlock) -> Floats:
    """Return the `time_s` of n messages as `read_time` does, (n,). [s]"""
    columns = messages.columns
    times = np.full(len(messages), np.nan)
    stops = np.where(columns.sizes <= LONGEST, columns.starts + columns.sizes, 0)
    _scan_times(columns.text, columns.words, columns.starts, stops, times)
    unknown = np.flatnonzero(np.isnan(times)).tolist()
    times[unknown] = [read_time(messages[at].payload) for at in unknown]
    return times


def _spell_fields() -> tuple[NDArray[np.uint64], NDArray[np.uint64]]:
    """Return the names of the fields, with the quote after them, as words of eight bytes, and masks of these words."""
    texts = [name.encode() + b'"' for name in _FIELDS]
    spelled = [np.array(each, f"S{_FIELD_SIZE}") for each in (texts, [b"\xff" * len(text) for text in texts])]
    names, masks = (each.view("<u8").reshape(len(texts), -1) for each in spelled)
    return names, masks


_FLOAT, _COUNT, _FLAG, _CAR, _RIDE = range(5)
_FORM_OF: Final = {"vehicle_id": _CAR, "ride_id": _RIDE, "charging": _FLAG, "seq": _COUNT, "occupants": _COUNT}
_FIELD_NAMES, _FIELD_MASKS = _spell_fields()
_FIELD_SIZES: Final = np.array([len(name) for name in _FIELDS])
_FORMS: Final = np.array([_FORM_OF.get(name, _FLOAT) for name in _FIELDS])
_PLACES: Final = np.array([POSITION[name] for name in _FIELDS])
_REQUIRED: Final = (1 << _FIELDS.index("vehicle_id")) | (1 << _FIELDS.index("time_s"))
_QUOTE, _COMMA, _MINUS, _POINT, _ZERO, _NINE, _COLON = (ord(each) for each in '",-.09:')
_OPEN, _CLOSE, _BACKSLASH, _BLANK, _TAB, _FEED, _RETURN = (ord(each) for each in "{}\\ \t\n\r")
_N, _T, _F = (ord(each) for each in "ntf")
_TIME: Final = np.frombuffer(b'"time_s"', "<u8")[0]
_NULL, _TRUE, _FALSE = (np.frombuffer(word, np.uint8) for word in (b"null", b"true", b"false"))
_MOST_DIGITS: Final = 18
_EXACT: Final = 2**53
_COUNT_OF_FIELDS: Final = len(_FIELDS)
_CAR_PLACE, _RIDE_PLACE = POSITION["vehicle_id"], POSITION["ride_id"]


@njit(error_model="numpy", inline="always")
def _skip(text: Any, at: int) -> int:
    """Return the place of the next byte that is no white space."""
    while text[at] <= _BLANK and (text[at] in (_BLANK, _TAB, _FEED, _RETURN)):
        at += 1
    return at


@njit(error_model="numpy", inline="always")
def _is_word(text: Any, at: int, word: Any) -> bool:
    """Return whether a word stands at a place."""
    for k in range(len(word)):  # noqa: SIM110 - numba has no all() of a generator
        if text[at + k] != word[k]:
            return False
    return True


@njit(error_model="numpy", inline="always")
def _find_field(words: Any, at: int, first: int) -> int:
    """Return the field whose name and quote stand at a place, -1 for none; `first` is the most likely one."""
    first_word, second, third = words[at], words[at + 8], words[at + 16]
    for k in range(first, first + _COUNT_OF_FIELDS):
        field = k if k < _COUNT_OF_FIELDS else k - _COUNT_OF_FIELDS
        name, mask = _FIELD_NAMES[field], _FIELD_MASKS[field]
        if first_word & mask[0] == name[0] and second & mask[1] == name[1] and third & mask[2] == name[2]:
            return field
    return -1


@njit(error_model="numpy", inline="always")
def _scan_number(text: Any, at: int, is_count: bool) -> tuple[int, float]:
    """Return the end of a number and its value; an end of -1 if the value is not certain."""
    is_negative = text[at] == _MINUS
    if is_negative:
        at += 1
    begin, digits = at, 0
    while _ZERO <= text[at] <= _NINE and at - begin < _MOST_DIGITS:
        digits = 10 * digits + text[at] - _ZERO
        at += 1
    if at == begin or (text[begin] == _ZERO and at - begin > 1):
        return -1, 0.0
    if text[at] != _POINT:
        is_odd = digits > _EXACT or (is_negative and (is_count or digits == 0))
        return (-1 if is_odd else at), (-float(digits) if is_negative else float(digits))
    at += 1
    point = at
    while _ZERO <= text[at] <= _NINE and at - begin <= _MOST_DIGITS:
        digits = 10 * digits + text[at] - _ZERO
        at += 1
    if is_count or at == point or digits > _EXACT:
        return -1, 0.0
    value = float(digits) / _POWERS[at - point]
    return at, (-value if is_negative else value)


@njit(error_model="numpy", inline="always")
def _scan_car(text: Any, at: int, names: Any, lane: int) -> int:
    """Return the end of a string that is the name of the vehicle, -1 for any other value."""
    if text[at] != _QUOTE:
        return -1
    at, k = at + 1, 0
    while k < NAME and names[lane, k] != 0 and text[at + k] == names[lane, k]:
        k += 1
    return at + k + 1 if text[at + k] == _QUOTE and (k == NAME or names[lane, k] == 0) else -1


@njit(error_model="numpy", inline="always")
def _scan_text(text: Any, at: int) -> int:
    """Return the end of a plain string of ASCII that is not too long, -1 for any other value."""
    if text[at] != _QUOTE:
        return -1
    at += 1
    begin = at
    while text[at] >= _BLANK and text[at] < 128 and text[at] not in (_QUOTE, _BACKSLASH) and at - begin <= LONGEST_TEXT:
        at += 1
    return at + 1 if text[at] == _QUOTE and at - begin <= LONGEST_TEXT else -1


@njit(error_model="numpy", inline="always")
def _scan_flag(text: Any, at: int) -> tuple[int, float]:
    """Return the end of a truth value and its number; an end of -1 for any other value."""
    if _is_word(text, at, _FALSE):
        return at + 5, 0.0
    return (at + 4, 1.0) if _is_word(text, at, _TRUE) else (-1, 0.0)


@njit(error_model="numpy")
def _scan_sample(
    text: Any, words: Any, at: int, stop: int, lane: int, cars: Any, rides: Any, ride_sizes: Any, ride_codes: Any,
    table: Any, spans: Any, i: int,
) -> bool:  # fmt: skip
    """Scan a message to the column `i` of a table; return whether all of it is certain."""
    seen, field, end, value = 0, -1, 0, 0.0
    at = _skip(text, at)
    while text[at] == (_COMMA if seen else _OPEN):
        at = _skip(text, at + 1)
        field = _find_field(words, at + 1, field + 1) if text[at] == _QUOTE else -1
        if field < 0 or seen >> field & 1:
            return False
        seen |= 1 << field
        at = _skip(text, at + _FIELD_SIZES[field] + 2)
        if text[at] != _COLON:
            return False
        at = _skip(text, at + 1)
        form, value = _FORMS[field], np.nan
        if text[at] == _N:
            end = at + 4 if _is_word(text, at, _NULL) and not _REQUIRED >> field & 1 else -1
        elif form <= _COUNT:
            end, value = _scan_number(text, at, form == _COUNT)
        elif form == _FLAG:
            end, value = _scan_flag(text, at)
        elif form == _CAR:
            end = _scan_car(text, at, cars, lane)
        else:
            end, size = _scan_text(text, at), ride_sizes[lane]
            is_same = end - at - 2 == size and is_ride_of(text, at + 1, rides, lane, size)
            value = ride_codes[lane] if is_same else PENDING
            spans[i, 0], spans[i, 1] = at + 1, end - 1
        if end < 0:
            return False
        if not np.isnan(value):
            table[_PLACES[field], i] = value
        at = _skip(text, end)
    is_whole = text[at] == _CLOSE and at < stop <= _skip(text, at + 1)  # what follows the payload may be blank
    return is_whole and seen & _REQUIRED == _REQUIRED


@njit(error_model="numpy")
def _scan_time(text: Any, words: Any, at: int, stop: int) -> float:
    """Return the only `time_s` of an object of numbers, plain strings, truth values and nulls; NaN for any other."""
    time, value, begin, end, is_time = np.nan, 0.0, _OPEN, 0, False
    at = _skip(text, at)
    while text[at] == begin:
        at = _skip(text, at + 1)
        is_time, begin, value = words[at] == _TIME, _COMMA, np.nan
        end = _scan_text(text, at)
        at = _skip(text, max(at, end))
        if end < 0 or text[at] != _COLON:
            return np.nan
        at = _skip(text, at + 1)
        if text[at] == _QUOTE:
            end = _scan_text(text, at)
        elif text[at] == _N:
            end = at + 4 if _is_word(text, at, _NULL) else -1
        elif text[at] == _T or text[at] == _F:
            end = _scan_flag(text, at)[0]
        else:
            end, value = _scan_number(text, at, False)
        if end < 0 or (is_time and (np.isnan(value) or not np.isnan(time))):
            return np.nan
        if is_time:
            time = value
        at = _skip(text, end)
    return time if text[at] == _CLOSE and at < stop <= _skip(text, at + 1) else np.nan


@njit(cache=True, error_model="numpy")
def _scan_times(text: Any, words: Any, starts: Any, stops: Any, times: Any) -> None:
    """Scan the times of messages; a message without an end is none."""
    for i in range(len(starts)):
        if stops[i] > starts[i]:
            times[i] = _scan_time(text, words, starts[i], stops[i])


@njit(error_model="numpy", inline="always")
def _is_same_name(text: Any, one: Any, other: Any) -> bool:
    """Return whether two spans of the text hold the same name."""
    size = one[1] - one[0]
    if other[1] - other[0] != size:
        return False
    for k in range(size):  # noqa: SIM110 - numba has no all() of a generator
        if text[one[0] + k] != text[other[0] + k]:
            return False
    return True


@njit(cache=True, error_model="numpy")
def _scan(
    text: Any, words: Any, starts: Any, stops: Any, lanes: Any, cars: Any, rides: Any, ride_sizes: Any,
    ride_codes: Any, table: Any, is_scanned: Any, spans: Any, first: Any, named_at: Any, count: int,
) -> None:  # fmt: skip
    """Scan messages to the columns of a table. Nothing past the end of a payload is taken for a part of it."""
    for i in range(len(lanes)):
        lane = lanes[i]
        is_scanned[i] = False
        if lane >= 0:
            for k in range(len(table)):
                table[k, i] = np.nan
            table[_CAR_PLACE, i] = lane
            table[_RIDE_PLACE, i] = NO_RIDE
            is_scanned[i] = _scan_sample(
                text, words, starts[i], stops[i], lane, cars, rides, ride_sizes, ride_codes, table, spans, i
            )
            if is_scanned[i] and table[_RIDE_PLACE, i] == PENDING:
                before = named_at[lane] - count  # negative if it is not of this block
                if before < 0 or not _is_same_name(text, spans[before], spans[i]):
                    before = i
                    named_at[lane] = count + i
                first[i] = before


watch_sources(_scan, name_lookup)
