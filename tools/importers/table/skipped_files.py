"""Skip files that cannot be read, and count them by cause."""

from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from socast.core.errors import ImportFileError


class SkippedFiles:
    """Collect the files of an import that cannot be read.

    Parameters
    ----------
    is_active : bool
        Whether to skip them; otherwise the first one ends the import.

    Attributes
    ----------
    rows : dict of Path to int
        File -> rows that were read before the damage, and are kept.
    """

    def __init__(self, is_active: bool = False) -> None:
        self.is_active = is_active
        self.rows: dict[Path, int] = {}
        self._causes: dict[str, list[Path]] = defaultdict(list)

    @contextmanager
    def skip(self, path: Path) -> Iterator[None]:
        """Skip a file with an error, where files are skipped."""
        try:
            yield
        except ImportFileError as error:
            if not self.is_active:
                raise
            self.rows.setdefault(path, 0)
            cause = str(error).removeprefix(str(path)).lstrip(": ").partition(";")[0]
            self._causes[cause].append(path)

    def list_lines(self, files: int) -> list[str]:
        """Return a line for each cause, the most frequent first."""
        lines = []
        for cause, paths in sorted(self._causes.items(), key=lambda item: -len(item[1])):
            others = f" and {len(paths) - 1} more" if len(paths) > 1 else ""
            kept = sum(self.rows[path] for path in paths)
            rows = f"; {kept:,} rows before the damage are kept" if kept else ""
            lines.append(f"skipped {len(paths)} of {files} files ({paths[0].name}{others}): {cause}{rows}")
        return lines
