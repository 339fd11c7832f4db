"""Times on a terminal are in the zone that is asked for, which the column names."""

import io
import time
from datetime import UTC
from zoneinfo import ZoneInfo

import pytest
from rich.console import Console

from socast.core.errors import SettingsError
from socast.stream.loop import Tally
from socast.tools.terminal.live_table import format_fleet_line, make_fleet_table
from socast.tools.terminal.time_zone import SYSTEM, find_zone, format_local, name_zone
from tests.support.commands import done, refused
from tests.support.paths import SHIFT
from tests.support.statuses import make_status

CAR = make_status()
MONTREAL = ZoneInfo("America/Montreal")


@pytest.fixture
def _system_in_nepal(monkeypatch):
    monkeypatch.setenv("TZ", "Asia/Kathmandu")
    time.tzset()
    yield
    monkeypatch.undo()
    time.tzset()


def show(zone):
    console = Console(file=io.StringIO(), width=130)
    console.print(make_fleet_table([CAR], "Live", "", 20, zone=zone))
    return console.file.getvalue()


@pytest.mark.parametrize(("zone", "shown"), [(UTC, ("22:13:20", "UTC")), (MONTREAL, ("17:13:20", "EST"))])
def test_table_and_line_of_cars_show_times_in_the_zone_and_name_it(zone, shown):
    for text in (show(zone), format_fleet_line([CAR], Tally(), zone)):
        assert all(part in text for part in shown)


@pytest.mark.usefixtures("_system_in_nepal")
def test_terminal_shows_the_zone_of_the_system_and_a_pipe_shows_utc():
    zones = [find_zone(None, Console(file=io.StringIO(), force_terminal=each)) for each in (True, False)]
    assert zones == [SYSTEM, UTC]
    assert [format_local(1.7e9, "%H:%M %z", zone) for zone in zones] == ["03:58 +0545", "22:13 +0000"]


def test_zone_whose_clock_changes_has_both_names():
    assert name_zone([1.7e9, 1.69e9], MONTREAL) == "EST, EDT"


@pytest.mark.parametrize("name", ["Mars/Olympus", "", "../etc/passwd"])
def test_unknown_zone_is_refused(name, capsys):
    with pytest.raises(SettingsError, match="no time zone"):
        find_zone(name, Console(file=io.StringIO()))
    for command in (["live"], ["ask", "taxi-1"], ["replay", SHIFT]):
        assert f"--time-zone is '{name}'" in refused(capsys, *command, "--time-zone", name)


def test_replay_lists_rides_in_the_zone(capsys):
    done("replay", SHIFT, "--time-zone", "America/Montreal")
    printed = capsys.readouterr().out
    assert "EST" in printed
    assert "01-16 07:03" in printed
