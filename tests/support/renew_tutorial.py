"""Print the tutorial's outputs anew: `python -m tests.support.renew_tutorial`, then read `git diff docs`.

Runs the commands of `docs/missing-effect.md` one after another in a temporary folder, and writes what they print into
the page. Where only numbers changed, elisions (`...`) stay where they are; where words did, the whole output is put
there, to be shortened by hand. Figures in the text between are not renewed: read it once more.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

from tests.support.tutorial import BLOCK, PAGE, difference, prepared, printed, renewed, shown


def main() -> None:
    """Renew the page."""
    page = PAGE.read_text(encoding="utf-8")
    with TemporaryDirectory() as name:
        folder = prepared(Path(name))

        def anew(block: str) -> str:
            parts = []
            for told in shown(block):
                lines = printed(told.command, folder)
                now = renewed(told.lines, lines)
                if now is None:
                    print(f"to be shortened by hand: {told.command}")
                elif difference(told.lines, lines):
                    print(f"changed: {told.command}")
                parts.append("\n".join([f"$ {told.command}", *(lines if now is None else now)]))
            return "```console\n" + "\n".join(parts) + "\n```"

        PAGE.write_text(BLOCK.sub(lambda found: anew(found[0]), page), encoding="utf-8")
    print(f"{PAGE.name}: {len(list(shown(page)))} commands")


if __name__ == "__main__":
    main()
