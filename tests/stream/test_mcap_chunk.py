"""A chunk holds the messages that were put, and its indexes lead to each of them."""

import struct
from random import Random

import numpy as np
import pytest
import zstandard
from mcap.reader import make_reader

from socast.core.wire.message_block import MessageBlock
from socast.core.wire.messages import Message
from socast.stream.mcap_chunk import ChunkBuilder
from socast.stream.mcap_format import MESSAGE_HEAD
from socast.stream.mcap_writer import McapSink
from socast.stream.recorder import Recorder

KEYS = "fleet/a/telemetry", "fleet/b/telemetry", "fleet/b/ride", "fleet/g/batch", "fleet/a/lunch"
PAYLOADS = b"", b"{", b'{"time_s":5.5}', b'{"time_s":1e308}', b'[{"time_s":7}]', b"\xff" * 9, b"x" * 5000


def make_messages(random, number, begin=0):
    return [
        Message(random.choice(KEYS), random.choice(PAYLOADS), begin + random.randrange(10**12)) for _ in range(number)
    ]


def cut(random, messages):
    """Cut messages into parts, which come as objects, as columns, or as few messages of a large buffer."""
    while messages:
        count = random.randrange(1, 40)
        part, messages = messages[:count], messages[count:]
        joined = MessageBlock.of([*part, Message("k", bytes(200_000), 0)]).compact()[: len(part)]
        yield random.choice([part, MessageBlock.of(part).compact(), joined])


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.filterwarnings("error")
def test_indexes_lead_to_every_message(seed):
    random = Random(seed)
    messages = make_messages(random, 200)
    chunk = ChunkBuilder()
    for part in cut(random, messages):
        chunk.put(MessageBlock.of(part), for_viewers=False)
    numbers = {key: i + 1 for i, key in enumerate(KEYS)}
    packed = chunk.pack([numbers, {}], [[f"record of {key}".encode()] for key in KEYS], lambda data: data)
    data = packed.record[packed.record.index(b"record of") :]
    found = []
    begins = packed.places.tolist()
    for begin, end in zip(begins, [*begins[1:], len(packed.indexes)], strict=True):
        index = bytes(packed.indexes[begin:end])
        _, _, channel, size = struct.unpack_from("<BQHI", index)
        assert size == len(index) - 15
        for receipt_ns, place in struct.iter_unpack("<QQ", index[15:]):
            opcode, length, number, _, log_time, _ = MESSAGE_HEAD.unpack_from(data, place)
            assert (opcode, number, log_time) == (5, channel, receipt_ns)
            payload = data[place + MESSAGE_HEAD.size : place + 9 + length]
            found.append((place, Message(KEYS[channel - 1], payload, receipt_ns)))
    assert [message for _, message in sorted(found)] == messages
    assert packed.channels.tolist() == sorted({numbers[message.key] for message in messages})
    assert packed.counts.tolist() == [sum(m.key == KEYS[n - 1] for m in messages) for n in packed.channels.tolist()]


@pytest.mark.parametrize("chunk_bytes", [300, 7000, 1 << 20])
@pytest.mark.parametrize("seed", range(5))
def test_recording_holds_what_was_put_in_parts(tmp_path, seed, chunk_bytes):
    random = Random(seed)
    messages, shown = make_messages(random, 300), make_messages(random, 50)
    with McapSink(tmp_path / "r.mcap", chunk_bytes) as sink:
        for part in cut(random, messages):
            sink.put(part)
            sink.put(shown[:1], for_viewers=True)
            shown = shown[1:]
        assert sink.messages >= sink.kept
    with (tmp_path / "r.mcap").open("rb") as file:
        read = [
            Message(channel.topic, message.data, message.log_time)
            for _, channel, message in make_reader(file).iter_messages(log_time_order=False)
            if not channel.metadata
        ]
    assert read == messages


def test_only_keys_of_messages_become_channels(tmp_path):
    keys = [f"fleet/{i}/lunch" for i in range(70_000)]
    with McapSink(tmp_path / "r.mcap") as sink:
        sink.put(MessageBlock.pack(keys, [69_999, 5], [b"a", b"b"], 1))
    with (tmp_path / "r.mcap").open("rb") as file:
        assert make_reader(file).get_summary().statistics.channel_count == 2


def test_many_keys_of_one_block_go_to_several_files(tmp_path):
    keys = [f"fleet/{i}/lunch" for i in range(70_000)]
    with Recorder(tmp_path) as recorder:
        recorder.put(MessageBlock.pack(keys, np.arange(70_000), [b""] * 70_000, 1))
        assert (recorder.recorded, recorder.unrecorded) == (70_000, 0)
    assert len(recorder.files) == 2


def test_chunk_without_messages_is_none():
    assert ChunkBuilder().pack([{}, {}], [], zstandard.ZstdCompressor().compress) is None
