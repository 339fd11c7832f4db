"""The time that the command line takes to start, against the interpreter alone."""

import subprocess
import sys

from socast.tools.bench.measures import Measure, alternate_timings, time_action

BARE = ("-c", "pass")
"""What the interpreter is started with for comparison."""
REPEATS = 7


def measure_help_start() -> Measure:
    """Measure `socast --help`."""
    return _start("--help", 15.0, "Half of it is typer and the rest the standard library; no command is imported.")


def measure_version_start() -> Measure:
    """Measure `socast --version`."""
    return _start("--version", 15.0, "As for --help; reading the version takes 20 ms of `importlib.metadata`.")


def measure_effects_start() -> Measure:
    """Measure `socast effects list`."""
    return _start("effects list", 50.0, "A third is importing numpy, a fifth typer with its validation, a tenth rich.")


def _start(words: str, goal: float, bound: str) -> Measure:
    """Measure a command that prints and ends, against `python -c pass`."""
    command = ("-m", "socast.tools.cli", *words.split())
    for arguments in (BARE, command):
        _run(*arguments)  # the first run compiles modules to byte code
    bare_s, command_s = alternate_timings(
        lambda: time_action(lambda: _run(*BARE)), lambda: time_action(lambda: _run(*command)), REPEATS
    )
    ratio = command_s / bare_s
    return Measure(
        f"start of socast {words}",
        "python -c pass",
        ratio,
        f"<= {goal:g}",
        ratio <= goal,
        {"command_s": command_s, "python_s": bare_s},
        bound,
    )


def _run(*arguments: str) -> None:
    """Run the interpreter to its end, without its output."""
    subprocess.run([sys.executable, *arguments], stdout=subprocess.DEVNULL, check=True)  # noqa: S603 - our own command
