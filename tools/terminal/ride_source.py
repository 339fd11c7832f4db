"""Where the rides of a command come from: tables, or recordings that are cleaned as the options say.

A `RideSource` is the one home of this: commands, the workbench and the commands that they show read the same rides with
the same settings, maps, effects and vehicles.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Final

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import typer

from socast.core import effects
from socast.core.errors import ModelError, SettingsError
from socast.core.models import EXTENDED_PHYSICAL
from socast.core.pipeline import Pipeline
from socast.core.settings import Settings
from socast.stream.elevation_files import open_elevation
from socast.stream.loop import collect_garbage_rarely, feed
from socast.stream.mcap_format import RECORDING
from socast.stream.mcap_reader import McapSource
from socast.stream.recorder import list_recordings
from socast.stream.source import merge_sources
from socast.tools.cluster.dask_runner import ClusterPlace
from socast.tools.cluster.run import tabulate_by_workers
from socast.tools.terminal.cleaning_options import ElevationFiles, insert_cleaning_options, word_settings
from socast.tools.terminal.option_groups import insert_options
from socast.tools.terminal.output import EffectFiles, VehicleFiles, check_outputs, select_model_files
from socast.tools.terminal.recordings import (
    open_recordings,
    refuse_duplicates,
    refuse_unusable,
    show_progress,
    warn_of_losses,
)
from socast.tools.terminal.table_files import (
    KEY,
    PARQUET,
    ParquetTable,
    are_dated,
    complete_tables,
    is_table,
    is_window_table,
    join_parts,
    read,
)

RIDES, WINDOWS = "rides.parquet", "windows.parquet"
ROW_GROUP: Final = 2000
"""Number of rides per row group; it keeps memory independent of the length of the recording."""

Rides = Annotated[
    list[Path],
    typer.Argument(
        metavar="TABLES|REC", help="Folders that `socast tables` made, or MCAP recordings and their folders."
    ),
]
BothTables = tuple[pd.DataFrame, pd.DataFrame]
"""Ride table and window table."""
Report = Callable[[float], None]
"""Function that receives the share of the recordings that was read, in place of a progress bar. [1]"""


@dataclass(frozen=True)
class RideSource:
    """Say where rides come from, and how they are read.

    Parameters
    ----------
    given : sequence of Path
        Folders of tables and Parquet files of rides, or recordings and folders of recordings.
    elevation : sequence of Path
        Maps that correct the elevation of fixes, of recordings.
    effect_files, vehicle_files : sequence of Path
        Files of the user's effects and vehicles, which are already loaded.
    """

    given: Sequence[Path] = ()
    settings: Settings = field(default_factory=Settings)
    elevation: Sequence[Path] = ()
    effect_files: Sequence[Path] = ()
    vehicle_files: Sequence[Path] = ()

    @property
    def files(self) -> list[Path]:
        """The recordings, or the files of rides."""
        return list_inputs(self.given)

    @property
    def is_recorded(self) -> bool:
        """Whether the rides come from recordings."""
        return self.files[0].suffix == RECORDING

    @property
    def are_dated(self) -> bool:
        """Whether the dates of all rides are known, and not invented."""
        return are_dated(self.files)

    def list_read_files(self) -> list[Path]:
        """Return every file that is read, and must not be overwritten."""
        files = self.files
        beside = [] if self.is_recorded else [file.with_name(WINDOWS) for file in files]
        return [*files, *beside, *self.elevation, *self.effect_files, *self.vehicle_files]

    def list_options(self) -> list[str]:
        """Return the words of a command that reads other rides with the same effects, vehicles, settings and maps."""
        files = {"--effects": self.effect_files, "--vehicles": self.vehicle_files, "--elevation": self.elevation}
        words = [word for option, paths in files.items() for path in paths for word in (option, str(path))]
        return words + word_settings(self.settings)

    def list_words(self) -> list[str]:
        """Return the words of a command that reads the same rides."""
        return [*map(str, self.given), *self.list_options()]

    def check(self, *outputs: Path | None, models: Sequence[str] = (), also: Sequence[Path] = ()) -> None:
        """Refuse what cannot work before anything is read.

        This is a file given twice, options of cleaning beside tables, which are cleaned already, and outputs that
        cannot be written or would overwrite what is read: the rides, files of `models`, or files beside these.
        """
        files = self.files
        refuse_duplicates(files)
        words = word_settings(self.settings) + (["--elevation"] if self.elevation else [])
        if words and not self.is_recorded:
            raise SettingsError(
                f"{' '.join(words)} cleans recordings, and {files[0]} holds rides that are cleaned already; leave it "
                "out, and give it to `socast tables` as you make the tables"
            )
        if outputs:
            check_outputs([*self.list_read_files(), *select_model_files(models), *also], *outputs)

    @contextmanager
    def open_tables(
        self, wanted: Sequence[str] = (), place: ClusterPlace | None = None, *, always: bool = False
    ) -> Iterator["RideSource"]:
        """Yield this source, of which workers have made tables, if there are any.

        Parameters
        ----------
        wanted : sequence of str
            Names of the effects that the tables contain in addition to all of the library.
        always : bool
            Make tables in a folder of recordings without workers too, so that memory does not grow with their length.
        """
        if not self.given or (place is None and not (always and self.is_recorded)):
            yield self
            return
        if not self.is_recorded:
            raise SettingsError(
                f"--cluster makes tables of recordings, and {self.files[0]} is none; leave out --cluster"
            )
        named, sources = _list_effects(wanted), open_recordings(self.files)
        beside = Path.cwd() if place and place.address else None
        with TemporaryDirectory(prefix="tables-", dir=beside) as made:
            folder = Path(made)
            if place is None:
                write_tables(sources, self._make_pipeline(named), folder)
            else:
                tabulate_by_workers(
                    sources,
                    folder,
                    place,
                    model=EXTENDED_PHYSICAL.name,
                    wanted=named,
                    settings=self.settings,
                    effect_files=self.effect_files,
                    vehicle_files=self.vehicle_files,
                    elevation_files=self.elevation,
                )
            warn_of_losses(sources)
            yield RideSource([folder])

    def read_rides(self, wanted: Sequence[str] = (), columns: Sequence[str] | None = None) -> pd.DataFrame:
        """Return the ride table; one that is made of recordings has the wanted effects only.

        Of tables, only `columns` are read, as far as they are there.
        """
        return self.read(wanted, library=False)[0] if self.is_recorded else read(self.files, present=columns)

    def read(self, wanted: Sequence[str] = (), report: Report | None = None, *, library: bool = True) -> BothTables:
        """Return the ride and window tables, read from tables or made from recordings."""
        if self.is_recorded:
            return self._make(_list_effects(wanted) if library else wanted, report)
        files = self.files
        beside = [file.with_name(WINDOWS) for file in files]
        for file in beside:
            if not is_table(file):
                raise SettingsError(
                    f"{file.parent} holds no {WINDOWS}, which diagnosis needs: name a folder that `socast tables` made"
                )
        if not (own := effects.list_own()):
            return read(files), read(beside)
        parts = [_complete(*pair, own, report) for pair in zip(files, beside, strict=True)]
        return join_parts([rides for rides, _ in parts]), join_parts([windows for _, windows in parts])

    def read_windows_of(self, key: str) -> pd.DataFrame:
        """Return the windows of a ride, from the window table beside its ride table."""
        files = self.files
        place, ride_key = (0, key) if len(files) == 1 else (int(key.partition("/")[0]), key.partition("/")[2])
        file = files[place].with_name(WINDOWS)
        if not is_table(file):
            raise SettingsError(
                f"{file.parent} holds no {WINDOWS}; a trace needs the windows that `socast tables` makes"
            )
        try:
            windows: pd.DataFrame = pq.read_table(file, filters=[(KEY, "==", ride_key)]).to_pandas()
        except (OSError, pa.ArrowException) as error:
            reason = " ".join(str(error).split())
            raise ModelError(
                f"{file}: cannot read windows: {reason}; a trace needs what `socast tables` made"
            ) from error
        return windows.assign(**{KEY: key})

    def _make(self, wanted: Sequence[str], report: Report | None) -> BothTables:
        """Return the tables of recordings, and print warnings about data that could not be read."""
        sources, parts = open_recordings(self.files), list[BothTables]()
        tabulate(sources, self._make_pipeline(wanted), lambda *tables: parts.append(tables), report)
        warn_of_losses(sources)
        rides, windows = (pd.concat(tables, ignore_index=True) for tables in zip(*parts, strict=True))
        return rides, windows

    def _make_pipeline(self, wanted: Sequence[str]) -> Pipeline:
        return Pipeline(
            settings=self.settings,
            also=wanted,
            keep_forecasts=False,
            two_sided=True,
            elevation_map=open_elevation(self.elevation),
        )


def _list_effects(wanted: Sequence[str]) -> list[str]:
    """Return wanted effects, and all that tables contain."""
    return list(dict.fromkeys([*wanted, *effects.list_tabulated()]))


def _complete(rides: Path, windows: Path, own: Sequence[str], report: Report | None) -> BothTables:
    """Return the tables of a folder, with columns of one's own effects from their recordings."""

    def read_again(
        recordings: Sequence[Path], wanted: Sequence[str], settings: Settings, elevation: Sequence[Path]
    ) -> BothTables:
        return RideSource(recordings, settings, elevation)._make(wanted, report)

    return complete_tables(rides.parent, read([rides]), read([windows]), own, read_again)


