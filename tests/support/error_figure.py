"""Draw the falling error of the tutorial's model: `python -m tests.support.error_figure` writes `docs/error-falls.svg`.

The figure comes from the history of `better.json`, the model that the tutorial makes. A test compares its numbers with
those of the tutorial, so it is drawn again whenever they change.
"""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from socast.core import models
from socast.core.diagnose.add.records import list_attempts
from socast.tools.report.error_fall import draw_error_fall
from tests.support.documented_commands import PAGE, documented_commands, prepare_folder, run_command
from tests.support.paths import ROOT

FIGURE: Final = ROOT / "docs" / "error-falls.svg"


def error_figure(folder: Path) -> str:
    """Return the picture of `better.json` in the folder of the tutorial, as SVG."""
    return draw_error_fall(list_attempts(models.load(str(folder / "better.json")).history))


def main() -> None:
    """Run the tutorial as far as `better.json` and draw its history."""
    with TemporaryDirectory() as name:
        folder = prepare_folder(Path(name))
        for each in documented_commands(PAGE.read_text(encoding="utf-8")):
            run_command(each.command, folder)
            if (folder / "better.json").exists():
                break
        FIGURE.write_text(error_figure(folder), encoding="utf-8")
    print(f"{FIGURE.name}: written")


if __name__ == "__main__":
    main()
