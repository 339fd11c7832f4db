"""Recordings that were joined to one file are all read, and whatever is not read is told."""

import struct
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer

from socast.core.wire.messages import Message
from socast.stream import mcap_sections
from socast.stream.mcap_format import MAGIC
from socast.stream.mcap_reader import McapSource
from socast.tools.commands.info import describe_recording
from socast.tools.terminal.ride_source import RideSource
from tests.support.mcap_recordings import BEGIN, SECOND, make_telemetry, write_recording

DAY_NS = 86_400 * SECOND


def shift(messages, by_ns):
    """Return messages that were received later."""
    return [message._replace(receipt_ns=message.receipt_ns + by_ns) for message in messages]


def rename(messages, old, new):
    """Return messages of another car."""
    swap = [(old.encode(), new.encode()), (old, new)]
    return [m._replace(key=m.key.replace(*swap[1]), payload=m.payload.replace(*swap[0])) for m in messages]


FIRST = make_telemetry(300)
SECOND_DAY = shift(rename(make_telemetry(200), "car-0", "car-9"), DAY_NS)


def write(folder, messages, name="part.mcap"):
    return write_recording(folder / name, messages).read_bytes()


def read(path, content):
    """Return the messages of a file, and its source after the iteration."""
    path.write_bytes(content)
    source = McapSource(path)
    return [message for block in source for message in block], source


@pytest.mark.parametrize("order", [(0, 1), (1, 0), (0, 1, 0)])
def test_every_recording_of_a_joined_file_is_read_in_order_of_receipt(tmp_path, order):
    parts = [FIRST, SECOND_DAY]
    got, source = read(tmp_path / "joined.mcap", b"".join(write(tmp_path, parts[at]) for at in order))
    assert got == sorted((m for at in order for m in parts[at]), key=lambda each: each.receipt_ns)
    assert (source.joined, source.count, source.losses.lines()) == (len(order), len(got), [])
    assert source.span_ns == (got[0].receipt_ns, got[-1].receipt_ns)
    assert [message for block in source for message in block] == got


def test_recordings_that_overlap_in_time_are_merged(tmp_path):
    later = shift(rename(FIRST, "car-", "van-"), 100 * SECOND + 1)
    got, source = read(tmp_path / "joined.mcap", write(tmp_path, FIRST) + write(tmp_path, later))
    assert got == sorted([*FIRST, *later], key=lambda each: each.receipt_ns)
    assert not source.losses


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"enable_crcs": False},
        {"compression": CompressionType.NONE, "enable_crcs": False},
        {"use_chunking": False},
        {"index_types": IndexType.NONE, "use_statistics": False, "use_summary_offsets": False, "enable_crcs": False},
    ],
)
def test_joined_recordings_of_any_writer_are_read(tmp_path, settings):
    """Both use the number 1 for channels of different cars."""
    files = []
    for number in range(2):
        path = tmp_path / f"{number}.mcap"
        with path.open("wb") as file:
            writer = Writer(file, chunk_size=500, **settings)
            writer.start()
            channel = writer.register_channel(f"fleet/car-{number}/telemetry", "json", 0)
            for at in range(50):
                writer.add_message(channel, BEGIN + number * DAY_NS + at, b'{"n":%d}' % at, 0)
            writer.finish()
        files.append(path.read_bytes())
    got, source = read(tmp_path / "joined.mcap", b"".join(files))
    assert [message.key for message in got] == ["fleet/car-0/telemetry"] * 50 + ["fleet/car-1/telemetry"] * 50
    assert (source.joined, source.losses.lines()) == (2, [])


@given(keep=st.floats(0, 1))
@settings(max_examples=40, deadline=None)
def test_recording_after_one_that_breaks_off_is_read(tmp_path_factory, keep):
    folder = tmp_path_factory.mktemp("joined")
    whole, second = write(folder, FIRST), write(folder, SECOND_DAY)
    cut = whole[: 8 + round(keep * (len(whole) - 8))]
    alone, of_first = read(folder / "alone.mcap", cut)
    got, source = read(folder / "joined.mcap", cut + second)
    assert got == alone + SECOND_DAY
    assert source.losses.lines() == of_first.losses.lines()


