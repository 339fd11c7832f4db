"""The first stage: a span of time of all recordings is decoded, and its samples are parted by car.

A span holds the messages of a time of receipt, in the order in which a serial reader yields them. Nothing here depends
on another span: which samples were delivered before, and what else couples cars, `socast.tools.cluster.ordering`
decides.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from math import inf
from operator import attrgetter
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Batch, Ints, Lanes
from socast.core.files import replacing
from socast.core.forecast.weather_forecasts import WeatherForecasts
from socast.core.settings import BOUNDS_OF_LIMITS, Limits
from socast.core.signals.weather import Stations
from socast.core.wire.decoder import Decoder, Event, Refused
from socast.core.wire.duplicate_filter import DuplicateFilter
from socast.core.wire.message_block import MessageBlock
from socast.core.wire.messages import Message, Weather, address
from socast.stream.mcap_losses import Losses
from socast.stream.mcap_reader import McapSource
from socast.tools.cluster.job import Job, open_recording, write_arrays

SPAN_BYTES: Final = 8 << 20
"""Size of the chunks of a span; 100,000 to 200,000 samples. [B]"""
REFUSED, SAMPLE, EVENT = range(3)
"""What becomes of an item: a sample, or a message that is not telemetry."""
_LIMITS: Final = Limits(vehicles=BOUNDS_OF_LIMITS["vehicles"][1])


class SpanEvent(msgspec.Struct, array_like=True):
    """Hold a message that is not telemetry, by the number of its item and the lane of its car in the span."""

    item: int
    lane: int
    kind: str
    payload: bytes


class SpanTexts(msgspec.Struct):
    """Hold the names in a span: of cars by lane, of rides by code; and the messages that are not telemetry.

    The messages are encoded, those about the cars of each part together, and last those that are about no car.
    """

    vehicles: list[str]
    rides: list[str]
    events: list[bytes]


_read_events = msgspec.msgpack.Decoder(list[SpanEvent]).decode


@dataclass(frozen=True)
class Span:
    """Describe a decoded span.

    Parameters
    ----------
    number, items, rows : int
        Its number, and how many messages and samples of lists, and samples, it holds.
    rejected : Counter
        Messages that cannot be decoded, by cause.
    for_viewers : tuple of int
        Number of messages of each recording that are for viewers.
    """

    number: int
    items: int
    rows: int
    rejected: Counter[str]
    delivered: tuple[int, ...]
    losses: tuple[Losses, ...]
    for_viewers: tuple[int, ...]


def plan_spans(sources: Sequence[McapSource], span_bytes: int = SPAN_BYTES) -> list[tuple[float, float]]:
    """Return spans of time that together hold all messages of recordings, each with chunks of about a size.

    A chunk across the limit of two spans is read for both. A span therefore grows until it holds at least as much as
    the chunks that overlap its end, of recordings that run beside each other.

    Units: span_bytes [B].

    Returns
    -------
    list of (float, float)
        Times of receipt; the first span begins at -inf and the last one ends at inf. [Unix ns]
    """
    chunks = sorted(span for source in sources for span in source.block_spans)
    limits, size = [-inf], 0
    open_chunks: list[tuple[int, int]] = []
    for first, last, length in chunks:
        open_chunks = [(end, bytes_) for end, bytes_ in open_chunks if end >= first]
        overlapping = sum(bytes_ for _, bytes_ in open_chunks)
        if size >= max(span_bytes, 2 * overlapping) and first > limits[-1]:
            limits.append(first)
            size = 0
        open_chunks.append((last, length))
        size += length
    return list(zip(limits, [*limits[1:], inf], strict=True))


def decode_span(job: Job, number: int, start_ns: float, stop_ns: float) -> Span:
    """Decode the messages of a span of time, and write them to files."""
    sources = [open_recording(path, path.stat().st_size) for path in job.recordings]
    lists = [source.read_span(start_ns, stop_ns) for source in sources]
    messages = MessageBlock.join(lists).sort()
    lanes, refusals = Lanes(), list[Refused]()
    decoder = Decoder(lanes, _LIMITS)
    batch, events = decoder.decode(messages, refusals)
    events = _refuse_weather(decoder, events, refusals)
    hashes, samples = DuplicateFilter(lanes).hash(messages)
    items = _number_items(len(messages), samples, events, refusals)
    kind, accepted = items.kind, np.flatnonzero(items.kind)
    lane = np.full(len(kind), -1)
    lane[kind == SAMPLE], lane[items.of_events] = batch.lane, [event.lane for event in events]
    parts = np.array([job.find_part(name) for name in lanes.names], np.uint16)
    position, starts = _write_rows(job, number, batch, np.flatnonzero(kind == SAMPLE), parts)
    write_arrays(
        job.of_span(number, "items"),
        hashes=hashes[accepted],
        item=accepted.astype(np.int32),
        kind=kind[accepted],
        message=items.message[accepted].astype(np.int32),
        first=_find_first(lane[accepted], len(lanes)),
        position=position,
        starts=starts,
    )
    by_part: list[list[SpanEvent]] = [[] for _ in range(job.parts + 1)]
    for item, event in zip(items.of_events.tolist(), events, strict=True):
        part = int(parts[event.lane]) if event.lane >= 0 else job.parts
        by_part[part].append(SpanEvent(item, event.lane, _get_kind(event.message), event.message.payload))
    rides = [name for name in decoder.rides if name is not None]
    texts = SpanTexts(lanes.names, rides, list(map(msgspec.msgpack.encode, by_part)))
    with replacing(job.of_span(number, "texts"), is_kept=False) as own:
        own.write_bytes(msgspec.msgpack.encode(texts))
    return Span(
        number,
        len(kind),
        batch.size,
        decoder.rejected,
        tuple(map(len, lists)),
        tuple(source.losses for source in sources),
        tuple(source.viewer_messages.total() for source in sources),
    )


def read_texts(job: Job, number: int) -> SpanTexts:
    """Return the names in a span, and its messages that are not telemetry."""
    return msgspec.msgpack.decode(job.of_span(number, "texts").read_bytes(), type=SpanTexts)


def decode_events(texts: SpanTexts, part: int | None = None) -> list[SpanEvent]:
    """Return the messages of a span about the cars of a part, or all messages, in their order."""
    if part is not None:
        return _read_events(texts.events[part])
    return sorted((event for part in texts.events for event in _read_events(part)), key=attrgetter("item"))


def _get_kind(message: Message) -> str:
    """Return the kind of a message whose key the decoder has accepted."""
    whose = address(message.key)
    return whose.kind if whose else ""


def _refuse_weather(decoder: Decoder, events: list[Event], refusals: list[Refused]) -> list[Event]:
    """Return the messages without weather that no station of any fleet could have sent; count it as refused."""
    stations, forecasts = Stations(), WeatherForecasts()
    left = []
    for event in events:
        value = event.value
        cause = None
        if isinstance(value, Weather):
            cause = stations.admit(value) if value.issued_s is None else forecasts.admit(value)
        if cause is None:
            left.append(event)
        else:
            decoder.refuse("weather", cause)
            refusals.append(Refused(event.message, None, event.number))
    return left


class _Items(NamedTuple):
    """Hold the items of messages: a sample of a list or a batch is an item, and so is any other message.

    `kind` and `message` have an entry for each item, `of_events` the item of each event.
    """

    kind: NDArray[np.int8]
    message: Ints
    of_events: Ints


def _number_items(
    messages: int,
    samples: list[Sequence[Any]] | None,
    events: Sequence[Event],
    refusals: Sequence[Refused],
) -> _Items:
    """Return what becomes of each item of a number of messages."""
    sizes = np.ones(messages, np.int64) if samples is None else np.array([len(part) for part in samples], np.int64)
    ends = np.cumsum(sizes)
    kind = np.full(int(sizes.sum()), SAMPLE, np.int8)
    for _, bad, number in refusals:
        first, of_message = ends[number] - sizes[number], None if samples is None else samples[number]
        if bad is None or of_message is None:
            kind[first : ends[number]] = REFUSED
        else:
            listed = of_message if isinstance(of_message, range) else [bytes(sample) for sample in of_message]
            refused = set(bad if isinstance(of_message, range) else map(bytes, bad))
            kind[first : ends[number]] = [REFUSED if sample in refused else SAMPLE for sample in listed]
    of_events = np.array([ends[event.number] - 1 for event in events], np.int64)
    kind[of_events] = EVENT
    return _Items(kind, np.repeat(np.arange(len(sizes)), sizes), of_events)


def _find_first(lane: Ints, lanes: int) -> NDArray[np.int32]:
    """Return the place of the first item of each lane."""
    first = np.empty(lanes, np.int32)
    known = np.flatnonzero(lane >= 0)
    numbers, places = np.unique(lane[known], return_index=True)
    first[numbers] = known[places]
    return first


def _write_rows(
    job: Job, number: int, batch: Batch, item: Ints, parts: NDArray[np.uint16]
) -> tuple[NDArray[np.int32], Ints]:
    """Write samples, those of each part together; return the place of each in the file, and where each part begins."""
    part = parts[batch.lane] if batch.size else np.empty(0, np.uint16)
    order = np.argsort(part, kind="stable")
    position = np.empty(batch.size, np.int32)
    position[order] = np.arange(batch.size)
    with replacing(job.of_span(number, "rows"), is_kept=False) as own, own.open("wb") as file:
        for column in (*batch, item):
            column[order].astype(np.float64, copy=False).tofile(file)
    return position, np.searchsorted(part[order], np.arange(job.parts + 1)).astype(np.int64)
