"""The last stage: each file of the tables is made of the totals of all parts, in the order of a serial run."""

from collections import Counter
from pathlib import Path

import msgspec
import numpy as np

from socast.core.pipeline import Pipeline
from socast.core.settings import BOUNDS_OF_LIMITS, Limits
from socast.core.totals.context import RunContext
from socast.core.totals.display_record import DISPLAY_YIELD
from socast.core.totals.logger_faults import LoggerFaults
from socast.core.totals.run_counters import RunCounters
from socast.core.totals.tables import tabulate_rides, tabulate_windows
from socast.tools.cluster.cleaning import count_columns, read_totals
from socast.tools.cluster.displays import Slice
from socast.tools.cluster.job import Job, load_surroundings, read_rows, read_text
from socast.tools.cluster.ordering import Shared
from socast.tools.terminal.parquet_table import ParquetTable

_MOST = Limits(vehicles=BOUNDS_OF_LIMITS["vehicles"][1], vehicle_models=BOUNDS_OF_LIMITS["vehicle_models"][1])


def make_context(job: Job) -> tuple[RunContext, int]:
    """Return the context of a run, and the number of amounts of its totals."""
    model, _ = load_surroundings(job)
    pipeline = Pipeline(model, job.settings, also=job.wanted, keep_forecasts=False, limits=_MOST)
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
