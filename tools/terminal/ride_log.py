"""Log rides as they end, and verdicts on models as they change."""

import logging
import time
from collections.abc import Callable
from typing import Final

from socast.core.formatting import format_time
from socast.core.pipeline import Pipeline
from socast.stream.structured_log import event_fields, flatten_counts
from socast.tools.terminal.live_table import add_predictions, make_ride_records
from socast.tools.terminal.model_comparison import make_log_fields

TAKE_S: Final = 1.0
"""Time between two checks for rides that have ended. [s]"""

_log = logging.getLogger("socast.live")


class RideLog:
    """Log the rides that have ended, as a watch of the loop; their totals do not pile up in the pipeline.

    Parameters
    ----------
    clock : callable
        Function that returns monotonic time. [s]
    """

    def __init__(self, pipeline: Pipeline, clock: Callable[[], float] = time.monotonic) -> None:
        self._pipeline, self._clock = pipeline, clock
        self._take_s = clock() + TAKE_S
        self._verdicts = self._current_verdicts()

    def __call__(self, _: object) -> None:
        """Log rides and verdicts when they are due."""
        if (now := self._clock()) >= self._take_s:
            self._take_s = now + TAKE_S
            self._log_rides()

    def end(self) -> None:
        """Log the last rides and the errors of the models."""
        self._log_rides()
        if self._pipeline.shadows:
            for errors in self._pipeline.shadows.errors():
                _log.info("model", extra=event_fields(**make_log_fields(errors)))

    def _log_rides(self) -> None:
        """Log the rides that have ended and the verdicts that have changed, and drop the windows."""
        pipeline = self._pipeline
        pipeline.take_windows()
        for ride in make_ride_records(add_predictions(pipeline.take_rides(), pipeline.shadows)):
            shadows = flatten_counts({"shadows_kwh": ride.pop("shadows_kwh", {})})
            start = format_time(ride.pop("start_s"))
            known = {name: value for name, value in ride.items() if value is not None}
            _log.info("ride", extra=event_fields(start=start, **known, **shadows))
        before, self._verdicts = self._verdicts, self._current_verdicts()
        for errors in pipeline.shadows.errors():
            if before[errors.model] != self._verdicts[errors.model]:
                _log.info("verdict", extra=event_fields(**make_log_fields(errors)))

    def _current_verdicts(self) -> dict[str, str]:
        """Return the verdict on each model."""
        errors = self._pipeline.shadows.errors()
        return {model.model: model.overall.gain.verdict if model.overall.gain else "" for model in errors}
