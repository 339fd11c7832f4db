"""Test the sign that a long step is still under way."""

import io

import pytest
from rich.console import Console

from socast.tools.terminal.progress import show_elapsed


@pytest.mark.parametrize("is_terminal", [True, False])
def test_a_terminal_shows_what_is_done_and_a_pipe_shows_nothing(is_terminal):
    console = Console(file=io.StringIO(), force_terminal=is_terminal, width=80)
    with show_elapsed("fitting", console):
        pass
    shown = console.file.getvalue()
    assert ("fitting" in shown) == is_terminal
    assert bool(shown) == is_terminal
