"""Test that a block of messages is the sequence of its messages, whatever it is made of."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.wire.message_block import PADDING, KeyValues, MessageBlock
from socast.core.wire.messages import Message

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


@given(st.lists(MESSAGES, max_size=4))
def test_packed_messages_equal_the_list_of_them(lists):
    keys: list[str] = []
    for number, messages in enumerate(lists):
        keys += sorted({message.key for message in messages} - set(keys))
        payloads = [message.payload for message in messages]
        block = MessageBlock.pack(keys, [keys.index(message.key) for message in messages], payloads, number)
        assert block == [message._replace(receipt_ns=number) for message in messages]


@given(st.lists(st.tuples(st.sampled_from(MAKERS), MESSAGES), max_size=4))
def test_values_of_keys_are_those_of_the_function(blocks):
    values = KeyValues(lambda key: ord(key[-1]), np.int64)
    for make, messages in blocks:
        assert values.get(make(messages)).tolist() == [ord(message.key[-1]) for message in messages]


def test_function_is_called_once_for_a_key_of_a_table_that_grows():
    called, keys = [], ["a"]
    values = KeyValues(lambda key: called.append(key) or len(called), np.int64)
    assert values.get(MessageBlock.pack(keys, [0, 0], [b"1", b"2"], 5)).tolist() == [1, 1]
    keys += ["b", "c"]
    assert values.get(MessageBlock.pack(keys, [2, 0, 1], [b"1", b"2", b"3"], 5)).tolist() == [3, 1, 2]
    assert called == ["a", "b", "c"]
    values.forget()
    assert values.get(MessageBlock.pack(keys, [0], [b"1"], 5)).tolist() == [4]


def test_unknown_value_of_a_key_is_looked_up_again():
    numbers, keys = {}, ["a", "b"]
    values = KeyValues(lambda key: numbers.get(key, -1), np.int64, unknown=-1)
    block = MessageBlock.pack(keys, [0, 1, 0], [b"1", b"2", b"3"], 5)
    assert values.get(block).tolist() == [-1, -1, -1]
    numbers["a"] = 7
    assert values.get(block).tolist() == [7, -1, 7]


def test_compact_block_holds_nothing_but_its_payloads():
    block = make_columns([Message("a", bytes(1000), 1), Message("a", b"{}", 2)])[1:]
    assert len(block.compact().columns.text) == 2 + PADDING


def test_objects_that_were_made_are_kept():
    block = make_columns([Message("a", b"{}", 1)])
    assert block.make_objects()[0] is block[0] is block[:1][0]
