"""Test that the compiled hash is XXH64, as the package `xxhash` computes it."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from xxhash import xxh64_intdigest

from socast.core.wire.message_block import MessageBlock
from socast.core.wire.messages import Message
from socast.core.wire.text_hash import hash_texts

texts = st.one_of(st.binary(max_size=40), st.integers(0, 300).map(lambda size: bytes(range(256))[:size] * 2))


@given(st.lists(st.tuples(texts, st.integers(0, 2**64 - 1)), max_size=8))
def test_hash_is_xxh64_at_any_size_and_seed(pairs):
    columns = MessageBlock.of([Message("fleet/a/telemetry", text, 0) for text, _ in pairs]).columns
    out = np.empty(len(pairs), np.uint64)
    seeds = np.array([seed for _, seed in pairs], np.uint64)
    hash_texts(columns.text, columns.words, columns.starts, columns.sizes, seeds, out)
    assert out.tolist() == [xxh64_intdigest(text, seed) for text, seed in pairs]
