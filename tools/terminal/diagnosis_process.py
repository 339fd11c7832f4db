"""A `socast diagnose` in a process of its own, with the lowest priority."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from typing import Final

LOW_PRIORITY: Final = 15
"""Niceness of the process, so that the loop goes first."""
END_S: Final = 5.0
"""Time that the process has to end when it is asked to. [s]"""


class DiagnosisProcess:
    """Run `socast diagnose` beside the loop."""

    def __init__(self, arguments: Sequence[str]) -> None:
        self._error = tempfile.TemporaryFile()  # noqa: SIM115 - closed by `end`
        self._process = subprocess.Popen(  # noqa: S603 - our own command
            [sys.executable, "-m", "socast", "diagnose", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=self._error,
            start_new_session=True,  # a signal of the terminal ends the loop, which then ends the process
        )
        os.setpriority(os.PRIO_PROCESS, self._process.pid, LOW_PRIORITY)

    def poll(self) -> int | None:
        """Return the exit code, None while the process runs."""
        return self._process.poll()

    def get_error(self) -> str:
        """Return the last line that the process wrote to standard error."""
        self._error.seek(0)
        lines = self._error.read().decode(errors="replace").strip().splitlines()
        return lines[-1] if lines else f"exit code {self._process.returncode}"

    def end(self) -> None:
        """End the process if it runs."""
        self._process.terminate()
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._error.close()
