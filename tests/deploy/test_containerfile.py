"""The Containerfile copies what exists, runs without privileges, and is marked as untested."""

import json
import re
import tomllib

import typer

from socast.tools.cli import application
from tests.support.paths import ROOT

TEXT = (ROOT / "deploy" / "Containerfile").read_text()
LINES = re.sub(r"\\\n", "", TEXT).splitlines()


def find(instruction: str) -> list[str]:
    """Return the arguments of every instruction of a kind."""
    return [line.partition(" ")[2].strip() for line in LINES if line.startswith(f"{instruction} ")]


def test_copied_files_exist_and_hold_every_package():
    sources = [word for line in find("COPY") if "--from" not in line for word in line.split()[:-1]]
    assert all((ROOT / source).exists() for source in sources)
    packages = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]["find"]["include"]
    assert {package.rstrip("*") for package in packages} <= set(sources)


def test_versions_come_from_the_lock_file_with_hashes():
    assert any("--require-hashes" in line and "requirements.lock" in line for line in find("RUN"))
    lock = (ROOT / "requirements.lock").read_text()
    assert re.search(r"^prometheus-client==", lock, re.MULTILINE)


def test_image_runs_without_privileges_with_a_health_check():
    assert find("USER")[-1] not in {"0", "root", "0:0"}
    (check,) = find("HEALTHCHECK")
    assert "9464/livez" in check
    assert find("STOPSIGNAL") == ["SIGTERM"]


def test_command_is_a_valid_call():
    name, *arguments = json.loads(find("CMD")[-1])
    command = typer.main.get_command(application(name)).commands[name]
    here = [str(ROOT / "deploy" / "socast.toml") if word.endswith(".toml") else word for word in arguments]
    assert command.make_context(name, here).params["metrics"].endswith(":9464")


def test_image_that_was_never_built_says_so():
    assert TEXT.startswith("# Untested")
