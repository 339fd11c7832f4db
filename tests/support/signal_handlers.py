"""Signal handlers of a test's process, as they were before it."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

ASKING: Final = signal.SIGINT, signal.SIGTERM
"""Signals that ask a command to end."""


@contextmanager
def keep_handlers() -> Iterator[None]:
    """Return to the handlers of before: signals that ended a command are ignored for the rest of its process."""
    before = [signal.getsignal(number) for number in ASKING]
    yield
    for number, handler in zip(ASKING, before, strict=True):
        signal.signal(number, handler)
