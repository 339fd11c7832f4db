"""Change the current or the charge of samples in their messages; all other bytes stay."""

import re
from collections.abc import Mapping
from typing import Final

import pyarrow as pa

from socast.core.wire.arrow_batch import PREFIX, write_rows

DECIMALS: Final = {"battery_current_a": 3, "soc_pct": 1}
"""Least decimals of a field that is changed: a coarse current would swallow a small effect, a charge adds it up."""
_NUMBER: Final = rb"-?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?"
_PATTERN: Final = {name: re.compile(rb'("%s"\s*:\s*)(%s)' % (name.encode(), _NUMBER)) for name in DECIMALS}


def change_payload(payload: bytes, field: str, added: Mapping[int, float]) -> bytes:
    """Return a payload of telemetry in which a number was added to a field of some samples.

    Parameters
    ----------
    field : str
        `battery_current_a` or `soc_pct`.
    added : mapping of int to float
        Place of a sample in the message -> number that is added.

    Examples
    --------
    >>> change_payload(b'{"time_s": 1.7e9, "battery_current_a": 20.5}', "battery_current_a", {0: 0.25})
    b'{"time_s": 1.7e9, "battery_current_a": 20.75}'
    """
    if payload.startswith(PREFIX):
        return _change_batch(payload, field, added)
    if payload.lstrip()[:1] != b"[":
        return _change_object(payload, field, added.get(0, 0.0))
    out, samples = [], _split_list(payload)
    place = 0
    for is_object, part in samples:
        out.append(_change_object(part, field, added.get(place, 0.0)) if is_object else part)
        place += is_object
    return b"".join(out)


def _change_object(text: bytes, field: str, number: float) -> bytes:
    """Return the JSON text of a sample in which a number was added to a field."""
    if not number:
        return text

    def add(found: re.Match[bytes]) -> bytes:
        decimals = max(len(found[2].partition(b".")[2]), DECIMALS[field])
        value = round(float(found[2]) + number, decimals)
        return found[1] + repr(value).encode()

    return _PATTERN[field].sub(add, text, count=1)


def _split_list(payload: bytes) -> list[tuple[bool, bytes]]:
    """Return the parts of a JSON list in turn, each with whether it is an object; samples hold no other object."""
    out, last = [], 0
    for found in re.finditer(rb"\{(?:[^{}\"]|\"(?:[^\"\\]|\\.)*\")*\}", payload):
        out += [(False, payload[last : found.start()]), (True, found[0])]
        last = found.end()
    return [*out, (False, payload[last:])]


def _change_batch(payload: bytes, field: str, added: Mapping[int, float]) -> bytes:
    """Return a batch in Arrow's format in which a number was added to a field of some rows."""
    with pa.ipc.open_stream(pa.py_buffer(payload)) as reader:
        table = reader.read_all()
    at = table.schema.get_field_index(field)
    if at < 0:
        return payload
    values = table.column(at).to_pylist()
    for place, number in added.items():
        if values[place] is not None:
            values[place] += number
    kind = table.schema.field(at).type
    wide = kind if pa.types.is_floating(kind) else pa.float64()
    return write_rows(table.set_column(at, pa.field(field, wide), pa.array(values, wide)))
