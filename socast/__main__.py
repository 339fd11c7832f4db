"""Run the command line: `socast`, or `python -m socast`."""

import signal
import sys
import time
from math import inf
from typing import Any, Final

from socast.tools.terminal.stop_signals import ENDING, set_handler

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

    def hook_unraisable(self, lost: Any) -> None:
        """Interrupt again where an exception has nowhere to go, as in a destructor."""
        if not self._ask_again(lost.exc_type):
            sys.__unraisablehook__(lost)

    def hook_printed(self, kind: type[BaseException], *lost: Any) -> None:
        """Interrupt again where compiled code would print an exception and go on."""
        if not self._ask_again(kind):
            sys.__excepthook__(kind, *lost)

    def _ask_again(self, kind: type[BaseException] | None) -> bool:
        """Interrupt again soon if an exception is an interrupt; return whether it is."""
        if is_interrupt := kind is _Interrupt:
            self.calm_until = 0.0
            signal.setitimer(signal.ITIMER_REAL, AGAIN_S)
        return is_interrupt


def main() -> None:
    """Run the command line; until a command handles signals itself, they end it as Ctrl-C does, and silently."""
    interrupter = _Interrupter()
    code: Any = 0
    try:
        sys.unraisablehook, sys.excepthook = interrupter.hook_unraisable, interrupter.hook_printed
        set_handler(interrupter, [*ENDING, signal.SIGALRM])
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
        set_handler(signal.SIG_IGN, [*ENDING, signal.SIGALRM])  # one that comes too late must not change the exit code
    raise SystemExit(code)


if __name__ == "__main__":
    main()
