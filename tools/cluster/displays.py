"""The fourth stage: what the display of each car stands for is learned from the rides of all cars, in their order.

The rides and windows of all parts are put in the order of their ends, which is that of a serial run. The pooled yields
of a vehicle model change with each daily update, so the pass goes from update to update.
"""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from socast.core.batch import Ints
from socast.core.files import replacing
from socast.core.totals.accumulator import AMOUNTS, EDGES, Sums, Totals
from socast.core.totals.display_record import create_unknown_yields
from socast.core.totals.display_yield import DisplayYields
from socast.core.vehicles.fleet import UNKNOWN
from socast.tools.cluster.cleaning import END, count_columns, read_totals
from socast.tools.cluster.job import Job, read_arrays, read_rows, read_text, write_text
from socast.tools.cluster.ordering import Ordering

RIDES_AT_A_TIME: Final = 4000
"""Number of rides that are learned from at a time."""
AFTER_ALL: Final = END + 1
"""Place after everything."""


@dataclass(frozen=True)
class Slice:
    """Describe a file of the tables.

    Parameters
    ----------
    of_parts : list of (int, int)
        Rows of each part that the file holds.
    """

    name: str
    number: int
    start: int
    stop: int
    of_parts: list[tuple[int, int]]


@dataclass(frozen=True)
class _Sequence:
    """Hold the order of the rides or windows of all parts: the part, row, place, lane and kind of each."""

    part: Ints
    row: Ints
    at: Ints
    lane: Ints
    kind: Ints

    @classmethod
    def of(cls, job: Job, name: str) -> "_Sequence":
        """Return the order by the places, and by the lanes where places are equal."""
        stored = [read_arrays(job.of_part(part, f"{name}.index")) for part in range(job.parts)]
        at, lane, kind = (np.concatenate([each[key] for each in stored]) for key in ("at", "lane", "kind"))
        sizes = [len(each["at"]) for each in stored]
        part = np.repeat(np.arange(job.parts), sizes)
        row = np.concatenate([np.arange(size) for size in sizes])
        order = np.lexsort((lane, at))
        return cls(*(column[order] for column in (part, row, at, lane, kind)))

    def cut(self, job: Job, name: str, size: int) -> list[Slice]:
        """Return files of a number of rows."""
        done = np.zeros(job.parts, np.int64)
        slices = []
        for number, start in enumerate(range(0, max(len(self.at), 1), size)):
            stop = min(start + size, len(self.at))
            now = done + np.bincount(self.part[start:stop], minlength=job.parts)
            slices.append(Slice(name, number, start, stop, list(zip(done.tolist(), now.tolist(), strict=True))))
            done = now
        return slices


def learn_displays(job: Job, ordering: Ordering, width: int, sizes: Mapping[str, int]) -> list[Slice]:
    """Write what the displays of all rides and windows stand for, and the names and drivers of the rides."""
    rides, windows = (_Sequence.of(job, name) for name in ("rides", "windows"))
    displays = DisplayYields(ordering.cars)
    kind_of_lane = np.full(len(ordering.lanes), UNKNOWN)
    changes = deque(ordering.list_changes())
    yields = [create_unknown_yields(len(each.at)) for each in (rides, windows)]
    first, begin = 0, 0
    for place in [*(place for place, _ in ordering.updates), AFTER_ALL]:
        stop, end = (int(np.searchsorted(each.at, place)) for each in (rides, windows))
        while first < stop or begin < end:
            last = min(first + RIDES_AT_A_TIME, stop)
            while last < stop and rides.at[last] == rides.at[last - 1]:
                last += 1
            until = end if last == stop else int(np.searchsorted(windows.at, rides.at[last]))
            totals, of_windows = _read(job, rides, first, last, width), _make_light(windows, begin, until)
            sums = displays.attach(Sums(totals, _NONE, of_windows, _NONE), len(kind_of_lane))
            yields[0][first:last], yields[1][begin:until] = sums.rides.display, sums.windows.display
            first, begin = last, until
        while changes and changes[0][0] < place:
            _, lane, kind = changes.popleft()
            kind_of_lane[lane] = kind
        if place < AFTER_ALL:
            displays.apply_daily_update(kind_of_lane)
    for name, each in zip(("rides", "windows"), yields, strict=True):
        with replacing(job.of_run(f"{name}.displays"), is_kept=False) as own:
            each.tofile(own)
    _write_names(job, ordering, rides)
    return [*rides.cut(job, "rides", sizes["rides"]), *windows.cut(job, "windows", sizes["windows"])]


def _read(job: Job, rides: _Sequence, first: int, last: int, width: int) -> Totals:
    """Return the totals of rides of all parts, in their order."""
    part, row = rides.part[first:last], rides.row[first:last]
    out = np.empty((last - first, count_columns(width)))
    for each in np.unique(part).tolist():
        mine = np.flatnonzero(part == each)
        start, stop = int(row[mine[0]]), int(row[mine[-1]]) + 1
        out[mine] = read_rows(job.of_part(each, "rides"), out.shape[1], start, stop)
    return read_totals(out, width)


def _make_light(sequence: _Sequence, first: int, last: int) -> Totals:
    """Return totals with places, lanes and kinds only."""
    part = slice(first, last)
    return _fill_light(sequence.at[part], sequence.lane[part], sequence.kind[part])


def _fill_light(at: Ints, lane: Ints, kind: Ints) -> Totals:
    """Return totals of which nothing else is known."""
    edges = np.zeros((len(at), len(EDGES)))
    edges[:, EDGES.index("kind")] = kind
    nothing = np.zeros((len(at), len(AMOUNTS)))
    return Totals(at, lane, at, at, nothing, edges, edges, nothing, create_unknown_yields(len(at)))


def _write_names(job: Job, ordering: Ordering, rides: _Sequence) -> None:
    """Write the names and the drivers of all rides, in their order."""
    stored = [read_text(job.of_part(part, "names"), "ride_id") for part in range(job.parts)]
    names = [stored[part][row] for part, row in zip(rides.part.tolist(), rides.row.tolist(), strict=True)]
    vehicles = [ordering.lanes.names[lane] for lane in rides.lane.tolist()]
    drivers = ordering.drivers.find_all(vehicles, names, rides.at.tolist())
    table = {"ride_id": names, "driver_id": drivers}
    write_text(job.of_run("names"), table)


_NONE: Final = _fill_light(*np.zeros((3, 0), np.int64))
