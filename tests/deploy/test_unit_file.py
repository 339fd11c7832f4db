"""The unit file starts the service with options that exist, and systemd accepts it as hardened."""

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import typer

from socast.stream.service_status import LIVE_S
from socast.tools.cli import application
from tests.support.paths import ROOT

UNIT = ROOT / "deploy" / "socast.service"
MOST_EXPOSURE = 2.0
"""Largest exposure level by `systemd-analyze security`; below 2 is `OK`."""
needs_systemd = pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd is not installed")


def read_unit() -> dict[str, list[str]]:
    """Return the values of each directive."""
    lines = [line.partition("=") for line in UNIT.read_text().splitlines() if re.match(r"\w+=", line)]
    return {name: [value for other, _, value in lines if other == name] for name, _, _ in lines}


def test_command_of_the_unit_is_a_valid_call():
    (start,) = read_unit()["ExecStart"]
    program, name, *arguments = shlex.split(start)
    assert Path(program).name == "socast"
    command = typer.main.get_command(application(name)).commands[name]
    here = [str(ROOT / "deploy" / "socast.toml") if word.endswith(".toml") else word for word in arguments]
    found = command.make_context(name, here).params
    assert found["state"] is not None


def test_service_notifies_and_its_watchdog_is_slower_than_the_check_of_liveness():
    unit = read_unit()
    assert unit["Type"] == ["notify"]
    assert float(unit["WatchdogSec"][0]) > LIVE_S
    assert "-HUP" in unit["ExecReload"][0]


def test_service_has_no_privileges_and_writes_only_where_it_must():
    unit = read_unit()
    assert unit["CapabilityBoundingSet"] == unit["AmbientCapabilities"] == [""]
    for name in ("NoNewPrivileges", "DynamicUser", "PrivateTmp", "PrivateDevices", "ProtectHome"):
        assert unit[name] == ["yes"], name
    assert unit["ProtectSystem"] == ["strict"]
    assert "ReadWritePaths" not in unit
    assert unit["MemoryMax"]
    assert "MemoryDenyWriteExecute" not in unit


@needs_systemd
def test_systemd_accepts_the_unit(tmp_path):
    text = UNIT.read_text().replace("/opt/socast/.venv/bin/socast", sys.executable)
    (tmp_path / "socast.service").write_text(text)
    done = subprocess.run(
        ["systemd-analyze", "verify", tmp_path / "socast.service"], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")


@needs_systemd
def test_exposure_is_small():
    command = ["systemd-analyze", "security", "--offline=true", "--no-pager", UNIT]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    level = re.search(r"Overall exposure level for socast.service: ([\d.]+)", done.stdout)
    assert float(level[1]) <= MOST_EXPOSURE
