"""Signals set an event, once and for good, and return to the handlers of before where none came."""

import os
import signal
from threading import Thread

import pytest

from socast.tools.terminal.stop_signals import stop_on_signals
from tests.support.signal_handlers import ASKING, keep_handlers


@pytest.fixture(autouse=True)
def handlers():
    """Begin with the handlers of Python, and return to those of before."""
    with keep_handlers():
        signal.signal(signal.SIGINT, signal.default_int_handler)
        yield


def test_handlers_return_where_nothing_was_asked():
    before = [signal.getsignal(number) for number in ASKING]
    with stop_on_signals():
        pass
    assert [signal.getsignal(number) for number in ASKING] == before


def test_second_interrupt_raises_immediately():
    with stop_on_signals() as stop:
        os.kill(os.getpid(), signal.SIGINT)
        assert stop.is_set()
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)  # what the second one set off is not interrupted


def test_signals_amid_waits_for_the_stop_block_nothing():
    with stop_on_signals() as stop:
        sender = Thread(target=lambda: [os.kill(os.getpid(), signal.SIGTERM) for _ in range(2000)])
        sender.start()
        while sender.is_alive():
            stop.wait(1e-6)
        assert stop.wait()
