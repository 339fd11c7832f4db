"""Test that blocks of converted rides come back from memory and from the temporary file as they were appended."""

import errno
from contextlib import closing

import numpy as np
import pytest

from socast.core.errors import ModelError
from socast.core.fit.block_sums import IN_MEMORY, BlockFile

COLUMNS = ("energy_kwh", "lost_m")


def make_block(seed: int, rows: int) -> dict[str, np.ndarray]:
    """Return a block of rides with unknown values and unusual names."""
    rng = np.random.default_rng(seed)
    numbers = {name: np.where(rng.random(rows) < 0.1, np.nan, rng.normal(size=rows)) for name in (*COLUMNS, "unread")}
    names = np.array(["", "taxi-001", "Zoë\n\0", "taxi-002"], dtype=object)
    return numbers | {"vehicle_id": names[rng.integers(0, 4, rows)], "date": names[rng.integers(0, 2, rows)]}


@pytest.mark.parametrize("sizes", [(5, 1, 8192), (IN_MEMORY // 32,) * 3, ()])
def test_blocks_come_back_in_order_as_often_as_wanted(sizes):
    blocks = [make_block(seed, rows) for seed, rows in enumerate(sizes)]
    with closing(BlockFile((*COLUMNS, "vehicle_id"))) as file:
        for block in blocks:
            file.append(block)
        for _ in range(2):
            again = list(file)
            assert len(again) == len(blocks)
            for before, after in zip(blocks, again, strict=True):
                assert set(after) == {*COLUMNS, "vehicle_id", "date"}
                for name, values in after.items():
                    np.testing.assert_array_equal(values, before[name])
                    assert values.dtype == before[name].dtype


def test_blocks_may_differ_in_columns_of_names():
    without = {name: values for name, values in make_block(1, 3).items() if name != "date"}
    with closing(BlockFile(COLUMNS)) as file:
        file.append(make_block(0, 3))
        file.append(without)
        assert ["date" in block for block in file] == [True, False]


def test_full_temporary_folder_is_refused_with_its_remedy(monkeypatch):
    def fail(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    with closing(BlockFile(COLUMNS)) as file:
        monkeypatch.setattr(file._file, "write", fail)
        with pytest.raises(ModelError, match=r"needs 24\.0 MB or more .*No space left on device; set TMPDIR to"):
            file.append(make_block(0, 1_000_000))
