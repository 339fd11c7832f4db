"""Test that every input file of 200 GB is refused in one line, without reading it."""

import os
import resource
from pathlib import Path

import pytest

from socast.core.errors import SocastError
from socast.core.pipeline import Pipeline
from socast.stream.state_file import StateFile
from tests.support.commands import refused
from tests.support.paths import ROOT

SHIFT = ROOT / "recordings/shift.mcap"
SIZE = 200 * 2**30


def make_sparse(path: Path) -> Path:
    path.touch()
    os.truncate(path, SIZE)
    return path


def peak_bytes() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


@pytest.mark.parametrize(
    ("name", "command"),
    [
        ("r.mcap", ("info", "FILE")),
        ("r.mcap", ("replay", "FILE")),
        ("r.mcap", ("tables", "FILE", "--out", "OUT")),
        ("m.json", ("replay", SHIFT, "--model", "FILE")),
        ("e.py", ("replay", SHIFT, "--effects", "FILE")),
        ("N45W074.hgt", ("replay", SHIFT, "--elevation", "FILE")),
        ("s.toml", ("live", "--settings", "FILE")),
        ("z.json5", ("ask", "car-1", "--config", "FILE")),
        ("p.json", ("ask", "car-1", "--plan", "FILE")),
        ("f.json", ("live", "--record", "OUT", "--watch", "FILE")),
        ("rides.parquet", ("evaluate", "FILE")),
        ("rides.parquet", ("fit", "FILE", "--recipe", "road_load", "-o", "OUT")),
        ("cars.txt", ("secure", "init", "OUT", "--cars", "FILE")),
    ],
)
def test_file_of_200_gb_is_refused_in_one_line(tmp_path, capsys, name, command):
    file, before = make_sparse(tmp_path / name), peak_bytes()
    words = [{"FILE": file, "OUT": tmp_path / "out"}.get(word, word) for word in command]
    assert str(file) in refused(capsys, *words)
    assert peak_bytes() - before < 600 << 20


def test_state_of_200_gb_is_refused_in_one_line(tmp_path):
    file, before = make_sparse(tmp_path / "fleet.state"), peak_bytes()
    with StateFile(file) as state, pytest.raises(SocastError, match=r"above the limit of 4,294,967,296$"):
        state.load(Pipeline().restore)
    assert peak_bytes() - before < 100 << 20
