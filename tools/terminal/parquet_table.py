"""Write tables to Parquet files by row groups."""

from pathlib import Path

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq


class ParquetTable:
    """Write a Parquet file by row groups; the first row group fixes the columns.

    Parameters
    ----------
    path : Path
        File to write.

    Attributes
    ----------
    rows : int
        Number of rows written so far.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows = 0
        self._writer: pq.ParquetWriter | None = None

    def append(self, table: pd.DataFrame) -> None:
        """Write a row group; text columns stay text even if all their values in a group are unknown.

        Parameters
        ----------
        table : DataFrame
            Rows of the group.
        """
        if self._writer is None:
            text = {
                name
                for name, kind in table.dtypes.items()
                if not pd.api.types.is_numeric_dtype(kind) and not pd.api.types.is_bool_dtype(kind)
            }
            inferred = pa.Schema.from_pandas(table, preserve_index=False)
            self._schema = pa.schema([pa.field(f.name, pa.string() if f.name in text else f.type) for f in inferred])
            self._writer = pq.ParquetWriter(self.path, self._schema, compression="zstd")
        self._writer.write_table(pa.Table.from_pandas(table, schema=self._schema, preserve_index=False))
        self.rows += len(table)

    def close(self) -> None:
        """Finish the file."""
        if self._writer is not None:
            self._writer.close()
