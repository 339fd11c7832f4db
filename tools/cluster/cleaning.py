"""The third stage: the cars of a part go through the steps of the pipeline, in their order and with the shared events.

The totals of rides and windows are written as they close, with their lanes in the whole fleet and their places among
all messages. What the display of a car stands for is learned later, over all cars (`socast.tools.cluster.displays`).
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any, BinaryIO, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Batch, Floats, Ints
from socast.core.cleaning.quality import CAUSES
from socast.core.files import replacing
from socast.core.forecast.day_rollover import DailyUpdate
from socast.core.pipeline import Pipeline
from socast.core.settings import BOUNDS_OF_LIMITS, Limits
from socast.core.totals.accumulator import EDGES, Sums, Totals
from socast.core.totals.context import RunContext
from socast.core.totals.display_record import create_unknown_yields
from socast.core.totals.run_counters import RunCounters
from socast.core.wire.decoder import Event
from socast.core.wire.message_order import MessageOrder, Silence
from socast.core.wire.messages import KINDS, Vehicle, Weather
from socast.core.wire.rides import RideNames
from socast.tools.cluster.decoding import decode_events, read_texts
from socast.tools.cluster.job import (
    COLUMNS,
    Job,
    load_surroundings,
    read_arrays,
    read_columns,
    write_arrays,
    write_text,
)
from socast.tools.cluster.ordering import Placed, Shared

LEAST_ROWS: Final = 20_000
"""Number of samples that pass through the pipeline at a time."""
END: Final = 1 << 62
"""Place of what closes at the end of the recordings."""
MOST: Final = Limits(vehicles=BOUNDS_OF_LIMITS["vehicles"][1], vehicle_models=BOUNDS_OF_LIMITS["vehicle_models"][1])
_KIND: Final = EDGES.index("kind")


@dataclass(frozen=True)
class PartCounts:
    """Hold the counters of a part.

    Parameters
    ----------
    received, rejected : Counter
        What is added to the counters of the ordering.
    fixes : dict
        Counts of the fixes on the map, empty without a map.
    """

    samples: list[int]
    received: Counter[str]
    rejected: Counter[str]
    lost: int
    fixes: dict[str, Any]
    rides: int
    windows: int


class TotalsFile:
    """Write totals to a file of floats by row, and their places, lanes and kinds of car to another one.

    Parameters
    ----------
    lanes : (cars,) int
        Lane in the fleet of each car of the part.
    """

    def __init__(self, job: Job, part: int, name: str, lanes: Ints) -> None:
        self._job, self._part, self._name, self._lanes = job, part, name, lanes
        self._index: list[Ints] = []
        self.rows = 0

    def write(self, totals: Totals, file: BinaryIO) -> None:
        """Append totals."""
        if not len(totals.lane):
            return
        at = np.where(totals.at < 0, END, totals.at)
        lane = self._lanes[totals.lane]
        parts = [np.stack([at, lane, totals.ride, totals.window], axis=1), *totals[4:8]]
        np.concatenate(parts, axis=1).tofile(file)
        self._index.append(np.stack([at, lane, totals.last[:, _KIND].astype(np.int64)]))
        self.rows += len(at)

    def close(self) -> None:
        """Write the places, lanes and kinds."""
        index = np.concatenate([np.empty((3, 0), np.int64), *self._index], axis=1)
        write_arrays(self._job.of_part(self._part, f"{self._name}.index"), at=index[0], lane=index[1], kind=index[2])


def count_columns(width: int) -> int:
    """Return the number of columns in a file of totals with a number of amounts."""
    return 4 + width + 2 * len(EDGES) + len(CAUSES)


def read_totals(rows: Floats, width: int) -> Totals:
    """Return totals from the rows of their file."""
    at, lane, ride, window = rows[:, :4].astype(np.int64).T
    places = np.cumsum([4, width, len(EDGES), len(EDGES)])
    amounts, first, last, quality = map(np.ascontiguousarray, np.split(rows, places, axis=1)[1:])
    return Totals(at, lane, ride, window, amounts, first, last, quality, create_unknown_yields(len(rows)))


class _WaitingDisplays:
    """Write totals, with the names of the rides, and leave their displays for later."""

    def __init__(self, names: RideNames, take: Callable[[Sums, list[str | None]], None]) -> None:
        self._get_names, self._take = names.names, take

    def attach(self, sums: Sums, lanes: int) -> Sums:  # noqa: ARG002 - as of DisplayYields
        """Write totals, and return them."""
        self._take(sums, self._get_names(sums.rides.at_last("code").tolist()) if len(sums.rides.lane) else [])
        return sums

    def apply_daily_update(self, kind_of_lane: Ints) -> None:
        """Do nothing."""


class _GivenOrder(MessageOrder):
    """Hold places among the messages of all cars."""

    def __init__(self, of_rows: Ints, of_events: Sequence[int]) -> None:
        self.of_rows, self._of_events, self.size = of_rows, of_events, 0

    def of_event(self, number: int) -> int:
        """Return the place of a message that is not telemetry."""
        return self._of_events[number]


class _SampleCounters(RunCounters):
    """Leave the counts of rides for later."""

    def count_rides(self, rides: Totals, context: RunContext) -> None:
        """Do nothing."""


class _PartPipeline(Pipeline):
    """Run the steps on the cars of a part, and write the totals that close."""

    def __init__(self, job: Job, vehicles: Sequence[str], kinds: Sequence[Vehicle], take: Any) -> None:
        model, elevation_map = load_surroundings(job)
        super().__init__(
            model,
            job.settings,
            also=job.wanted,
            keep_forecasts=False,
            keep_tables=False,
            two_sided=True,
            elevation_map=elevation_map,
            limits=MOST,
        )
        displays: Any = _WaitingDisplays(self.decoder.rides, take)
        self.totals.displays, self.totals.counters = displays, _SampleCounters()
        self.lanes.load(vehicles)
        self.cars.load([[msgspec.to_builtins(message) for message in kinds], [0] * len(vehicles), {}])
        self.totals.cleaner.fleet_clock["check"] = np.inf  # silences come as events

    def process(self, batch: Batch, places: Ints, events: Sequence[tuple[int, int, Any]]) -> None:
        """Run all steps on samples with their places, and on events: place, lane and value of each."""
        rows = np.searchsorted(places, [place for place, *_ in events], side="right")  # a silence follows its sample
        values = [Event(int(row), lane, value) for row, (_, lane, value) in zip(rows, events, strict=True)]
        self._process(batch, values, _GivenOrder(places, [place for place, *_ in events]), [])
        self._forget_ride_names()


def clean_part(job: Job, part: int) -> PartCounts:
    """Clean the samples of the cars of a part, and write the totals of their rides and windows."""
    shared = msgspec.msgpack.decode(job.of_run("shared").read_bytes(), type=Shared)
    lanes = np.array([lane for lane, name in enumerate(shared.vehicles) if job.find_part(name) == part], np.int64)
    names: list[str | None] = []
    with ExitStack() as files:
        rides, windows = (TotalsFile(job, part, name, lanes) for name in ("rides", "windows"))
        to_rides, to_windows = (
            files.enter_context(files.enter_context(replacing(job.of_part(part, name), is_kept=False)).open("wb"))
            for name in ("rides", "windows")
        )

        def take(sums: Sums, ride_names: list[str | None]) -> None:
            rides.write(sums.rides, to_rides)
            windows.write(sums.windows, to_windows)
            names.extend(ride_names)

        pipeline = _PartPipeline(job, [shared.vehicles[lane] for lane in lanes], shared.kinds, take)
        stored = read_arrays(job.of_run("events"))
        spans = [Placed(*each) for each in stored["spans"].tolist()]
        _run(pipeline, job, part, spans, lanes, _list_shared_events(stored, shared, lanes))
        pipeline.finish()
    for file in (rides, windows):
        file.close()
    write_text(job.of_part(part, "names"), {"ride_id": names})
    return PartCounts(
        pipeline.totals.counters.samples.tolist(),
        pipeline.decoder.received,
        pipeline.decoder.rejected,
        int(pipeline.decoder.losses.lost().sum()),
        pipeline.totals.cleaner.map_lookup.count_fixes().get("elevation_map", {}),
        rides.rows,
        windows.rows,
    )


def _list_shared_events(stored: Mapping[str, NDArray[Any]], shared: Shared, lanes: Ints) -> list[tuple[int, int, Any]]:
    """Return weather, daily updates, and the silences of the cars of a part, in their order."""
    decode = msgspec.json.Decoder(Weather).decode
    events: list[tuple[int, int, Any]] = [(each.place, -1, decode(each.payload)) for each in shared.weather]
    updates = zip(stored["update_place"].tolist(), stored["update_midnight"].tolist(), strict=True)
    events += [(place, -1, DailyUpdate(midnight)) for place, midnight in updates]
    own = np.isin(stored["silence_lane"], lanes)
    local = np.searchsorted(lanes, stored["silence_lane"][own]).tolist()
    silence = Silence()
    events += [(place, lane, silence) for place, lane in zip(stored["silence_place"][own].tolist(), local, strict=True)]
    events.sort(key=lambda event: event[:2])
    return events


def _run(
    pipeline: _PartPipeline,
    job: Job,
    part: int,
    spans: Sequence[Placed],
    lanes: Ints,
    shared: Sequence[tuple[int, int, Any]],
) -> None:
    """Pass the samples and messages of a part through the pipeline, some spans at a time."""
    batches: list[Floats] = []
    places: list[Ints] = []
    events: list[tuple[int, int, Any]] = []
    taken = 0
    for number, span in enumerate(spans):
        table, place = _read_rows(pipeline, job, part, span, lanes, events)
        batches.append(table)
        places.append(place)
        if sum(map(len, places)) < LEAST_ROWS and number + 1 < len(spans):
            continue
        end = 2 * (span.first + span.items) + 1
        first = taken
        while taken < len(shared) and shared[taken][0] < end:
            taken += 1
        whole = np.concatenate(batches, axis=1)
        batch = Batch(*whole)
        batch = batch._replace(lane=batch.lane.astype(np.int64), ride=batch.ride.astype(np.int64))
        ordered = sorted([*events, *shared[first:taken]], key=lambda event: event[:2])
        pipeline.process(batch, np.concatenate(places), ordered)
        batches, places, events = [], [], []


def _read_rows(
    pipeline: _PartPipeline, job: Job, part: int, span: Placed, lanes: Ints, events: list[tuple[int, int, Any]]
) -> tuple[Floats, Ints]:
    """Return the samples of a part in a span with their places, and append the messages of its cars to events."""
    order = read_arrays(job.of_span(span.number, "order"))
    texts = read_texts(job, span.number)
    start, stop = order["starts"][part : part + 2].tolist()
    table = read_columns(job.of_span(span.number, "rows"), span.rows, start, stop, range(len(COLUMNS)))
    kept = order.get("kept")
    if kept is not None:
        table = table[:, kept[table[-1].astype(np.int64)]]
    fields, place = table[:-1], 2 * (span.first + table[-1].astype(np.int64)) + 1
    lane, ride = (Batch._fields.index(name) for name in ("lane", "ride"))
    local = np.searchsorted(lanes, order["lanes"])
    fields[lane] = local[fields[lane].astype(np.int64)]
    fields[ride] = _assign_codes(pipeline, fields[ride].astype(np.int64), texts.rides)
    for event in decode_events(texts, part):
        if kept is None or kept[event.item]:
            value = _DECODERS[event.kind].decode(event.payload)
            events.append((2 * (span.first + event.item) + 1, int(local[event.lane]), value))
    return fields, place


def _assign_codes(pipeline: Pipeline, code: Ints, names: Sequence[str]) -> Ints:
    """Return the codes of rides in the pipeline of a part from those in a span."""
    used = np.unique(code[code >= 0])
    codes = np.full(len(names) + 1, -1)  # the last one stands for no ride, -1
    codes[used] = [int(pipeline.decoder.rides[names[each]]) for each in used]
    return codes[code]


_DECODERS: Final = {kind: msgspec.json.Decoder(struct) for kind, struct in KINDS.items()}
