"""What the demonstration says about trouble: cars at risk, a ride that one of them was asked to take, findings."""

from collections.abc import Sequence
from datetime import UTC, tzinfo
from typing import Final, NamedTuple

import msgspec

from socast.core.errors import AskError
from socast.core.pipeline import Pipeline
from socast.core.wire.messages import Finding, Forecast, Leg, address
from socast.stream.loop import Tally
from socast.stream.mcap_reader import McapSource
from socast.tools.commands.ask import HIGH_RISK, verdict
from socast.tools.terminal.time_zone import format_local

RIDE: Final = Leg(18.0, 1500.0)
"""Ride that two cars are asked to take."""


class Warned(NamedTuple):
    """Hold since when a car has been at high risk of falling below its reserve, and its newest sample. [Unix s]"""

    since_s: float
    newest_s: float


class AlarmWatch:
    """Collect which cars are at high risk and since when, and ask two of them about a ride, as a watch of the loop.

    Parameters
    ----------
    ask_at : int
        Number of received messages from which the question is put.

    Attributes
    ----------
    warned : dict of str to Warned
        Cars whose risk is above `HIGH_RISK` without interruption.
    answers : list of str
        Answers of the car with the largest risk and of the one with the smallest, as `socast ask` gives them.
    asked_s : float
        Time of the newest sample when they were asked. [Unix s]
    """

    def __init__(self, pipeline: Pipeline, ask_at: int) -> None:
        self._pipeline, self._ask_at = pipeline, ask_at
        self.warned: dict[str, Warned] = {}
        self.answers: list[str] = []
        self.asked_s = 0.0

    def __call__(self, tally: Tally) -> None:
        """Look at the newest forecasts."""
        known = [car.forecast for car in self._pipeline.status() if car.forecast.reserve_risk is not None]
        for car in known:
            if (car.reserve_risk or 0.0) > HIGH_RISK:
                since = self.warned.get(car.vehicle_id, Warned(car.time_s, 0.0)).since_s
                self.warned[car.vehicle_id] = Warned(since, car.time_s)
            else:
                self.warned.pop(car.vehicle_id, None)
        if not self.answers and tally.received >= self._ask_at and known:
            self._ask(known)

    def _ask(self, cars: Sequence[Forecast]) -> None:
        """Ask the car with the largest risk and the one with the smallest whether they can take a ride."""
        by_risk = sorted(cars, key=lambda car: (-(car.reserve_risk or 0.0), car.vehicle_id))
        self.asked_s = max(car.time_s for car in cars)
        for name in dict.fromkeys((by_risk[0].vehicle_id, by_risk[-1].vehicle_id)):
            try:
                self.answers.append(": ".join(verdict(self._pipeline.ask(name, RIDE))))
            except AskError:  # the car has no shift at that moment
                continue

    def list_sentences(self, zone: tzinfo | None = UTC) -> list[str]:
        """Return a line on the cars at risk and one on the question; fewer where there is nothing to tell."""
        out = []
        if self.warned:
            first = sorted(self.warned.items(), key=lambda item: item[1])
            told = [
                f"{car} from {format_local(each.since_s, '%H:%M', zone)} on, "
                f"{(each.newest_s - each.since_s) / 3600.0:.1f} h before its end"
                for car, each in first
            ]
            out.append(f"Alarms: the risk was over {100.0 * HIGH_RISK:.0f} % for {'; for '.join(told)}.")
        if self.answers:
            out.append(f"Asked at {format_local(self.asked_s, '%H:%M %Z', zone)}: {'. '.join(self.answers)}.")
        return out


def read_findings(recording: McapSource) -> list[str]:
    """Return what the nightly diagnosis published while the recording was made, as sentences."""
    found: dict[str, Finding] = {}
    for block in recording:
        for message in block:
            if (where := address(message.key)) is not None and where.kind == "finding":
                found[where.identity] = msgspec.json.decode(message.payload, type=Finding)
    return [f"Finding: {one.words}." for one in found.values() if one.status == "sure"]
