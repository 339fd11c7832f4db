"""Recordings whose samples are in the batches of a gateway."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import pyarrow as pa

from socast.core.wire.arrow_batch import write_rows
from socast.core.wire.messages import Message, Telemetry
from socast.stream.mcap_writer import McapSink

GATEWAY = "fleet/depot-3/batch"
"""Key of the batches."""


def make_batch(samples: Sequence[dict[str, Any]], key: str = GATEWAY, receipt_ns: int = 0) -> Message:
    """Return samples, given as mappings of fields, as a batch."""
    names = dict.fromkeys(name for sample in samples for name in sample)
    table = pa.table({name: [sample.get(name) for sample in samples] for name in names})
    return Message(key, write_rows(table), receipt_ns)


def write_batched(source: Iterable[Sequence[Message]], path: Path, size: int) -> None:
    """Write a recording again with its valid samples in batches; other messages stay before and after the same ones."""
    decode = msgspec.json.Decoder(Telemetry | list[Telemetry]).decode
    with McapSink(path) as sink:
        waiting: list[dict[str, Any]] = []
        last_ns = 0

        def flush() -> None:
            if waiting:
                sink.put([make_batch(waiting, receipt_ns=last_ns)])
                waiting.clear()

        for message in (message for messages in source for message in messages):
            if not message.key.endswith("/telemetry"):
                flush()
                sink.put([message])
                continue
            try:
                value = decode(message.payload)
            except (msgspec.MsgspecError, UnicodeDecodeError):
                continue
            last_ns = message.receipt_ns
            waiting += [msgspec.structs.asdict(each) for each in (value if isinstance(value, list) else [value])]
            if len(waiting) >= size:
                flush()
        flush()
