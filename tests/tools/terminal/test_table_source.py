"""Columns of one's own effects are computed from the recordings that tables name."""

import json
from pathlib import Path

import pandas as pd
import pytest

from socast.core import effects
from socast.stream.mcap_writer import McapSink
from socast.tools.terminal.ride_source import RideSource
from socast.tools.terminal.table_files import read_source
from tests.support.commands import done
from tests.support.recorded_shift import shift

OWN = '''"""An effect of one's own."""

from socast.core.effects import effect


@effect(coefficient="c", unit="N", low=0, high=1, source="nobody")
def my_effect(speed):
    """Something: P = F v."""
    return speed
'''
SETTINGS = ("--least-distance-km", 0.1)


@pytest.fixture
def folder(tmp_path) -> Path:
    with McapSink(tmp_path / "shift.mcap") as sink:
        sink.put(shift())
    done("tables", tmp_path / "shift.mcap", "--out", tmp_path / "tables", *SETTINGS)
    return tmp_path / "tables"


@pytest.fixture
def _own_effect(folder) -> None:
    (folder.parent / "my_effects.py").write_text(OWN)
    effects.load_file(folder.parent / "my_effects.py")


def test_tables_name_their_recordings_and_settings(folder):
    source = read_source(folder)
    assert source.recordings == ("../shift.mcap",)
    assert source.settings.least_distance == 100.0


@pytest.mark.usefixtures("_checks_here", "_own_effect")
def test_tables_made_before_an_effect_was_written_get_its_column(folder):
    expected = folder.parent / "expected"
    done("tables", folder.parent / "shift.mcap", "--out", expected, *SETTINGS)
    rides, windows = RideSource([folder]).read()
    for table, name in ((rides, "rides.parquet"), (windows, "windows.parquet")):
        whole = pd.read_parquet(expected / name)
        pd.testing.assert_frame_equal(table[whole.columns], whole)
    both, _ = RideSource([folder, expected]).read()
    assert both["effect_my_effect"].notna().all()


@pytest.mark.parametrize("loss", ["recording", "source", "rides"])
@pytest.mark.usefixtures("_checks_here", "_own_effect")
def test_tables_whose_source_is_gone_or_another_stay_as_they_are(folder, loss):
    if loss == "recording":
        (folder.parent / "shift.mcap").unlink()
    elif loss == "source":
        quality = json.loads((folder / "quality.json").read_text())
        del quality["source"]
        (folder / "quality.json").write_text(json.dumps(quality))
    else:
        with McapSink(folder.parent / "shift.mcap") as sink:
            sink.put(shift()[: len(shift()) // 2])
    rides, windows = RideSource([folder]).read()
    assert "effect_my_effect" not in rides
    assert "effect_my_effect" not in windows