def test_recording_after_one_whose_last_record_it_seems_to_end_is_read(tmp_path):
    whole, second = write(tmp_path, FIRST), write(tmp_path, SECOND_DAY)
    ends = [0, 8]  # places in the second recording at which records begin, and its magic
    while ends[-1] + 9 <= 200:
        ends.append(ends[-1] + 9 + int.from_bytes(second[ends[-1] + 1 : ends[-1] + 9], "little"))
    at, cuts = 8, {len(whole) - 8, len(whole) - 16}
    while at + 9 < len(whole):
        end = at + 9 + int.from_bytes(whole[at + 1 : at + 9], "little")
        cuts |= {end - taken for taken in ends if at < end - taken <= len(whole) - 8}
        at = end
    for place in sorted(cuts):
        alone, of_first = read(tmp_path / "alone.mcap", whole[:place])
        got, source = read(tmp_path / "joined.mcap", whole[:place] + second)
        assert got == alone + SECOND_DAY, place
        assert source.losses.lines() == of_first.losses.lines(), place


def test_damage_in_the_first_recording_does_not_hide_the_second(tmp_path):
    first, second = write(tmp_path, FIRST), write(tmp_path, SECOND_DAY)
    with (tmp_path / "part.mcap").open("wb") as file:
        file.write(first)
    with (tmp_path / "part.mcap").open("rb") as file:
        chunk = make_reader(file).get_summary().chunk_indexes[1]
    damaged = bytearray(first)
    struct.pack_into("<Q", damaged, chunk.chunk_start_offset + 1, len(first) - chunk.chunk_start_offset + 2000)
    got, source = read(tmp_path / "joined.mcap", bytes(damaged) + second)
    assert got[-len(SECOND_DAY) :] == SECOND_DAY
    assert got[: -len(SECOND_DAY)] == FIRST  # by the index of its summary
    assert source.joined == 2


@pytest.mark.parametrize("garbage", [b"\0" * 5000, b"garbage", MAGIC, MAGIC + b"\x01", b"\x05" * 100])
@pytest.mark.parametrize("is_followed", [False, True])
def test_bytes_that_belong_to_no_recording_are_told(tmp_path, garbage, is_followed):
    second = write(tmp_path, SECOND_DAY) if is_followed else b""
    got, source = read(tmp_path / "joined.mcap", write(tmp_path, FIRST) + garbage + second)
    assert got == FIRST + (SECOND_DAY if is_followed else [])
    assert source.losses.lines() == [f"{len(garbage):,} bytes after the end of a recording are none, and are not read"]


def test_recording_within_a_message_is_no_part_of_the_file(tmp_path):
    inner = write(tmp_path, FIRST)
    path = tmp_path / "outer.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE, enable_crcs=False, index_types=IndexType.NONE)
        writer.start()
        channel = writer.register_channel("fleet/a/telemetry", "json", 0)
        writer.add_message(channel, BEGIN, inner, 0)
        writer.finish()
    got, source = read(path, path.read_bytes())
    assert (got, source.joined) == ([Message("fleet/a/telemetry", inner, BEGIN)], 1)


def test_more_recordings_than_the_limit_are_told(tmp_path, monkeypatch):
    monkeypatch.setattr(mcap_sections, "MOST_SECTIONS", 2)
    part = write(tmp_path, FIRST)
    got, source = read(tmp_path / "joined.mcap", part * 4)
    assert len(got) == 2 * len(FIRST)
    assert f"{2 * len(part):,} bytes" in source.losses.lines()[0]


def test_spans_of_time_hold_what_an_iteration_yields(tmp_path):
    got, source = read(tmp_path / "joined.mcap", write(tmp_path, SECOND_DAY) + write(tmp_path, FIRST))
    limits = [0, BEGIN + 50 * SECOND, BEGIN + 200 * SECOND, BEGIN + DAY_NS, BEGIN + 2 * DAY_NS]
    parts = [source.read_span(begin, end) for begin, end in pairwise(limits)]
    assert [message for part in parts for message in part] == got


def test_joined_file_gives_the_tables_of_its_recordings(tmp_path):
    paths = [tmp_path / "first.mcap", tmp_path / "second.mcap"]
    for path, messages in zip(paths, (FIRST, SECOND_DAY), strict=True):
        write_recording(path, messages)
    joined = tmp_path / "joined.mcap"
    joined.write_bytes(b"".join(path.read_bytes() for path in paths))
    rides, windows = RideSource([joined]).read(library=False)
    expected = RideSource(paths).read(library=False)
    assert len(rides) > 3
    assert rides.equals(expected[0])
    assert windows.equals(expected[1])
    described = describe_recording(McapSource(joined))
    assert (described["joined"], described["messages"]) == (2, len(FIRST) + len(SECOND_DAY))
