"""Run commands of `socast` whose results are kept and used again."""

import subprocess
import sys
from pathlib import Path

from socast.core.errors import SocastError


def run_once(result: Path, *words: object) -> None:
    """Run a command that makes a file or folder, unless that exists."""
    if result.exists():
        return
    command = [sys.executable, "-m", "socast", *map(str, words)]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - our own command
    if ended.returncode:
        last = (ended.stderr or ended.stdout).strip().splitlines()[-1:]
        raise SocastError(f"socast {words[0]} failed: {' '.join(last)}")
