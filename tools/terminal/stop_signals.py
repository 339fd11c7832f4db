"""Signals that end a command: they set an event, which whatever runs looks at."""

import signal
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from threading import Event, Lock, current_thread, main_thread
from types import FrameType
from typing import Any, Final

ENDING: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Signals that end a command."""


def set_handler(handler: Any, numbers: Iterable[int] = ENDING) -> dict[int, Any]:
    """Set the handler of signals, but not of a SIGHUP that is ignored, as under `nohup`; return the handlers of before.

    In any thread but the main one, which alone may have handlers, this does nothing.
    """
    if current_thread() is not main_thread():
        return {}
    before = {number: signal.getsignal(number) for number in numbers}
    if before.get(signal.SIGHUP) is signal.SIG_IGN:
        del before[signal.SIGHUP]
    for number in before:
        signal.signal(number, handler)
    return before


def restore_handlers(before: dict[int, Any]) -> None:
    """Set the handlers that `set_handler` returned."""
    for number, handler in before.items():
        signal.signal(number, handler)


class _Stop(Event):
    """An event that a signal handler may set amid a wait for it, where the locks of `Event` would block for good."""

    def __init__(self) -> None:
        super().__init__()
        self._is_set, self._latch = False, Lock()
        self._latch.acquire()

    def is_set(self) -> bool:
        """Return whether the event is set."""
        return self._is_set

    def set(self) -> None:
        """Set the event for good."""
        if not self._is_set:
            self._is_set = True
            self._latch.release()

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until the event is set, and return whether it is."""
        if not self._is_set and self._latch.acquire(timeout=-1 if timeout is None else max(0.0, timeout)):
            self._latch.release()
        return self._is_set


@contextmanager
def stop_on_signals() -> Iterator[Event]:
    """Provide an event that SIGINT, SIGTERM and SIGHUP set; a second SIGINT interrupts at once, later ones do nothing.

    Once a signal has ended what ran, the process ends too: signals that come after do nothing, so that its exit code is
    that of an end as asked.
    """
    stop = _Stop()
    is_interrupted = False

    def handle(number: int, frame: FrameType | None) -> None:
        nonlocal is_interrupted
        if stop.is_set() and number == signal.SIGINT and not is_interrupted:
            is_interrupted = True
            earlier = before[number]
            (earlier if callable(earlier) else signal.default_int_handler)(number, frame)
        stop.set()

    before = set_handler(handle)
    try:
        yield stop
    finally:
        is_interrupted = True
        if not stop.is_set():
            restore_handlers(before)


def act_on_hangup(act: Callable[[], None]) -> None:
    """Call a function at SIGHUP, in the thread of the loop, for as long as the process lives."""
    signal.signal(signal.SIGHUP, lambda *_: act())
