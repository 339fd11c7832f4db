"""Name what reading content that others wrote raises, where it is damaged, of another form or nested too deeply."""

from typing import Final

import msgspec

UNREADABLE: Final = (msgspec.MsgspecError, UnicodeDecodeError, RecursionError)
"""What `msgspec` raises."""
UNREADABLE_TOML: Final = (ValueError, RecursionError)
"""What `tomllib` raises: `TOMLDecodeError`, and another `ValueError` where a number has thousands of digits."""