@collect_garbage_rarely()
def tabulate(
    sources: Sequence[McapSource],
    pipeline: Pipeline,
    take: Callable[[pd.DataFrame, pd.DataFrame], None],
    report: Report | None = None,
) -> None:
    """Make ride and window tables of recordings, with a progress bar.

    Parameters
    ----------
    take : callable
        Function that receives the ended rides and their windows. It is called for every `ROW_GROUP` rides and at the
        end.
    """
    taken = 0
    blocks = max(sum(source.blocks for source in sources), 1)
    with show_progress(sources, shown=report is None) as step:
        for _ in feed(merge_sources(sources), pipeline):
            step()
            if report:
                report(sum(source.blocks_read for source in sources) / blocks)
            if (ended := pipeline.quality()["rides"]) - taken >= ROW_GROUP:
                taken = ended
                take(pipeline.take_rides(), pipeline.take_windows())
        refuse_unusable(sources, sum(pipeline.quality()["received"].values()))
        take(pipeline.take_rides(), pipeline.take_windows())


def write_tables(
    sources: Sequence[McapSource],
    pipeline: Pipeline,
    folder: Path,
    also: Callable[[pd.DataFrame], None] = lambda _: None,
) -> tuple[int, int]:
    """Write the tables of recordings into a folder, pass ended rides on, and return the numbers of rows."""
    rides, windows = ParquetTable(folder / RIDES), ParquetTable(folder / WINDOWS)

    def write(ended: pd.DataFrame, parts: pd.DataFrame) -> None:
        rides.append(ended)
        windows.append(parts)
        also(ended)

    with rides, windows:
        tabulate(sources, pipeline, write)
    return rides.rows, windows.rows


