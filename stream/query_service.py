"""The service that answers queries about the rest of a shift, between two lists of telemetry messages."""

import logging
import time
from collections import Counter, deque
from collections.abc import Callable
from math import inf
from typing import TYPE_CHECKING, Any, Final

from socast.core.errors import AskError, SocastError
from socast.core.pipeline import Pipeline
from socast.core.wire.messages import encode
from socast.core.wire.plan_checks import parse_leg, parse_parameters, parse_plan, parse_vehicle
from socast.stream.structured_log import event_fields, flatten_counts

if TYPE_CHECKING:
    from socast.stream.zenoh_queryable import ZenohQuery, ZenohQueryable
    from socast.stream.zenoh_standby import StandbyQueryable

SPEND_S: Final = 0.1
"""Longest time spent on queries before the loop continues with telemetry. [s]"""
LOG_S: Final = 1.0
"""Shortest time between two log lines on refusals of the same cause. [s]"""

_log = logging.getLogger("socast.queries")


class QueryService:
    """Answer the waiting queries; call it after each list of messages.

    No query stops the loop or delays the telemetry. The service refuses a query whose answer fails. Queries that it
    does not answer within `SPEND_S` wait for the next list.

    Parameters
    ----------
    clock : callable
        Function that returns monotonic time. [s]

    Attributes
    ----------
    refused : Counter of str
        Number of refusals by cause. The cause is that of the `AskError`, `unanswerable` for another error that the
        sender can correct, or `failed` for a defect.
    """

    def __init__(
        self,
        questions: "ZenohQueryable | StandbyQueryable",
        answerer: Pipeline,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.answered = 0
        self.refused: Counter[str] = Counter()
        self._questions, self._answerer, self._clock = questions, answerer, clock
        self._waiting: deque[ZenohQuery] = deque()
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
        """Return the counters since the start."""
        return {"answered": self.answered, "refused": dict(self.refused)}

    def end(self) -> None:
        """Log the counters if any query was received."""
        if counts := flatten_counts(self.counts()):
            _log.info("queries", extra=event_fields(**counts))

    def _answer(self, question: "ZenohQuery") -> None:
        """Answer or refuse one query."""
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
            self._refuse(question, "this query cannot be answered; see the log of the consumer", "failed")

    def _refuse(self, question: "ZenohQuery", words: str, cause: str) -> None:
        """Send the reason of a refusal, count the refusal and log it."""
        self.refused[cause] += 1
        now = self._clock()
        if now >= self._logged.get(cause, -inf) + LOG_S:
            self._logged[cause] = now
            _log.warning("question refused", extra=event_fields(vehicle=question.vehicle[:64], cause=cause, why=words))
        question.refuse(words)
