"""The second stage: one pass over the messages of all cars in their order, which finds whatever couples cars.

Cars are coupled by

- repeated messages: the memory of the filter turns over by the messages of all cars;
- the fleet clock, by which a silent car is noticed (`socast.core.cleaning.silences`);
- the day, on which the cars vote, and with it the daily update;
- the numbers of cars and of vehicle models, which are given in the order of their first message;
- the drivers of rides, of which the oldest are forgotten, and the weather.

The pass reads the hash of each message and nine columns of each sample. It takes the spans in their order while later
ones are still being decoded.

Every message, and every sample of a list, is an item; the place of item i is 2 i + 1. A daily update before its sample
takes the even place between.
"""

from collections import Counter
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np

from socast.core.batch import Batch, Ints, Lanes
from socast.core.cleaning.silences import INPUTS, FleetSilences
from socast.core.errors import RecordingError
from socast.core.forecast.day_rollover import DayRollover
from socast.core.settings import Limits
from socast.core.vehicles.fleet import TOO_MANY_MODELS, Cars, ReplacedKind
from socast.core.wire.duplicate_filter import DuplicateFilter
from socast.core.wire.message_order import VehicleChange
from socast.core.wire.messages import KINDS, Ride, Vehicle, Weather
from socast.core.wire.rides import RideDrivers
from socast.tools.cluster.decoding import EVENT, SAMPLE, Span, SpanEvent, decode_events, read_texts
from socast.tools.cluster.job import Job, read_arrays, read_columns, write_arrays

_COLUMNS: Final = [Batch._fields.index(name) for name in ("lane", *INPUTS)]


class SharedMessage(msgspec.Struct, array_like=True):
    """Hold an observation of the weather, which every part takes, and its place."""

    place: int
    payload: bytes


class Shared(msgspec.Struct):
    """Hold what every part needs to know of the whole fleet.

    Parameters
    ----------
    vehicles : list of str
        Name of the car of each lane.
    kinds : list
        Messages that describe the kinds of car, in the order of their numbers.
    """

    vehicles: list[str]
    kinds: list[Vehicle]
    weather: list[SharedMessage]


class Placed(NamedTuple):
    """Describe where a span stands: its number, the number of its first item, and its numbers of items and samples."""

    number: int
    first: int
    items: int
    rows: int


