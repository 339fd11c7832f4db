"""Run all steps for a share of a fleet, and exchange what is learned of it with the pipelines of the other shares."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from socast.core.cleaning.fleet_clock import end_open_rides
from socast.core.columns import SECONDS_PER_DAY
from socast.core.forecast.day_rollover import DayRollover
from socast.core.forecast.shard_days import SEAL_LEAD, SPACE, ShardDays
from socast.core.models import EXTENDED_PHYSICAL, Model
from socast.core.pipeline import OF_LANES, Pipeline
from socast.core.settings import Settings
from socast.core.totals.clean_rows import CleanRows
from socast.core.wire.arrow_batch import select_rows
from socast.core.wire.decoder import Refused
from socast.core.wire.message_block import KeyValues, MessageBlock
from socast.core.wire.messages import BATCH, Leg, Message, Outlook, Plan
from socast.core.wire.shard import Shard


class ShardedPipeline(Pipeline):
    """Run all steps from messages to forecasts for the cars of a shard.

    The forecasts of a car are the same, to the bit, however the fleet is divided, also if one shard has all cars. See
    `socast.core.forecast.shard_days` for the daily update, and `Pipeline` for the other parameters.

    Parameters
    ----------
    shard : Shard

    Attributes
    ----------
    days : ShardDays
    """

    of_lanes = (*OF_LANES, "days")

    def __init__(
        self,
        shard: Shard,
        model: Model = EXTENDED_PHYSICAL,
        settings: Settings = Settings(),  # noqa: B008 - immutable
        prefix: str = "",
        **options: Any,
    ) -> None:
        super().__init__(model, settings, prefix, **options)
        self.shard, self.day_rollover = shard, DayRollover(SEAL_LEAD)
        self.shadows.prefix = f"{prefix}{SPACE}{shard.chunk}/"
        self.days = ShardDays(shard, self.engine, self.displays, prefix)
        self._is_idle = True
        self._are_batches = KeyValues(lambda key: key.endswith(f"/{BATCH}"), np.bool_)

    def take(self, messages: Sequence[Message], record: Callable[[Sequence[Message]], None] | None = None) -> None:
        """Take messages, and of the batches of gateways the rows of this shard's cars, see `Pipeline.take`."""
        block = MessageBlock.of(messages)
        if self.shard.count > 1 and self.shard.by == "name" and self._are_batches.get(block).any():
            own = (self._cut_batch(each) if each.key.endswith(f"/{BATCH}") else each for each in block)
            block = MessageBlock.of([message for message in own if message is not None])
        super().take(block, record)

    def _cut_batch(self, message: Message) -> Message | None:
        """Return a batch with the rows of this shard's cars only; None without any.

        A batch that cannot be read is left to the shard of the gateway's name, which counts it.
        """
        is_large = len(message.payload) > self.limits.payload_bytes
        rows = "too_large" if is_large else self.decoder.batches.read(message.payload)
        if isinstance(rows, str):
            return message if self.shard.has(message.key.split("/")[-2]) else None
        own = [self.shard.has(rows.vehicles.get(at)) for at in range(len(rows.is_usable))]
        if all(own):
            return message
        return message._replace(payload=select_rows(message.payload, own)) if any(own) else None

    def forecasts(self, *, newest_only: bool = False) -> list[Message]:
        """Return the forecasts since the last call, as `Pipeline` does.

        Where nothing came since then, a day that has begun in other shards begins here too. A consumer that is behind
        still receives what belongs to the day before.
        """
        for day in self.days.begun if self._is_idle else ():
            if self.days.ended < 0:  # no car of this shard has sent anything so far
                self.days.end_day(day - 1)
            self._end_day(day, -1)
        self._is_idle = True
        return super().forecasts(newest_only=newest_only)

    def model_errors(self, *, newest_only: bool = False) -> list[Message]:
        """Return the running errors of models, as `Pipeline` does, and what this shard contributes to daily updates."""
        return super().model_errors(newest_only=newest_only) + self.days.take_outgoing()

    def ask(self, vehicle_id: str, leg: Leg | None = None, plan: Plan | None = None) -> Outlook:
        """Return the outlook on the rest of a vehicle's shift, see `Pipeline.ask`."""
        self._update_forecasts()
        lane = self.lanes.find(vehicle_id)
        if lane is not None:
            self.days.select_of(lane)
        return super().ask(vehicle_id, leg, plan)

    def learn_from(self, earlier: Pipeline) -> None:
        """Take over what another pipeline has learned, and of its cars those of this shard, see `Pipeline`."""
        super().learn_from(earlier)
        self.days.learn()
        if self.shard.by == "name":
            kept = np.array([lane for lane, name in enumerate(self.lanes.names) if self.shard.has(name)], np.int64)
            for name in self.of_lanes:
                getattr(self, name).keep(kept)
            self.lanes.keep(kept)

    def snapshot(self, note: Any = None) -> bytes:
        """Return the state of every vehicle and of the exchange, and a plain note, see `Pipeline.snapshot`."""
        self._update_forecasts()
        self.days.release()
        sealed = super().snapshot(note)
        self.days.select(3)
        return sealed

    def _use(self, messages: Sequence[Message], record: Callable[[Sequence[Message]], None] | None) -> list[Refused]:
        """Record new messages, take contributions of other shards, and run all steps on the other messages."""
        if record is not None:
            record(messages)
        left = self.days.take_messages(messages)
        if len(left) < len(messages):
            self._update_forecasts()
            self.days.complete()
        self._is_idle &= not left
        refusals = super()._use(left, None)
        if not self._pending:
            self.days.cars.settle()
        return refusals

    def _add_rows(self, rows: CleanRows) -> None:
        """Sum up cleaned rows, and take the totals, while cars begin their days between them."""
        offset, lanes = self._pending.before, len(self.lanes)
        moved = self.days.add_rows(rows, offset, lanes)
        for number, part in enumerate(self.days.attach(self.sum_up(rows), lanes, moved, offset)):
            self._take_attached(part, 0 if number else rows.size)

    def _learn_from_day(self, place: int, midnight: float) -> None:
        """End the day, and contribute what was learned of it."""
        self._end_day(int(midnight / SECONDS_PER_DAY) - 1, place)
        self.engine.weather.forget_before(midnight - SECONDS_PER_DAY)

    def _end_day(self, day: int, place: int) -> None:
        """End the day before a day, and the rides of cars that have been silent for long, at a place in the batch."""
        batch, _ = self.decoder.decode([])
        empty, none = self.clean_up(batch, np.zeros(0, np.int64)), self.days.list_behind(day)
        self._add_rows(empty._replace(ends=end_open_rides(self.cleaner.state, none, place)))
        self._update_forecasts(max(place, 0))
        self.days.end_day(day)
