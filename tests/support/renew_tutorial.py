"""Renew the outputs in a page: run `python -m tests.support.renew_tutorial [PAGE]`, then read `git diff docs`.

It runs the commands of the page, by default `docs/missing-effect.md`, in order in a temporary folder and writes their
output into the page. Elisions (`...`) stay in place where only numbers changed. Where words changed, the page gets the
whole output, to be shortened by hand. Numbers in the text between the outputs are not renewed.
"""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.support.documented_commands import (
    BLOCK,
    PAGE,
    documented_commands,
    first_difference,
    prepare_folder,
    renew_lines,
    run_command,
)


def main() -> None:
    """Renew the page."""
    path = Path(sys.argv[1]).resolve() if len(sys.argv) > 1 else PAGE
    page = path.read_text(encoding="utf-8")
    with TemporaryDirectory() as name:
        folder = prepare_folder(Path(name))

        def renewed(block: str) -> str:
            parts = []
            for each in documented_commands(block):
                printed = run_command(each.command, folder)
                lines = renew_lines(each.lines, printed)
                if lines is None:
                    print(f"to be shortened by hand: {each.command}")
                elif first_difference(each.lines, printed):
                    print(f"changed: {each.command}")
                parts.append("\n".join([f"$ {each.command}", *(printed if lines is None else lines)]))
            return "```console\n" + "\n".join(parts) + "\n```"

        path.write_text(BLOCK.sub(lambda block: renewed(block[0]), page), encoding="utf-8")
    print(f"{path.name}: {len(list(documented_commands(page)))} commands")


if __name__ == "__main__":
    main()
