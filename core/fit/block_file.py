"""Keep converted rides for the later passes of a fit, so that the fit reads and converts a ride table once.

Few rides stay in memory. More rides go to a file in the temporary folder, which the system removes when it is closed,
even after a crash. Ordinary reads bring back one block at a time; a mapped file would count as memory of the process.
"""

from collections.abc import Iterator, Mapping, Sequence
from tempfile import SpooledTemporaryFile
from typing import Any, Final

import msgspec
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from socast.core.errors import ModelError
from socast.core.fit.ride_blocks import NAMES

IN_MEMORY: Final = 2**23
"""Size up to which converted rides stay in memory: those of one or two blocks. [B]"""


class BlockFile:
    """Append blocks of converted rides, and iterate over them in their order any number of times.

    Parameters
    ----------
    columns : sequence of str
        Columns of numbers to keep, besides those of `socast.core.fit.ride_blocks.NAMES` that a block has.
    """

    def __init__(self, columns: Sequence[str]) -> None:
        self._columns = [name for name in columns if name not in NAMES]
        self._file: SpooledTemporaryFile[bytes] = SpooledTemporaryFile(max_size=IN_MEMORY)  # noqa: SIM115 - see `close`
        self._sizes: list[tuple[int, int]] = []  # rows, and bytes of the names, of each block

    def append(self, block: Mapping[str, NDArray[Any]]) -> None:
        """Add a block."""
        numbers = np.stack([block[name] for name in self._columns])
        names = msgspec.msgpack.encode({name: _pack(block[name]) for name in NAMES if name in block})
        self._sizes.append((numbers.shape[1], len(names)))
        try:
            self._file.write(names)
            self._file.write(numbers.data)
        except OSError as error:
            size = sum(8 * rows * len(self._columns) + packed for rows, packed in self._sizes)
            raise ModelError(
                f"a fit needs {size / 1e6:,.1f} MB or more for a temporary file: {error.strerror}; "
                "set TMPDIR to a folder with more room"
            ) from error

    def __iter__(self) -> Iterator[dict[str, NDArray[Any]]]:
        """Yield the blocks as they were appended, with the columns to keep."""
        self._file.seek(0)
        for rows, packed in self._sizes:
            names = msgspec.msgpack.decode(self._file.read(packed), type=dict[str, tuple[bytes, list[str]]])
            content = self._file.read(8 * rows * len(self._columns))
            numbers = np.frombuffer(content).reshape(len(self._columns), rows)
            yield dict(zip(self._columns, numbers, strict=True)) | {
                name: np.array(values, dtype=object)[np.frombuffer(place, np.int32)]
                for name, (place, values) in names.items()
            }

    def close(self) -> None:
        """Remove the blocks and their file."""
        self._file.close()


def _pack(names: NDArray[Any]) -> tuple[bytes, list[str]]:
    """Return the place of each name among the distinct names, and these."""
    place, distinct = pd.factorize(names)
    return place.astype(np.int32).tobytes(), distinct.tolist()
