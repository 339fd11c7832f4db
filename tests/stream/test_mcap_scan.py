"""Test that the compiled loop finds what a loop over records finds, and stops at the same place."""

import struct

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from socast.stream.mcap_format import CHANNEL, MESSAGE, MESSAGE_HEAD, RECORD, SCHEMA
from socast.stream.mcap_scan import scan_chunk


def make_record(opcode, body, excess):
    return RECORD.pack(opcode, len(body) + excess) + body


BODIES = st.one_of(
    st.binary(max_size=50),
    st.builds(
        lambda channel, receipt, payload: struct.pack("<HIQQ", channel, 7, receipt, 9) + payload,
        st.integers(0, 65535),
        st.integers(0, 2**64 - 1),
        st.binary(max_size=30),
    ),
)
OPCODES = st.sampled_from([MESSAGE, MESSAGE, MESSAGE, SCHEMA, CHANNEL, 0x80, 0x20, 0])
EXCESSES = st.sampled_from([0] * 20 + [1, 2**40, 2**63, 2**64 - 200])
RECORDS = st.lists(st.builds(make_record, OPCODES, BODIES, EXCESSES), max_size=12)


def split(data):
    """Return messages and descriptions of a chunk, and whether it is damaged."""
    at, messages, descriptions = 0, [], []
    while at < len(data):
        if at + RECORD.size > len(data):
            return messages, descriptions, True
        opcode, length = RECORD.unpack_from(data, at)
        stop = at + RECORD.size + length
        if not opcode or stop > len(data) or (opcode == MESSAGE and length < MESSAGE_HEAD.size - RECORD.size):
            return messages, descriptions, True
        if opcode == MESSAGE:
            _, _, channel, _, receipt, _ = MESSAGE_HEAD.unpack_from(data, at)
            messages.append((channel, receipt, data[at + MESSAGE_HEAD.size : stop]))
        elif opcode in {SCHEMA, CHANNEL}:
            descriptions.append((opcode, data[at + RECORD.size : stop], len(messages)))
        at = stop
    return messages, descriptions, False


@given(records=RECORDS, cut=st.integers(0, 40))
def test_compiled_loop_finds_the_records_up_to_the_damage(records, cut):
    data = b"".join(records)
    data = data[: max(0, len(data) - cut)] if cut % 4 == 1 else data
    found = scan_chunk(data)
    payloads = [found.text[at : at + size].tobytes() for at, size in zip(found.starts, found.sizes, strict=True)]
    messages = list(zip(found.channel.tolist(), found.receipts.tolist(), payloads, strict=True))
    descriptions = [(*found.get_description(at), before) for at, before in found.descriptions.tolist()]
    assert (messages, descriptions, found.is_damaged) == split(data)


def test_chunk_of_nothing_has_no_records():
    found = scan_chunk(b"")
    assert not len(found.starts)
    assert not found.is_damaged
    assert found.receipts.dtype == np.uint64
