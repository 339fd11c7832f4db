"""Errors that a person is meant to read.

Bad telemetry never raises: it is counted. What raises is a bad command, file, model or effect, and each message
names the value, the limit and the remedy.
"""


class SocastError(Exception):
    """Base of every error that the command line prints as one line."""


class RecordingError(SocastError):
    """A recording cannot be opened, or is not what it says it is."""


class CatalogueError(SocastError):
    """A vehicle model is unknown, or its entry is incomplete or out of bounds."""


class EffectError(SocastError):
    """An effect has a wrong unit, shape, name or declaration."""


class ModelError(SocastError):
    """A model is unknown, or cannot serve the data that it is given."""


class ImportFileError(SocastError):
    """A published data file is not the one that its importer reads."""


class SettingsError(SocastError):
    """A setting is outside its limits, or a connection cannot be made with it."""


class AskError(SocastError):
    """A question about the rest of a shift that cannot be answered as it is asked.

    Parameters
    ----------
    words : str
        Value, limit and remedy.
    cause : str
        What it is counted under, such as `unknown_vehicle` or `too_many_legs`.
    """

    def __init__(self, words: str, cause: str = "question") -> None:
        super().__init__(words)
        self.cause = cause
