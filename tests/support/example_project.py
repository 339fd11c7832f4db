"""The example project of the guide "Test with recordings": its files, its commands, and the change of its model."""

import re
from pathlib import Path
from typing import Final

from tests.support.paths import ROOT

GUIDE: Final = ROOT / "docs" / "guide" / "test-with-recordings.md"
FILE: Final = re.compile(r"`([\w/]+\.(?:py|toml))`:\n\n```\w+\n(.*?)^```$", re.DOTALL | re.MULTILINE)
COMMANDS: Final = re.compile(r"^```sh\n(.*?)^```$", re.DOTALL | re.MULTILINE)


def write_example(folder: Path) -> list[str]:
    """Write the files of the example, and return the commands that make its recordings, its model and its tests run."""
    guide = GUIDE.read_text(encoding="utf-8")
    for name, content in FILE.findall(guide):
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(content, encoding="utf-8")
    return str(COMMANDS.findall(guide)[-1]).splitlines()


def read_change() -> str:
    """Return the code with which the guide changes a coefficient of the model."""
    return GUIDE.read_text(encoding="utf-8").rpartition("```python\n")[2].partition("```")[0]
