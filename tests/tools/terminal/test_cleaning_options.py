"""Test the options of cleaning: they are repeated in printed commands, and refused beside tables."""

from pathlib import Path

import pytest

from socast.core.diagnose.records import Diagnosis, NamedEffect
from socast.core.errors import SettingsError
from socast.core.settings import Settings
from socast.tools.commands.diagnose import insert_commands
from socast.tools.terminal.cleaning_options import make_settings, word_settings
from socast.tools.terminal.ride_source import RideSource

MOTORWAY = make_settings(speed_limit_kmh=180.0, least_distance_km=1.5, longest_ride_min=90.0)
WORDS = "--speed-limit-kmh 180 --least-distance-km 1.5 --longest-ride-min 90"


def test_only_changed_settings_are_worded():
    assert " ".join(word_settings(MOTORWAY)) == WORDS
    assert word_settings(Settings()) == []


def test_options_beside_tables_are_refused_with_the_remedy(tmp_path):
    rides = tmp_path / "rides.parquet"
    rides.write_bytes(b"")
    with pytest.raises(SettingsError, match=f"{WORDS} cleans recordings, and .*rides.parquet .* `socast tables`"):
        RideSource([rides], MOTORWAY).check()
    with pytest.raises(SettingsError, match=r"--elevation cleans recordings, and .* give it to `socast tables`"):
        RideSource([rides], elevation=[Path("city.parquet")]).check()
    RideSource([Path("kept.mcap")], MOTORWAY, [Path("city.parquet")]).check()
    RideSource([rides]).check()


def test_command_that_adds_an_effect_cleans_the_recording_alike():
    missing = NamedEffect(effect="headwind", columns=["effect_headwind"])
    shown = insert_commands(Diagnosis(missing=[missing]), "base.json", RideSource([Path("kept.mcap")], MOTORWAY))
    assert len(shown.missing[0].commands) == 2
    assert all(WORDS in command for command in shown.missing[0].commands)
