"""The public data sets that `socast import` reads, by their names on the command line."""

from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple
from zoneinfo import ZoneInfo

from socast.core.errors import SettingsError
from socast.tools.importers import bmw_i3, twizy, ved
from socast.tools.importers.drive import Drive, ReadOptions
from socast.tools.importers.published import BMW_I3, TWIZY, VED, TableFormat


class DataSet(NamedTuple):
    """Describe how the files of a public data set are read.

    Parameters
    ----------
    time_zone : str
        Name of the time zone in which its clocks run.
    """

    form: TableFormat
    time_zone: str
    read_drives: Callable[[Path, ReadOptions], list[Drive]]

    @property
    def defaults(self) -> ReadOptions:
        """Options that read all its electric cars with its own time zone."""
        return ReadOptions(ZoneInfo(self.time_zone))


DATA_SETS: Final = {
    "ved": DataSet(VED, ved.TIME_ZONE, ved.read_drives),
    "bmw-i3": DataSet(BMW_I3, bmw_i3.TIME_ZONE, bmw_i3.read_drives),
    "twizy": DataSet(TWIZY, twizy.TIME_ZONE, twizy.read_drives),
}


def get_data_set(name: str) -> DataSet:
    """Return the data set of a name."""
    if name not in DATA_SETS:
        raise SettingsError(f"no data set is called {name!r}; choose from csv, parquet, {', '.join(DATA_SETS)}")
    return DATA_SETS[name]
