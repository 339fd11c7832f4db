"""Write tables to Parquet files by row groups."""

from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Self

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from socast.core.errors import SettingsError
from socast.core.files import replacing


class ParquetTable:
    """Write a Parquet file by row groups; the first row group fixes the columns.

    It is a context manager. The file takes the place of an existing one at its end, unless anything is raised.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows = 0
        self._writer: pq.ParquetWriter | None = None
        self._opened = ExitStack()

    def __enter__(self) -> Self:
        """Return the table."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Finish the file, or remove it if anything was raised."""
        try:
            self._opened.__exit__(kind, error, trace)
        except OSError as failure:
            raise self._explain(failure) from failure

    def append(self, table: pd.DataFrame) -> None:
        """Write a row group; text columns stay text even if all their values in a group are unknown."""
        try:
            writer = self._writer or self._open(table)
            writer.write_table(pa.Table.from_pandas(table, schema=self._schema, preserve_index=False))
        except OSError as error:
            raise self._explain(error) from error
        self.rows += len(table)

    def _open(self, table: pd.DataFrame) -> pq.ParquetWriter:
        """Return the writer of a new file with the columns of a row group."""
        text = {
            name
            for name, kind in table.dtypes.items()
            if not pd.api.types.is_numeric_dtype(kind) and not pd.api.types.is_bool_dtype(kind)
        }
        inferred = pa.Schema.from_pandas(table, preserve_index=False)
        self._schema = pa.schema([pa.field(f.name, pa.string() if f.name in text else f.type) for f in inferred])
        fresh = self._opened.enter_context(replacing(self.path))
        self._writer = self._opened.enter_context(pq.ParquetWriter(fresh, self._schema, compression="zstd"))
        return self._writer

    def _explain(self, error: OSError) -> SettingsError:
        """Return the error of a file that cannot be written."""
        reason = error.strerror or " ".join(str(error).split())
        return SettingsError(f"{self.path} cannot be written: {reason}; make room, or name another folder")
