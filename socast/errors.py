"""Export the exceptions; each message names the value, the limit and the remedy."""

from socast.core.errors import (
    AskError,
    CatalogueError,
    EffectError,
    ImportFileError,
    ModelError,
    RecordingError,
    SettingsError,
    SocastError,
)

__all__ = [
    "AskError",
    "CatalogueError",
    "EffectError",
    "ImportFileError",
    "ModelError",
    "RecordingError",
    "SettingsError",
    "SocastError",
]