def list_inputs(given: Sequence[Path]) -> list[Path]:
    """Return the recordings, or the files of rides, that the command line names."""
    folders = [path for path in given if path.is_dir() and not is_table(path) and not (path / RIDES).exists()]
    if empty := [path for path in folders if not _list_recordings(path)]:
        raise SettingsError(
            f"{empty[0]} holds no {RIDES} and no recording (*{RECORDING}); name a folder of recordings, or one that "
            "`socast tables` made"
        )
    files = [file for path in given for file in _list_recordings(path) or [path]]
    recordings = [path for path in files if path.suffix == RECORDING]
    if not recordings:
        return list_ride_files(given)
    if len(recordings) < len(files):
        other = next(path for path in files if path.suffix != RECORDING)
        raise SettingsError(f"{recordings[0]} is a recording and {other} is none; give recordings or tables, not both")
    return recordings


def _list_recordings(folder: Path) -> list[Path]:
    """Return the recordings in a folder in the order of their names, none if it holds tables."""
    return [] if (folder / RIDES).exists() else list_recordings(folder)


def list_ride_files(tables: Sequence[Path]) -> list[Path]:
    """Return the files of rides that the command line names."""
    files = [path / RIDES if path.is_dir() and not is_table(path) else path for path in tables]
    for given, file in zip(tables, files, strict=True):
        if given.suffix == RECORDING and given.is_file():
            folder = given.with_suffix("")
            raise SettingsError(
                f"{given} is a recording; make tables of it first with `socast tables {given} --out {folder}`, "
                f"and give {folder}"
            )
        if not is_table(file):
            lacks = f"holds no {RIDES}" if given.is_dir() else "does not exist"
            raise SettingsError(f"{given} {lacks}; name a folder that `socast tables` made, or a Parquet file of rides")
        if file.suffix != PARQUET:
            raise SettingsError(f"{given} is neither a recording (*{RECORDING}) nor a Parquet file of rides")
        if is_window_table(file):
            raise SettingsError(f"{given} is a window table; give the folder, or {RIDES}")
    refuse_duplicates(files)
    return files


def make_source(
    *,
    rides: Rides,
    effects_file: EffectFiles = None,
    vehicles: VehicleFiles = None,
    settings: Settings,
    elevation: ElevationFiles = None,
) -> RideSource:
    """Return the source of rides from the values of the options."""
    return RideSource(rides, settings, elevation or (), effects_file or (), vehicles or ())


insert_ride_source = insert_options("source", insert_cleaning_options(make_source))
"""Decorator that gives a command the rides and the options of their source in place of its argument `source`."""
