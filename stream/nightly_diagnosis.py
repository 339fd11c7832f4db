"""Start a diagnosis after each daily update, beside the loop, and publish and log what changed when it has ended.

The diagnosis is a process of its own, which assesses the condition of the cars first; their levels become metrics. The
loop only asks whether it has ended, so that nothing delays or alters forecasts.
"""

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from math import isfinite
from typing import Any, Final, NamedTuple, Protocol

from socast.core.diagnose.findings import list_changes, make_finding_message
from socast.core.errors import SocastError
from socast.core.wire.messages import Finding
from socast.stream.source import Sink
from socast.stream.structured_log import event_fields

_log = logging.getLogger("socast.nightly")


class Job(Protocol):
    """Run beside the loop, such as a process."""

    def poll(self) -> int | None:
        """Return the exit code, None while the job runs."""

    def get_error(self) -> str:
        """Return why the job failed, after its end."""

    def end(self) -> None:
        """End the job if it runs, and free what it holds."""


class CarLevel(NamedTuple):
    """Hold the consumption of a car over what is expected [1], and its usable capacity [kWh]; None where unknown."""

    consumption_ratio: float | None
    usable_kwh: float | None


UNKNOWN_LEVEL: Final = CarLevel(None, None)


class NightlyCondition(NamedTuple):
    """Hold when the condition of the cars was assessed [Unix s], and the levels of each car."""

    assessed_s: float
    cars: Mapping[str, CarLevel]


class NightlyDiagnosis:
    """Diagnose once a day, as a watch of the loop.

    Parameters
    ----------
    get_midnight : callable
        Function that returns the midnight at which the fleet's present day ends; -inf before the first day. [Unix s]
    start : callable
        Function that starts a diagnosis. It updates the findings that `read` returns.
    read : callable
        Function that returns the findings after the last diagnosis. Those that it returns at first were announced.
    sink : Sink
        Sink that receives the messages; its `put` must not wait.
    describe : callable
        Function that returns the fields of a finding in the log.
    prefix : str
        Chunks before `findings` in the keys, with a slash at the end.
    clock : callable
        Monotonic time. [s]
    read_condition : callable
        Function that returns the condition of the cars after the last diagnosis, None before the first one.

    Attributes
    ----------
    condition : NightlyCondition, optional
        The last one that could be read.
    """

    def __init__(
        self,
        get_midnight: Callable[[], float],
        start: Callable[[], Job],
        read: Callable[[], Sequence[Finding]],
        sink: Sink,
        describe: Callable[[Finding], dict[str, Any]],
        prefix: str = "",
        clock: Callable[[], float] = time.monotonic,
        read_condition: Callable[[], NightlyCondition | None] = lambda: None,
    ) -> None:
        self._get_midnight, self._start, self._read, self._describe = get_midnight, start, read, describe
        self._sink, self._prefix, self._clock = sink, prefix, clock
        self._midnight, self._known = get_midnight(), list(read())
        self._job: Job | None = None
        self._began_s = 0.0
        self._read_condition = read_condition
        self.condition: NightlyCondition | None = None
        self._renew_condition()

    def __call__(self, _: Any) -> None:
        """Start a diagnosis when a day has ended, and announce what changed when the diagnosis has ended."""
        before, self._midnight = self._midnight, self._get_midnight()
        if self._job is not None and (code := self._job.poll()) is not None:
            self._finish(self._job, code)
        if isfinite(before) and self._midnight > before:
            self._begin()

    def end(self) -> None:
        """End a diagnosis that runs; the next night makes up for it."""
        if self._job is not None:
            _log.warning("diagnosis interrupted")
            self._job.end()
            self._job = None

    def _begin(self) -> None:
        """Start a diagnosis unless one runs."""
        if self._job is not None:
            _log.warning("the diagnosis of the last night still runs: none is made tonight")
            return
        try:
            self._job = self._start()
        except OSError as error:
            _log.error("diagnosis cannot start: %s", error)
            return
        self._began_s = self._clock()
        _log.info("diagnosis begins")

    def _renew_condition(self) -> None:
        """Read the condition of the cars again, or log why it cannot be read."""
        before = self.condition
        try:
            self.condition = self._read_condition()
        except SocastError as error:
            _log.error("condition of the cars unknown: %s", error)
            return
        if self.condition is not None and self.condition != before:
            _log.info("condition of the cars known", extra=event_fields(cars=len(self.condition.cars)))

    def _finish(self, job: Job, code: int) -> None:
        """Announce what changed, or log why the diagnosis failed."""
        self._job = None
        seconds = round(self._clock() - self._began_s, 1)
        reason = job.get_error() if code != 0 else ""
        job.end()
        self._renew_condition()
        before = self._known
        try:
            self._known = list(self._read())
        except SocastError as error:
            reason = reason or str(error)
        if reason:
            _log.error("diagnosis failed", extra=event_fields(seconds=seconds, reason=reason))
            return
        changes = list_changes(before, self._known)
        sure = sum(one.status == "sure" for one in self._known)
        proposed = sum(one.status == "proposed" for one in self._known)
        _log.info(
            "diagnosis ended",
            extra=event_fields(seconds=seconds, sure=sure, proposed=proposed, changes=len(changes)),
        )
        for finding in changes:
            _log.info("finding", extra=event_fields(**self._describe(finding)))
        self._sink.put([make_finding_message(finding, self._prefix) for finding in changes])
