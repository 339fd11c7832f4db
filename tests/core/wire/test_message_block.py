"""Test that a block of messages is the sequence of its messages, whatever it is made of."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from core.wire.message_block import PADDING, MessageBlock
from core.wire.messages import Message

MESSAGES = st.lists(
    st.builds(Message, st.sampled_from(["a", "b", "c", "fleet/é"]), st.binary(max_size=9), st.integers(0, 2**64 - 1)),
    max_size=12,
)


def make_columns(messages):
    """Return messages as a block without objects, as the reader of recordings makes it."""
    keys = sorted({message.key for message in messages})
    key = np.array([keys.index(message.key) for message in messages], np.int64)
    receipts = np.array([message.receipt_ns for message in messages], np.uint64)
    return MessageBlock(MessageBlock.of(messages).columns._replace(keys=keys, key=key, receipts=receipts))


MAKERS = MessageBlock.of, make_columns, lambda messages: make_columns(messages).compact()


@pytest.mark.parametrize("make", MAKERS)
@given(messages=MESSAGES, start=st.integers(0, 12), stop=st.integers(0, 12))
def test_block_and_its_parts_equal_the_lists(make, messages, start, stop):
    block = make(messages)
    assert len(block) == len(messages)
    assert list(block) == messages
    assert block == messages
    assert [block[at] for at in range(len(block))] == messages
    assert block[start:stop] == messages[start:stop]
    assert bool(block) == bool(messages)
    assert block.size == sum(len(message.payload) for message in messages)
    mask = np.arange(len(messages)) % 2 == 0
    assert block.take(mask) == messages[::2]
    assert block.take(np.flatnonzero(mask)[::-1]) == messages[::2][::-1]
    assert block.get_first_bytes().tolist() == [message.payload[0] if message.payload else 0 for message in messages]


@given(parts=st.lists(st.tuples(st.sampled_from(MAKERS), MESSAGES), max_size=4))
def test_joined_parts_are_sorted_by_receipt_and_keep_the_order_of_equal_times(parts):
    joined = MessageBlock.join([make(messages) for make, messages in parts])
    messages = [message for _, part in parts for message in part]
    assert joined == messages
    assert joined.sort() == sorted(messages, key=lambda message: message.receipt_ns)


@given(MESSAGES)
def test_function_of_keys_is_called_once_for_a_key(messages):
    called = []
    found = make_columns(messages).find_of_keys(lambda key: called.append(key) or ord(key[0]), np.int64)
    assert found.tolist() == [ord(message.key[0]) for message in messages]
    assert sorted(called) == sorted({message.key for message in messages})


def test_compact_block_holds_nothing_but_its_payloads():
    block = make_columns([Message("a", bytes(1000), 1), Message("a", b"{}", 2)])[1:]
    assert len(block.compact().columns.text) == 2 + PADDING


def test_objects_that_were_made_are_kept():
    block = make_columns([Message("a", b"{}", 1)])
    assert block.make_objects()[0] is block[0] is block[:1][0]
