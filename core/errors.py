"""Define the errors whose messages are written for people.

Bad telemetry is counted and never raises an error. A bad command, file, model or effect raises one. Each message names
the value, the limit and the remedy.
"""


class SocastError(Exception):
    """Serve as the base of every error that the command line prints as one line."""


class RecordingError(SocastError):
    """Report a recording that cannot be opened, or whose content contradicts its header."""


class CatalogueError(SocastError):
    """Report an unknown vehicle model, or a catalogue entry that is incomplete or out of bounds."""


class EffectError(SocastError):
    """Report an effect with a wrong unit, shape, name or declaration."""


class ModelError(SocastError):
    """Report a model that is unknown, or that cannot serve the given data."""


class ImportFileError(SocastError):
    """Report a published data file that is not the one that its importer reads."""


class SettingsError(SocastError):
    """Report a setting that is outside its limits, or with which no connection can be made."""


class AskError(SocastError):
    """Report an outlook query that cannot be answered.

    Parameters
    ----------
    words : str
        Message with value, limit and remedy.
    cause : str
        Cause under which the query is counted, such as `unknown_vehicle` or `too_many_legs`.
    """

    def __init__(self, words: str, cause: str = "question") -> None:
        super().__init__(words)
        self.cause = cause
