"""Find the messages before which a vehicle is queried about its shift, from the event times in the messages alone.

The day is divided into slots of `QUERY_INTERVAL`. A vehicle is queried when its first sample of another slot is about
to be taken, so that the answer rests on all messages before that sample, and on no other. A list or batch of samples is
taken as a whole, and counts by the first sample of each vehicle in it. How a source divides messages into lists changes
nothing.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from math import floor, isfinite
from typing import Final

import msgspec

from socast.core.wire.arrow_batch import PREFIX
from socast.core.wire.messages import BATCH, Message, address
from socast.core.wire.sample_reader import read_samples

QUERY_INTERVAL: Final = 1800.0
"""Length of a slot. [s]"""


class _SampleTime(msgspec.Struct, gc=False):
    """The time of a sample, whose other fields are not decoded."""

    time_s: float


class QueryTimes:
    """Cut lists of messages where a vehicle is to be queried.

    Examples
    --------
    >>> times = QueryTimes()
    >>> sample = lambda time: Message("fleet/taxi-7/telemetry", b'{"time_s": %d}' % time, 0)
    >>> [(len(part), due) for part, due in times.cut([sample(1790), sample(1797), sample(1803)])]
    [(2, 'taxi-7'), (1, None)]
    """

    def __init__(self) -> None:
        self._slots: dict[str, int] = {}
        self._decoder = msgspec.json.Decoder(_SampleTime | list[_SampleTime])

    def cut(self, messages: Sequence[Message]) -> Iterator[tuple[Sequence[Message], str | None]]:
        """Yield the messages in parts, each with the vehicle that is due after it; the last part has none."""
        start = 0
        for place, message in enumerate(messages):
            for vehicle_id, slot in self._find_slots(message):
                before = self._slots.get(vehicle_id)
                if slot is None or slot == before:
                    continue
                self._slots[vehicle_id] = slot
                if before is not None:
                    yield messages[start:place], vehicle_id
                    start = place
        yield messages[start:], None

    def _find_slots(self, message: Message) -> Iterable[tuple[str, int | None]]:
        """Return the vehicles of a message and the slots of their first samples in it."""
        whose = address(message.key)
        if whose is None or whose.kind not in {"telemetry", BATCH}:
            return ()
        if not message.payload.startswith(PREFIX):
            return ((whose.identity, self._find_slot(message.payload)),) if whose.kind != BATCH else ()
        first: dict[str, int | None] = {}
        for vehicle_ids, _, columns in read_samples([message], Counter()):
            for vehicle_id, time in zip(vehicle_ids, columns.time.tolist(), strict=True):
                first.setdefault(vehicle_id, floor(time / QUERY_INTERVAL))
        return first.items()

    def _find_slot(self, payload: bytes) -> int | None:
        """Return the slot of a sample, or of the first of several; None where a payload tells no time."""
        try:
            sample = self._decoder.decode(payload)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            return None
        if isinstance(sample, list):
            if not sample:
                return None
            sample = sample[0]
        return floor(sample.time_s / QUERY_INTERVAL) if isfinite(sample.time_s) else None
