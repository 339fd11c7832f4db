"""Commands that make or read tables give the same results by workers; here the tasks run in this process."""

import json
from collections import Counter
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from socast.core.fit import fitting, ride_blocks
from socast.tools.cluster import workers
from socast.tools.cluster.runner import InProcessRunner
from socast.tools.cluster.tables import ROWS
from tests.support import planted_rides
from tests.support.commands import called, done, refused
from tests.support.paths import ROOT

SHIFT = ROOT / "recordings" / "shift.mcap"


@contextmanager
def open_here(place, scratch, _):
    assert place.workers == 2
    assert scratch.is_dir()
    yield InProcessRunner()


def planted_fleet(n=240):
    table = planted_rides.rides(n, 2, planted_rides.MODELS[:2])
    table = table.assign(start_s=table["start_s"] + np.arange(n), ride_key=[f"car#{i}" for i in range(n)])
    return planted_rides.noisy(table, planted_rides.physical_energy(table))


@pytest.fixture(scope="module")
def tables(tmp_path_factory):
    """Return the folders of serial tables, and of tables by workers in files of a few rows."""
    folder = tmp_path_factory.mktemp("tables")
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(workers, "open_runner", open_here)
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


@pytest.mark.parametrize("recipe", ["extended_physical", "fitted_physical", "basic_rescaled_power"])
def test_fit_by_workers_gives_the_serial_file(tables, recipe, tmp_path, monkeypatch):
    monkeypatch.setattr(workers, "open_runner", open_here)
    monkeypatch.setattr(ride_blocks, "_BLOCK", 16)
    monkeypatch.setattr(fitting, "BLOCKS_OF_TASK", 2)
    paths = [tmp_path / name for name in ("serial.json", "parallel.json", "whole.json", "report.json")]
    for folder, path, options in zip(
        (tables[1], tables[1], tables[0]), paths[:3], ((), ("--cluster-report", paths[3]), ()), strict=True
    ):
        where = ("--cluster", "local:2", *options) if options else ()
        done("fit", folder, "--recipe", recipe, "--out", path, *where)
    assert paths[0].read_bytes() == paths[1].read_bytes() == paths[2].read_bytes()
    stages = Counter(task["stage"] for task in json.loads(paths[3].read_text())["tasks"])
    assert stages["survey"] == stages["residuals"] > 1


def test_recipe_that_needs_all_rides_is_not_divided(tables, tmp_path, capsys):
    given = ("--recipe", "road_load", "--out", tmp_path / "m.json", "--cluster", "local:2")
    message = refused(capsys, "fit", tables[1], *given)
    assert "recipe road_load needs all rides at once; leave out --cluster" in message


def test_evaluation_by_workers_is_the_serial_one(tmp_path, monkeypatch):
    monkeypatch.setattr(workers, "open_runner", open_here)
    planted_fleet().to_parquet(tmp_path / "rides.parquet")
    given = ("evaluate", tmp_path, "--recipes", "basic_physical,empirical", "--repeats", 2, "--json", "-")
    serial, parallel = (json.loads(called(*given, *how)[0]) for how in (("--jobs", 1), ("--cluster", "local:2")))
    for result in (serial, parallel):
        del result["about"]["seconds"]
    assert serial == parallel
    assert serial["mae"]


def test_jobs_and_workers_are_not_both_given(tables, capsys):
    assert "give one of the two" in refused(capsys, "evaluate", tables[0], "--jobs", 1, "--cluster", "local:2")


def test_report_of_workers_needs_workers(tables, tmp_path, capsys):
    message = refused(capsys, "evaluate", tables[0], "--cluster-report", tmp_path / "r.json")
    assert "--cluster-report says what ran where with --cluster" in message


def test_comparison_of_recordings_is_that_of_a_serial_run(monkeypatch):
    monkeypatch.setattr(workers, "open_runner", open_here)
    given = ("compare", SHIFT, "--model", "extended_physical", "--json", "-")
    serial, _, _ = called(*given)
    parallel, _, _ = called(*given, "--cluster", "local:2")
    assert serial == parallel
    assert json.loads(serial)["models"]


def test_tables_need_no_workers(tables, capsys):
    message = refused(capsys, "compare", tables[1], "--model", "extended_physical", "--cluster", "local:2")
    assert "--cluster makes tables of recordings" in message


def test_later_tables_leave_no_file_of_earlier_ones(tables, monkeypatch, tmp_path):
    monkeypatch.setattr(workers, "open_runner", open_here)
    stale = tmp_path / "rides.parquet" / "rides-000009.parquet"
    stale.parent.mkdir()
    stale.write_bytes(Path(tables[0] / "rides.parquet").read_bytes())
    done("tables", SHIFT, "--out", tmp_path, "--cluster", "local:2")
    assert not stale.exists()
