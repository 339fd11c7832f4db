"""Rewrite batches of samples in Arrow's format: their columns are made anew, so that nothing else of them passes."""

from collections.abc import Callable
from itertools import compress
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from socast.core.batch import Floats
from socast.core.settings import Limits
from socast.core.wire.arrow_batch import BatchError, read_rows, write_rows
from socast.core.wire.json_scanner import POSITION
from socast.core.wire.messages import IDENTITY, LONGEST_TEXT
from socast.core.wire.name_lookup import Texts
from socast.tools.anonymise.disguise import Disguise

LIMITS: Final = Limits()
"""Limits of a batch, as consumers have them: size of its payload, and number of its rows."""
_KIND_OF_NAME: Final = {"vehicle_id": "car", "ride_id": "ride"}
_TIME: Final = POSITION["time_s"]
_PLACE: Final = [POSITION["latitude_deg"], POSITION["longitude_deg"]]


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
