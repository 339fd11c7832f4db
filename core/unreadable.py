"""What JSON and MessagePack of others raise where they cannot be read."""

from typing import Final

import msgspec

UNREADABLE: Final = (msgspec.MsgspecError, UnicodeDecodeError, RecursionError)
"""Exceptions of content that is damaged, has another form, is not UTF-8 or is nested too deeply."""
