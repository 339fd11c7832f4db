"""Every command is documented, and calls that no test runs are at least valid."""

import re
import shlex
from functools import cache

import pytest
import typer

from socast.core.cleaning.segmentation import PARKED_FACTOR
from socast.core.settings import Settings
from socast.tools.cli import COMMANDS, application
from tests.support.documented_commands import documented_commands
from tests.support.pages import GUIDES, PAGES, blocks, name_of, read, shown_calls
from tests.support.paths import ROOT

CALLS = list(shown_calls())


@cache
def command_help():
    """Return every command by its name."""
    return {name: typer.main.get_command(application(name)).commands[name] for name in COMMANDS}


@pytest.mark.parametrize("call", CALLS, ids=[f"{name_of(call.page)}: {' '.join(call.arguments)}" for call in CALLS])
def test_call_that_no_test_runs_has_a_command_options_and_values_that_exist(call):
    name, *arguments = call.arguments
    command = command_help()[name]
    if inner := getattr(command, "commands", None):
        command, arguments = inner[arguments[0]], arguments[1:]
    assert command.make_context(name, arguments).command is command


def test_examples_in_help_texts_are_valid_calls():
    for name, top in command_help().items():
        for command in [top, *getattr(top, "commands", {}).values()]:
            for call in re.findall(r"\bsocast (.+)", command.help.replace("\\\n", "").partition("Example")[2]):
                without_files = re.sub(r"\s*(\||2?>).*| --(effects|vehicles) \S+", "", call)  # parsing reads them
                _, *arguments = shlex.split(without_files)
                target = getattr(top, "commands", {}).get(arguments[0]) if arguments else None
                target, arguments = (target, arguments[1:]) if target else (top, arguments)
                assert target.make_context(name, arguments).command is target, call


def test_guide_states_the_time_between_forecasts():
    on_ride = Settings().forecast_time
    stated = f"after {on_ride:g} s of a ride or {PARKED_FACTOR * on_ride:g} s between rides, and when"
    assert stated in (ROOT / "docs/guide/live.md").read_text()


def test_every_command_is_in_a_guide_with_a_call():
    guides = "\n".join(read(page) for page in GUIDES)
    calls = [each.command for page in GUIDES for each in documented_commands(read(page))]
    calls += [f"socast {' '.join(call.arguments)}" for call in CALLS]
    for name, command in command_help().items():
        assert f"`socast {name}`" in read(ROOT / "docs" / "guide" / "index.md"), f"{name} is not in the list of guides"
        for path in [f"{name} {inner}" for inner in getattr(command, "commands", [])] or [name]:
            assert f"`socast {path}" in guides, f"no guide names socast {path}"
            assert any(f"{call} ".startswith(f"socast {path} ") for call in calls), f"no page calls socast {path}"


def test_every_command_argument_and_option_has_a_help_text():
    for name, top in command_help().items():
        for command in [top, *getattr(top, "commands", {}).values()]:
            assert command.help, name
            for parameter in command.params:
                assert parameter.help, f"{name}: {parameter.name}"


def test_named_make_targets_exist():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    named = {target for page in PAGES for target in re.findall(r"`make ([a-z-]+)", read(page))}
    named |= {target for page in PAGES for block in blocks(page, "sh") for target in re.findall(r"^make (\S+)", block)}
    assert "demo" in named
    assert {target for target in named if not re.search(rf"^{target}:", makefile, re.MULTILINE)} == set()
