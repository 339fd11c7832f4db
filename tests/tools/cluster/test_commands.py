"""Commands that make or read tables give the same results by workers; here the tasks run in this process."""

import json
from contextlib import contextmanager
from pathlib import Path

import pandas as pd
import pytest

from tests.support.commands import called, done, refused
from tests.support.paths import ROOT
from tools.cluster import run
from tools.cluster.runner import InProcessRunner
from tools.cluster.tables import ROWS

SHIFT = ROOT / "recordings" / "shift.mcap"


@contextmanager
def open_here(place, scratch, _):
    assert place.workers == 2
    assert scratch.is_dir()
    yield InProcessRunner()


@pytest.fixture(scope="module")
def tables(tmp_path_factory):
    """Return the folders of serial tables, and of tables by workers in files of a few rows."""
    folder = tmp_path_factory.mktemp("tables")
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(run, "open_runner", open_here)
        patched.setitem(ROWS, "rides", 25)
        patched.setitem(ROWS, "windows", 100)
        done("tables", SHIFT, "--out", folder / "serial")
        done("tables", SHIFT, "--out", folder / "parallel", "--cluster", "local:2")
    return folder / "serial", folder / "parallel"


def test_folders_hold_the_rows_of_the_serial_tables(tables):
    serial, parallel = tables
    for name in ("rides", "windows"):
        assert len(list((parallel / f"{name}.parquet").iterdir())) > 2
        one, other = (pd.read_parquet(folder / f"{name}.parquet") for folder in tables)
        pd.testing.assert_frame_equal(one, other, check_exact=True)
    assert (serial / "quality.json").read_bytes() == (parallel / "quality.json").read_bytes()
    report = json.loads((parallel / "cluster.json").read_text())
    assert {task["stage"] for task in report["tasks"]} == {"decode", "clean", "write"}
    assert {path.name for path in parallel.iterdir()} == {
        *("rides.parquet", "windows.parquet", "quality.json", "cluster.json")
    }


@pytest.mark.parametrize("recipe", ["fitted_physical", "road_load"])
def test_fit_to_divided_tables_gives_the_same_file(tables, recipe, tmp_path):
    paths = [tmp_path / f"{folder.name}.json" for folder in tables]
    for folder, path in zip(tables, paths, strict=True):
        done("fit", folder, "--recipe", recipe, "--out", path)
    assert paths[0].read_bytes() == paths[1].read_bytes()


def test_comparison_of_recordings_is_that_of_a_serial_run(monkeypatch):
    monkeypatch.setattr(run, "open_runner", open_here)
    given = ("compare", SHIFT, "--model", "extended_physical", "--json", "-")
    serial, _, _ = called(*given)
    parallel, _, _ = called(*given, "--cluster", "local:2")
    assert serial == parallel
    assert json.loads(serial)["models"]


def test_tables_need_no_workers(tables, capsys):
    message = refused(capsys, "compare", tables[1], "--model", "extended_physical", "--cluster", "local:2")
    assert "--cluster makes tables of recordings" in message


def test_later_tables_leave_no_file_of_earlier_ones(tables, monkeypatch, tmp_path):
    monkeypatch.setattr(run, "open_runner", open_here)
    stale = tmp_path / "rides.parquet" / "rides-000009.parquet"
    stale.parent.mkdir()
    stale.write_bytes(Path(tables[0] / "rides.parquet").read_bytes())
    done("tables", SHIFT, "--out", tmp_path, "--cluster", "local:2")
    assert not stale.exists()
