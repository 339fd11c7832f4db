"""The service that answers queries about the rest of a shift, between two lists of messages."""

import logging
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from math import inf
from typing import Any, Final, Protocol

from core.errors import AskError, SocastError
from core.forecast.plan_checks import parse_leg, parse_parameters, parse_plan, parse_vehicle
from core.wire.messages import Leg, Outlook, Plan, encode
from stream.structured_log import event_fields, flatten_counts

SPEND_S: Final = 0.1
"""Longest time spent on queries before telemetry has its turn again. [s]"""
LOG_S: Final = 1.0
"""Least time between two log lines on refusals of the same cause. [s]"""

_log = logging.getLogger("socast.queries")


class PendingQuery(Protocol):
    """A query that waits for its answer, such as `stream.zenoh_queryable.ZenohQuery`."""

    @property
    def vehicle(self) -> str:
        """Return the identifier of the car."""

    @property
    def parameters(self) -> str:
        """Return the parameters after the question mark, as text."""

    @property
    def payload(self) -> bytes | None:
        """Return the plan that comes with the query, if any."""

    def reply(self, payload: bytes) -> None:
        """Answer."""

    def refuse(self, words: str) -> None:
        """Reply with what is wrong."""


class QuerySource(Protocol):
    """A source of queries, such as `stream.zenoh_queryable.ZenohQueryable`."""

    def pending(self) -> Sequence[PendingQuery]:
        """Return the queries that wait, the oldest first."""


class OutlookProvider(Protocol):
    """What the service needs of `core.pipeline.Pipeline`."""

    def ask(self, vehicle_id: str, leg: Leg | None, plan: Plan | None) -> Outlook:
        """Return what is expected of the rest of a shift, or raise `SocastError`.

        Parameters
        ----------
        vehicle_id : str
        leg : Leg or None
            The ride that the query is about; None for the shift as planned.
        plan : Plan or None
            A plan to answer for instead of the known one.
        """


class QueryService:
    """Answer the queries that wait; call it after each list of messages.

    No query ends the loop or holds up the telemetry. A query whose answer fails is refused, and queries that are not
    answered within `SPEND_S` wait for the next list.

    Parameters
    ----------
    questions : Questions
    answerer : Answerer
    clock : callable
        Monotonic time. [s]

    Attributes
    ----------
    answered : int
    refused : Counter of str
        Refusals by cause: that of the `AskError`, `unanswerable` for another error that a person can correct, `failed`
        for a defect.
    """

    def __init__(
        self, questions: QuerySource, answerer: OutlookProvider, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.answered = 0
        self.refused: Counter[str] = Counter()
        self._questions, self._answerer, self._clock = questions, answerer, clock
        self._waiting: deque[PendingQuery] = deque()
        self._logged: dict[str, float] = {}

    def __call__(self, _: object) -> None:
        """Answer queries for at most `SPEND_S`."""
        if not self._waiting:
            self._waiting.extend(self._questions.pending())
        until = self._clock() + SPEND_S
        while self._waiting:
            self._answer(self._waiting.popleft())
            if self._clock() >= until:
                return

    def counts(self) -> dict[str, Any]:
        """Return the counters since the start: `answered`, and `refused` by cause."""
        return {"answered": self.answered, "refused": dict(self.refused)}

    def end(self) -> None:
        """Log the counters where any query came."""
        if told := flatten_counts(self.counts()):
            _log.info("asked", extra=event_fields(**told))

    def _answer(self, question: PendingQuery) -> None:
        """Answer one query, or refuse it."""
        try:
            vehicle = parse_vehicle(question.vehicle)
            leg = parse_leg(parse_parameters(question.parameters))
            plan = parse_plan(question.payload, vehicle)
            question.reply(encode(self._answerer.ask(vehicle, leg, plan)))
            self.answered += 1
        except AskError as error:
            self._refuse(question, str(error), error.cause)
        except SocastError as error:
            self._refuse(question, str(error), "unanswerable")
        except Exception:  # noqa: BLE001 - a defect must not stop the telemetry
            _log.exception("question failed", extra=event_fields(vehicle=question.vehicle[:64]))
            self._refuse(question, "this question cannot be answered; the log of the consumer tells more", "failed")

    def _refuse(self, question: PendingQuery, words: str, cause: str) -> None:
        """Reply with what is wrong, count the refusal and log it."""
        self.refused[cause] += 1
        now = self._clock()
        if now >= self._logged.get(cause, -inf) + LOG_S:
            self._logged[cause] = now
            _log.warning("question refused", extra=event_fields(vehicle=question.vehicle[:64], cause=cause, why=words))
        question.refuse(words)
