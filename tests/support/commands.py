"""Commands as a person gives them, in this process."""

import re

import pytest

from tools.cli import main


def done(*arguments: object) -> None:
    """Run a command that succeeds."""
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    assert ended.value.code == 0


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """Return the one line that a refused command prints."""
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    assert ended.value.code == 2
    told = capsys.readouterr().err
    assert re.fullmatch(r"socast: [^\n]+\n", told), told
    return told
