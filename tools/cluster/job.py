"""What every task of a run needs to know, and the files by which tasks pass on what they have made."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from xxhash import xxh3_64_intdigest

from socast.core import effects, models
from socast.core.batch import Batch, Floats
from socast.core.cleaning.elevation_map import ElevationMap
from socast.core.files import replacing
from socast.core.settings import Settings
from socast.core.totals.context import Model
from socast.core.vehicles import add_vehicles
from socast.stream.elevation_files import open_elevation
from socast.stream.mcap_reader import McapSource
from socast.tools.terminal.vehicle_files import load_vehicle_file

COLUMNS: Final = (*Batch._fields, "item")
"""Rows of the file of a span: the columns of a batch, and the number of the sample among those of the span."""


@dataclass(frozen=True)
class Job:
    """Describe a run, the same for every task.

    Parameters
    ----------
    recordings : tuple of Path
        The recordings, in the order of the command line.
    scratch : Path
        Folder of intermediate files; all workers must see it, and the recordings, under the same path.
    parts : int
        Number of parts into which the cars are divided.
    model : str
        Name or file of the model whose effects are summed.
    effect_files, vehicle_files, elevation_files : tuple of Path
        Files that a worker loads before its first task.
    """

    recordings: tuple[Path, ...]
    scratch: Path
    parts: int
    model: str
    wanted: tuple[str, ...]
    settings: Settings
    effect_files: tuple[Path, ...] = ()
    vehicle_files: tuple[Path, ...] = ()
    elevation_files: tuple[Path, ...] = ()

    def find_part(self, vehicle_id: str) -> int:
        """Return the part of a car; it depends on nothing but its name."""
        return xxh3_64_intdigest(vehicle_id.encode()) % self.parts

    def of_span(self, number: int, name: str) -> Path:
        """Return a file of a span of time."""
        return self.scratch / f"span-{number:06d}.{name}"

    def of_part(self, part: int, name: str) -> Path:
        """Return a file of a part of the cars."""
        return self.scratch / f"part-{part:04d}.{name}"

    def of_run(self, name: str) -> Path:
        """Return a file of the whole run."""
        return self.scratch / name


@lru_cache(maxsize=1)
def load_surroundings(job: Job) -> tuple[Model, ElevationMap | None]:
    """Load effects, vehicle models and maps once in a process, and return the model and the map of a run."""
    for file in job.effect_files:
        effects.load_file(file)
    for file in job.vehicle_files:
        add_vehicles(load_vehicle_file(file))
    return models.load(job.model), open_elevation(job.elevation_files)


@lru_cache(maxsize=16)
def open_recording(path: Path, size: int) -> McapSource:  # noqa: ARG001 - a file that has grown is opened anew
    """Return a recording of a size [B], whose index this process reads once."""
    return McapSource(path)


def write_arrays(path: Path, **arrays: NDArray[Any]) -> None:
    """Write arrays to a file."""
    with replacing(path, is_kept=False) as own, own.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays in a file."""
    with np.load(path, allow_pickle=False) as content:
        return {name: content[name] for name in content.files}


def read_columns(path: Path, rows: int, start: int, stop: int, which: Sequence[int]) -> Floats:
    """Return rows from `start` up to `stop` of some columns of a file of floats by column, (len(which), n).

    The file is read, not mapped, because mapped pages count as memory of a worker.
    """
    out = np.empty((len(which), stop - start))
    with path.open("rb") as file:
        for place, column in enumerate(which):
            file.seek(8 * (column * rows + start))
            file.readinto(memoryview(out[place]).cast("B"))
    return out


def read_rows(path: Path, width: int, start: int, stop: int) -> Floats:
    """Return rows from `start` up to `stop` of a file of floats by row, (n, width)."""
    return np.fromfile(path, np.float64, (stop - start) * width, offset=8 * start * width).reshape(-1, width)


def write_text(path: Path, columns: Mapping[str, Sequence[str | None]]) -> None:
    """Write columns of text to a file."""
    table = pa.table({name: pa.array(values, pa.string()) for name, values in columns.items()})
    with (
        replacing(path, is_kept=False) as own,
        pa.OSFile(str(own), "wb") as sink,
        pa.ipc.new_file(sink, table.schema) as writer,
    ):
        writer.write_table(table)


def read_text(path: Path, column: str, start: int = 0, stop: int | None = None) -> list[str | None]:
    """Return rows from `start` up to `stop` of a column of text."""
    with pa.memory_map(str(path)) as file:
        values: list[str | None] = pa.ipc.open_file(file).read_all()[column][start:stop].to_pylist()
        return values
