"""Encode the state of every vehicle as bytes with a checksum, and decode it."""

from hashlib import sha256
from typing import Any, Final

import msgspec

from core.cleaning.kernel import STATE
from core.cleaning.quality import CAUSES
from core.errors import SocastError
from core.totals.accumulator import AMOUNTS, EDGES

SNAPSHOT: Final = 14
"""Version of the format of a snapshot."""
FIELDS: Final = [*(STATE.names or ()), *AMOUNTS, *EDGES, *CAUSES]
"""Names of the fields in the arrays of a snapshot."""
_DIGEST: Final = sha256().digest_size


def seal_snapshot(state: dict[str, Any]) -> bytes:
    """Return a state as bytes with a checksum.

    Parameters
    ----------
    state : dict of str to object
        State of plain lists, dicts, numbers and text.

    Returns
    -------
    bytes
        SHA-256 digest, followed by MessagePack.
    """
    content = msgspec.msgpack.encode({"version": SNAPSHOT, "fields": FIELDS} | state)
    return sha256(content).digest() + content


def open_snapshot(snapshot: bytes, effects: list[str]) -> dict[str, Any]:
    """Return the state that `sealed` encoded.

    Parameters
    ----------
    snapshot : bytes
        Result of `sealed`.
    effects : list of str
        Names of the effects that the pipeline sums, in its order.

    Returns
    -------
    dict of str to object
        State, with its version, fields and effects.

    Raises
    ------
    SocastError
        If the bytes are not a snapshot, or one of another version or list of effects.
    """
    digest, content = snapshot[:_DIGEST], snapshot[_DIGEST:]
    if sha256(content).digest() != digest:
        raise SocastError("not a snapshot of this product, or a damaged one: start without it")
    state: dict[str, Any] = msgspec.msgpack.decode(content, strict=False)
    if (state["version"], state["fields"], state["effects"]) != (SNAPSHOT, FIELDS, effects):
        raise SocastError(
            f"snapshot of model {state['model']}: made by another version or with other effects; start without it"
        )
    return state
