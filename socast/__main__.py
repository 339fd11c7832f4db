"""Run the command line: `socast`, or `python -m socast`."""

import signal
import sys
import time
from math import inf
from typing import Any, Final

ENDING: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGALRM)
"""Signals that end a command; the last one is that of an interrupt that comes again."""
INTERRUPTED: Final = 130
"""Exit code of a command that one of them ended, unless it handles signals itself."""
CALM_S: Final = 1.0
"""Time after an interrupt in which further signals leave alone what it set off. [s]"""
AGAIN_S: Final = 0.01
"""Time after which an interrupt that a callback could not pass on comes again. [s]"""


class _Interrupt(KeyboardInterrupt):
    """Pass code that `exec` runs; a plain one that has passed it ends the process by SIGINT, caught or not."""


class _Interrupter:
    """Interrupt the command at a signal."""

    def __init__(self) -> None:
        self.was_asked = False
        self.calm_until = 0.0

    def __call__(self, *_: object) -> None:
        if (now := time.monotonic()) >= self.calm_until:
            self.was_asked, self.calm_until = True, now + CALM_S
            raise _Interrupt

    def ask_again(self, lost: Any) -> None:
        """Interrupt again soon, as a hook for exceptions that have nowhere to go."""
        if issubclass(lost.exc_type, _Interrupt):
            self.calm_until = min(self.calm_until, 0.0)
            signal.setitimer(signal.ITIMER_REAL, AGAIN_S)
        else:
            sys.__unraisablehook__(lost)


def main() -> None:
    """Run the command line; until a command handles signals itself, they end it as Ctrl-C does, and silently."""
    interrupter = _Interrupter()
    code: Any = 0
    try:
        sys.unraisablehook = interrupter.ask_again
        _treat_signals(interrupter)
        from socast.tools.cli import main as run  # noqa: PLC0415 - signals that come meanwhile end the process calmly

        run()
    except KeyboardInterrupt:
        code = INTERRUPTED
    except SystemExit as ended:
        code = INTERRUPTED if ended.code and interrupter.was_asked else ended.code
    except Exception:  # an interrupt inside a compiler or a callback looks like a defect of that
        if not interrupter.was_asked:
            raise
        code = INTERRUPTED
    finally:
        interrupter.calm_until = inf
        _treat_signals(signal.SIG_IGN)  # one that comes too late must not change the exit code
    raise SystemExit(code)


def _treat_signals(handler: Any) -> None:
    """Set the handler of the signals that end a command, but not of one that is ignored, as `nohup` leaves it."""
    for number in ENDING:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, handler)


if __name__ == "__main__":
    main()