class Ordering:
    """Take spans in their order.

    Attributes
    ----------
    lanes : Lanes
        All cars, in the order of their first message.
    cars : Cars
        The kinds of car; `of_lane` is that of the end.
    received, rejected : Counter
        Messages by kind, and those that cannot be used by cause.
    """

    def __init__(self, job: Job, limits: Limits = Limits()) -> None:  # noqa: B008 - immutable
        self._job, self._limits = job, limits
        self.lanes, self.cars, self.drivers = Lanes(), Cars(limits), RideDrivers()
        self._spans: list[Placed] = []
        self._replaced: list[ReplacedKind] = []
        self.updates: list[tuple[int, float]] = []
        self.received, self.rejected = Counter[str](), Counter[str]()
        self._duplicates, self._days = DuplicateFilter(self.lanes, limits), DayRollover()
        self._silences = FleetSilences(job.settings)
        self._silent: list[tuple[Ints, Ints]] = []
        self._weather: list[SharedMessage] = []
        self._stations = set[str](), set[str]()
        self._decoders = {kind: msgspec.json.Decoder(struct) for kind, struct in KINDS.items()}
        self._items = 0

    @property
    def dropped(self) -> int:
        """Return the number of messages that came again."""
        return self._duplicates.dropped

    def take(self, span: Span) -> None:
        """Take the next span."""
        job, number = self._job, span.number
        stored = read_arrays(job.of_span(number, "items"))
        texts = read_texts(job, number)
        lane_of = np.empty(len(texts.vehicles), np.int64)
        is_new = self._select_new(stored, texts.vehicles, lane_of)
        self.rejected.update(span.rejected)
        item, kind = stored["item"].astype(np.int64), stored["kind"]
        rows = item[is_new & (kind == SAMPLE)]
        kept = set(item[is_new & (kind == EVENT)].tolist())
        changes: list[VehicleChange] = []
        for event in decode_events(texts):
            if event.item in kept:
                lane = int(lane_of[event.lane]) if event.lane >= 0 else -1
                self._take_event(event, lane, rows, changes)
        self._take_rows(span, stored["position"][is_new[kind == SAMPLE]], rows, lane_of, changes)
        arrays = {"lanes": lane_of, "starts": stored["starts"]}
        if not is_new.all():
            arrays["kept"] = np.zeros(span.items, np.bool_)
            arrays["kept"][item[is_new]] = True
        write_arrays(job.of_span(number, "order"), **arrays)
        self._spans.append(Placed(number, self._items, span.items, span.rows))
        self._items += span.items

    def finish(self) -> None:
        """Write what the parts need."""
        stations = max(map(len, self._stations))
        for name, count, most in (
            ("vehicles", len(self.lanes), self._limits.vehicles),
            ("weather stations", stations, self._limits.stations),
            ("vehicle messages beyond the limits", self.cars.unpredictable[TOO_MANY_MODELS], 0),
        ):
            if count > most:
                raise RecordingError(
                    f"the recordings hold {count:,} {name}, and the limit is {most:,.0f}; read them without --cluster"
                )
        job = self._job
        silent = [np.concatenate(parts) for parts in zip(*self._silent, strict=True)] or [np.empty(0, np.int64)] * 2
        updates = np.array(self.updates, np.float64).reshape(-1, 2)
        write_arrays(
            job.of_run("events"),
            silence_place=silent[0],
            silence_lane=silent[1],
            update_place=updates[:, 0].astype(np.int64),
            update_midnight=updates[:, 1],
            spans=np.array(self._spans, np.int64).reshape(-1, len(Placed._fields)),
        )
        kinds = [message for message in self.cars.messages if message is not None]
        shared = Shared(self.lanes.names, kinds, self._weather)
        job.of_run("shared").write_bytes(msgspec.msgpack.encode(shared))

    def list_changes(self) -> list[tuple[int, int, int]]:
        """Return the changes of the kinds of cars after all spans: place, lane and new kind of each."""
        kind_of_lane = self.cars.of_lane.copy()
        changes = []
        for place, lane, earlier in reversed(self._replaced):
            changes.append((place, lane, int(kind_of_lane[lane])))
            kind_of_lane[lane] = earlier
        return changes[::-1]

    def _select_new(self, stored: dict[str, Any], vehicles: Sequence[str], lane_of: Ints) -> Any:
        """Return which items were not delivered before, and fill in the lanes of the cars of a span."""
        hashes, first = stored["hashes"], stored["first"]
        is_new, at, known = np.empty(len(hashes), np.bool_), 0, 0
        by_first = np.argsort(first)
        while at < len(hashes):
            new = self._duplicates.select_new_hashes(hashes[at:], stored["message"][at:])
            is_new[at : at + len(new)] = new
            at += len(new)
            while known < len(first) and first[by_first[known]] < at:
                lane_of[by_first[known]] = self.lanes.lane(vehicles[by_first[known]])
                known += 1
        return is_new

    def _take_rows(
        self, span: Span, position: Ints, item: Ints, lane_of: Ints, changes: Sequence[VehicleChange]
    ) -> None:
        """Find the daily updates and the silences that the samples of a span show, with the kinds of their cars."""
        columns = read_columns(self._job.of_span(span.number, "rows"), span.rows, 0, span.rows, _COLUMNS)
        columns = columns.take(position, axis=1)
        lane = lane_of[columns[0].astype(np.int64)]
        self.received["telemetry"] += len(lane)
        place = 2 * (self._items + item) + 1
        rollovers = self._days.find_rollovers(lane, columns[1 + INPUTS.index("stamp")])
        self.updates += [(int(place[row]) - 1, midnight) for row, midnight in rollovers]
        kind = self.cars.kinds(lane, changes, len(self.lanes), self._replaced)
        silences = self._silences.find(columns[1:], lane, len(self.lanes), self.cars.period.take(kind))
        self._silent.append((place[silences["place"]], silences["lane"].copy()))

    def _take_event(self, event: SpanEvent, lane: int, rows: Ints, changes: list[VehicleChange]) -> None:
        """Take a message that is not telemetry, among rows with these items; a vehicle message is a change."""
        self.received[event.kind] += 1
        place = 2 * (self._items + event.item) + 1
        if event.kind == "plan":  # concerns its car only
            return
        value = self._decoders[event.kind].decode(event.payload)
        if isinstance(value, Vehicle):
            changes.append(VehicleChange(int(np.searchsorted(rows, event.item)), lane, value, place))
        elif isinstance(value, Ride):
            self.drivers.observe(value, lane, place)
        elif isinstance(value, Weather):
            self._stations[value.issued_s is not None].add(value.station_id)
            if value.issued_s is None:
                self._weather.append(SharedMessage(place, event.payload))
