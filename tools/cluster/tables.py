"""Make tables of recordings by many workers: the stages in their order."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np

from socast.core.cleaning.quality import CAUSES
from socast.core.pipeline import Pipeline
from socast.core.totals.context import RunContext
from socast.core.totals.display_record import DISPLAY_YIELD
from socast.core.totals.logger_faults import LoggerFaults, add_faults
from socast.core.totals.run_counters import RunCounters
from socast.core.totals.tables import tabulate_rides, tabulate_windows
from socast.stream.mcap_reader import McapSource
from socast.tools.cluster.cleaning import MOST, PartCounts, clean_part, count_columns, read_totals
from socast.tools.cluster.decoding import SPAN_BYTES, Span, decode_span, plan_spans
from socast.tools.cluster.displays import Slice, learn_displays
from socast.tools.cluster.job import Job, load_surroundings, read_rows, read_text
from socast.tools.cluster.ordering import Ordering, Shared
from socast.tools.cluster.runner import Runner
from socast.tools.terminal.table_files import ParquetTable

ROWS: Final = {"rides": 20_000, "windows": 50_000}
"""Number of rows of a file of each table."""
PARTS_PER_WORKER: Final = 4
"""Number of parts for each worker, so that all have ended at about the same time."""
LARGEST_PART: Final = 2 << 30
"""Size of the recordings for which there is a part at least: a task that is lost costs no more. [B]"""


@dataclass(frozen=True)
class ClusterTables:
    """Hold what a run made."""

    rides: int
    windows: int
    quality: dict[str, Any]


def _ignore(*_: object) -> None:
    """Do nothing."""


def make_tables(
    job: Job,
    sources: Sequence[McapSource],
    out: Path,
    runner: Runner,
    report: Callable[[str, int, int], None] = _ignore,
    span_bytes: int = SPAN_BYTES,
) -> ClusterTables:
    """Write the ride table and the window table of recordings as folders of Parquet files.

    Parameters
    ----------
    report : callable
        Function that receives a stage, the number of its tasks that have ended, and the number of all.
    span_bytes : int
        Size of the chunks of a task of the first stage. [B]
    """

    def run(
        stage: str, function: Callable[..., Any], tasks: list[tuple[Any, ...]], take: Callable[[Any], None]
    ) -> None:
        report(stage, 0, len(tasks))
        for done, result in enumerate(runner.run(stage, function, tasks)):
            take(result)
            report(stage, done + 1, len(tasks))

    ordering, spans = Ordering(job), list[Span]()

    def order(span: Span) -> None:
        spans.append(span)
        ordering.take(span)

    planned = plan_spans(sources, span_bytes)
    run("decode", decode_span, [(job, number, *span) for number, span in enumerate(planned)], order)
    ordering.finish()
    _add_losses(sources, spans)
    counts: list[PartCounts] = []
    run("clean", clean_part, [(job, part) for part in range(job.parts)], counts.append)
    for file in job.scratch.glob("span-*"):
        file.unlink()
    _, width = make_context(job)
    slices = learn_displays(job, ordering, width, ROWS)
    written: list[tuple[int, Counter[str], Counter[str], LoggerFaults]] = []
    tasks = [(job, _name_file(out, piece.name, piece.number), piece) for piece in slices]
    for name in ROWS:
        _clear_folder(out / f"{name}.parquet")
    run("write", write_slice, tasks, written.append)
    rows = Counter[str]()
    for piece, (count, *_) in zip(slices, written, strict=True):
        rows[piece.name] += count
    return ClusterTables(rows["rides"], rows["windows"], _count(ordering, counts, rows["rides"], written))


def choose_parts(sources: Sequence[McapSource], workers: int) -> int:
    """Return the number of parts into which the cars are divided."""
    size = sum(length for source in sources for _, _, length in source.block_spans)
    return max(PARTS_PER_WORKER * workers, -(-size // LARGEST_PART))


def _clear_folder(folder: Path) -> None:
    """Create the folder of a table, or remove the files of an earlier table from it."""
    folder.mkdir(exist_ok=True)
    for file in folder.glob("*.parquet"):
        file.unlink()


def _name_file(out: Path, name: str, number: int) -> Path:
    """Return the path of a file of a table; files in the order of their names hold the rows in their order."""
    return out / f"{name}.parquet" / f"{name}-{number:06d}.parquet"


def _add_losses(sources: Sequence[McapSource], spans: Sequence[Span]) -> None:
    """Add to the losses of each recording what its spans have lost."""
    for i, source in enumerate(sources):
        whole = source.losses
        for span in spans:
            whole = whole.add(span.losses[i])
        if source.count is not None:
            left_out = whole.undescribed + whole.foreign.total() + sum(span.for_viewers[i] for span in spans)
            delivered = sum(span.delivered[i] for span in spans)
            whole = replace(whole, missing_messages=max(0, source.count - delivered - left_out))
        source.losses, source.blocks_read = whole, source.blocks


def _count(
    ordering: Ordering,
    parts: Sequence[PartCounts],
    rides: int,
    written: Sequence[tuple[int, Counter[str], Counter[str], LoggerFaults]],
) -> dict[str, Any]:
    """Return the counters of a run."""
    received, rejected = ordering.received, ordering.rejected
    for part in parts:
        received.update(part.received)
        rejected.update(part.rejected)
    unfit, unpredicted, faults = Counter[str](), Counter[str](), LoggerFaults()
    for _, why_unfit, why_unpredicted, more_faults in written:
        add_faults(faults, more_faults)
        unfit.update(why_unfit)
        unpredicted.update(why_unpredicted)
    samples = [sum(counts) for counts in zip(*(part.samples for part in parts), strict=True)]
    counts = {
        "vehicles": len(ordering.lanes),
        "received": dict(received),
        "duplicates": ordering.dropped,
        "lost": sum(part.lost for part in parts),
        "implausible_forecasts": {},
        "undecodable": {cause: count for cause, count in rejected.items() if count},
        "samples": dict(zip(CAUSES, samples, strict=True)),
        "rides": rides,
        "unfit": dict(unfit),
        "unpredicted": dict(unpredicted),
        "logger_faults": {name: dict(cars) for name, cars in faults.items()},
        "unpredictable": dict(ordering.cars.unpredictable),
        "unknown_models": ordering.cars.group_unknown(ordering.lanes.names),
    }
    return counts | _count_fixes(parts)


def _count_fixes(parts: Sequence[PartCounts]) -> dict[str, Any]:
    """Return the counts of the fixes on the map, nothing without a map."""
    known = [part.fixes for part in parts if part.fixes]
    if not known:
        return {}
    tiles = Counter[str]()
    for each in known:
        tiles.update(each["outside_by_tile"])
    whole = {name: sum(each[name] for each in known) for name in ("fixes", "outside")}
    return {"elevation_map": whole | {"outside_by_tile": dict(sorted(tiles.items()))}}


def make_context(job: Job) -> tuple[RunContext, int]:
    """Return the context of a run, and the number of amounts of its totals."""
    model, _ = load_surroundings(job)
    pipeline = Pipeline(model, job.settings, also=job.wanted, keep_forecasts=False, limits=MOST)
    shared = msgspec.msgpack.decode(job.of_run("shared").read_bytes(), type=Shared)
    pipeline.lanes.load(shared.vehicles)
    pipeline.cars.load([[msgspec.to_builtins(kind) for kind in shared.kinds], [0] * len(shared.vehicles), {}])
    return pipeline.context, pipeline.totals.accumulator.width


def write_slice(job: Job, out: Path, piece: Slice) -> tuple[int, Counter[str], Counter[str], LoggerFaults]:
    """Write a file of a table.

    Returns
    -------
    unfit, unpredicted : Counter of str
        Rides by why they are unfit for training, and by why they are not predicted; empty for windows.
    """
    context, width = make_context(job)
    columns = count_columns(width)
    stored = [
        read_rows(job.of_part(part, piece.name), columns, start, stop)
        for part, (start, stop) in enumerate(piece.of_parts)
        if stop > start
    ]
    rows = np.concatenate([np.empty((0, columns)), *stored])
    del stored
    rows = rows[np.lexsort((rows[:, 1], rows[:, 0]))]
    size = DISPLAY_YIELD.itemsize
    display = np.fromfile(
        job.of_run(f"{piece.name}.displays"), DISPLAY_YIELD, piece.stop - piece.start, offset=piece.start * size
    )
    totals = read_totals(rows, width)._replace(display=display)
    counters = RunCounters()
    if piece.name == "rides":
        counters.count_rides(totals, context)
        names, drivers = (
            read_text(job.of_run("names"), name, piece.start, piece.stop) for name in ("ride_id", "driver_id")
        )
        table = tabulate_rides(totals, names, drivers, context)
    else:
        table = tabulate_windows(totals, context)
    with ParquetTable(out) as file:
        file.append(table)
    return len(table), counters.unfit, counters.unpredicted, counters.faults
