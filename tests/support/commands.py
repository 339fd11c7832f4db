"""Commands as a person gives them, in this process or in one of their own."""

import logging
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from io import StringIO
from typing import Any, Final

import pytest

from socast.tools.cli import main

SOCAST: Final = (sys.executable, "-m", "socast")
"""What starts the command line in a process of its own."""


@contextmanager
def _exit_code(arguments: Sequence[object]) -> Iterator[Any]:
    """Run a command in this process, give its exit code, and undo what it sets about the log."""
    log = logging.getLogger("socast")
    before = log.handlers, log.level, log.propagate
    try:
        with pytest.raises(SystemExit) as ended:
            main([str(argument) for argument in arguments])
        yield ended.value.code
    finally:
        log.handlers, log.propagate = before[0], before[2]
        log.setLevel(before[1])


def done(*arguments: object) -> None:
    """Run a command in this process and check that it succeeds."""
    with _exit_code(arguments) as code:
        assert code == 0


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """Run a command in this process, check that it is refused, and return the one line that it prints."""
    with _exit_code(arguments) as code:
        assert code == 2
    message = capsys.readouterr().err
    assert re.fullmatch(r"socast: [^\n]+\n", message), message
    return message


def called(*arguments: object) -> tuple[str, str, int]:
    """Run a command in this process; return its standard output, its standard error and its exit code."""
    out, err = StringIO(), StringIO()
    with redirect_stdout(out), redirect_stderr(err), _exit_code(arguments) as code:
        pass
    return out.getvalue(), err.getvalue(), code
