"""Places in the repository, and of the real drives that a checkout may have beside it."""

from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[2]
RECORDINGS: Final = ROOT / "recordings"
SHIFT: Final = RECORDINGS / "shift.mcap"
REAL_DRIVES: Final = ROOT.parent / "shared" / "data"
"""Tests that read it are skipped where it is absent."""
