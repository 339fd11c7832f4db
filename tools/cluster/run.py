"""Make tables by many workers, with progress in the terminal and a report of what ran where."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from socast.core.errors import SettingsError
from socast.core.settings import Settings
from socast.stream.mcap_reader import McapSource
from socast.tools.cluster.dask_runner import ClusterPlace
from socast.tools.cluster.job import Job
from socast.tools.cluster.runner import TaskRecord
from socast.tools.cluster.tables import ClusterTables, choose_parts, make_tables
from socast.tools.cluster.workers import describe_tasks, open_workers
from socast.tools.terminal.output import write_json
from socast.tools.terminal.recordings import refuse_unusable

REPORT: Final = "cluster.json"
"""File beside the tables that says what ran where."""


def tabulate_by_workers(
    sources: Sequence[McapSource],
    out: Path,
    place: ClusterPlace,
    *,
    model: str,
    wanted: Sequence[str],
    settings: Settings,
    effect_files: Sequence[Path] = (),
    vehicle_files: Sequence[Path] = (),
    elevation_files: Sequence[Path] = (),
    on_end: Callable[[TaskRecord], None] | None = None,
) -> ClusterTables:
    """Write the tables of recordings to a folder, see `socast.tools.cluster.tables`, and the report beside them."""
    for source in sources:
        if source.path.suffix and not source.path.is_file():
            raise SettingsError(f"{source.path} is no file; --cluster reads files")
    with open_workers(place, out, "tables", on_end) as workers:
        job = Job(
            tuple(source.path.resolve() for source in sources),
            workers.scratch,
            choose_parts(sources, workers.runner.workers),
            model if not Path(model).is_file() else str(Path(model).resolve()),
            tuple(wanted),
            settings,
            *(tuple(file.resolve() for file in files) for files in (effect_files, vehicle_files, elevation_files)),
        )
        tables = make_tables(job, sources, out.resolve(), workers.runner, workers.report)
        refuse_unusable(sources, sum(tables.quality["received"].values()))
        write_json(out / REPORT, "cluster", describe_tasks(workers.runner))
    return tables
