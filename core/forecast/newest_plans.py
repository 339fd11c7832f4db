"""Remember the newest usable plan of each vehicle, against which later arrivals are checked."""

from typing import Any

from socast.core.batch import Ints, take_keys
from socast.core.forecast.plan_checks import find_refusal, is_outdated
from socast.core.wire.messages import Plan


class NewestPlans:
    """Remember when dispatch made the newest usable plan of each lane.

    A plan that was made before the newest one arrived out of order and is refused.
    """

    def __init__(self) -> None:
        self._made: dict[int, float] = {}

    def refuse(self, lane: int, plan: Plan) -> str | None:
        """Return the cause for which a plan cannot be used, None where it can."""
        if is_outdated(plan, self._made.get(lane, plan.time_s)):
            return "plan_in_the_past"
        refused = find_refusal(plan, plan.time_s)
        return None if refused is None else refused.cause

    def accept(self, lane: int, plan: Plan) -> None:
        """Remember a usable plan as the newest of its lane."""
        self._made[lane] = plan.time_s

    def keep(self, lanes: Ints) -> None:
        """Keep the state of some lanes only, in their order."""
        self._made = take_keys(self._made, lanes)

    def dump(self) -> Any:
        """Return the state as plain values."""
        return list(self._made.items())

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned."""
        self._made = {int(lane): time for lane, time in state}
