"""The daily update of a fleet that several consumers divide.

Each consumer collects what its own cars contribute, as exact sums, see `socast.core.totals.exact_sums`. Before midnight
UTC it ends the day and publishes its contribution. Once it has those of all shards, it makes the tables of the new day
of their sum, which are the same in all shards, however the fleet is divided. A car uses them from its own midnight on,
see `socast.core.forecast.car_days`. A shard whose contribution is missing blocks nothing: forecasts go on with the
tables of the day before, and the next update leaves it out.

A driver may drive cars of several shards. The shifts of a car that a named driver drove on this day are therefore
published one by one, and all consumers learn from them in the order of the names of cars.
"""

import base64
import zlib
from collections.abc import Iterator, Sequence
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np

from socast.core.batch import Ints
from socast.core.columns import SECONDS_PER_DAY
from socast.core.forecast.car_days import LAST_DAY, CarDays
from socast.core.forecast.day_schema import CONTENT
from socast.core.forecast.engine import DueInput, ForecastEngine
from socast.core.forecast.learning.car_driver import LogFactor
from socast.core.forecast.learning.fleet import FleetDay, FleetStatistics, GuestCar, ShiftEnergy
from socast.core.totals.accumulator import EDGES, Sums
from socast.core.totals.clean_rows import CleanRows
from socast.core.totals.display_yield import DisplayYields
from socast.core.totals.exact_sums import ExactSums
from socast.core.wire.message_block import KeyValues, MessageBlock
from socast.core.wire.messages import Message, Vehicle
from socast.core.wire.shard import Shard

SPACE: Final = "socast/shards/"
"""Chunks under the prefix before those of a shard, as `2-of-4`, in the keys of contributions."""
SEAL_LEAD: Final = 900.0
"""Time before midnight UTC at which a consumer ends the day, by the stamps of most of its cars. [s]"""
SILENCE_MARGIN: Final = 1200.0
"""Time before midnight from which cars contribute to the next update, beyond the longest silence within a ride. [s]"""
LARGEST: Final = 1 << 28
"""Largest size of a contribution that is not compressed. [B]"""
_KIND, _CODE = EDGES.index("kind"), EDGES.index("code")


class Contribution(msgspec.Struct):
    """Hold the payload of a shard's contribution to a daily update.

    Parameters
    ----------
    shard : str
        Such as `2/4`.
    day : int
        Number since 1970 of the day that begins.
    content : str
        Base 64 of compressed MessagePack.
    """

    shard: str
    day: int
    content: str


class _Content(NamedTuple):
    """Hold what a contribution consists of, as plain values."""

    day: Any
    vehicles: dict[str, Any]  # vehicle message of the newest ride of each model
    displays: dict[str, bytes]
    shifts: list[Any]  # (name of the car, its part before, its shifts)
    cars: int  # with a shift so far

    def list_guests(self) -> list[GuestCar]:
        """Return the cars whose drivers all consumers learn of."""
        return [
            GuestCar(name, LogFactor(*part), [ShiftEnergy(*each) for each in shifts])
            for name, part, shifts in self.shifts
        ]


class ShardDays:
    """Collect by day, exchange contributions, and choose the statistics that each car uses.

    Parameters
    ----------
    shard : Shard
    engine : ForecastEngine
        Its statistics are replaced.
    displays : DisplayYields
    prefix : str
        Chunks before `socast` in the keys, with a slash at the end.

    Attributes
    ----------
    cars : CarDays
    ended : int
        Newest day that has begun; -1 before the first sample.
    tables_of : int
        Day whose tables are the newest.
    absent : tuple of int
        Shards without a contribution to the newest day that has begun, while others have one.
    left_out : int
        Number of contributions that updates had to leave out.
    """

    def __init__(self, shard: Shard, engine: ForecastEngine, displays: DisplayYields, prefix: str) -> None:
        self.shard, self.ended, self.tables_of, self.left_out = shard, -1, -1, 0
        self._engine, self._displays, self._context = engine, displays, engine.context
        self.cars = CarDays(self._context.settings.gap_time + SILENCE_MARGIN)
        self._keys = f"{prefix}{SPACE}"
        self._are_contributions = KeyValues(lambda key: key.startswith(self._keys), np.bool_)
        self._width = engine.width
        newest = FleetStatistics(self._context, self._width, ExactSums)
        self._tables = [newest, newest]
        self._days = [FleetDay(), FleetDay()]
        self._sealed: dict[int, FleetDay] = {}
        self._contents: dict[int, dict[int, _Content]] = {}
        self._outgoing: list[Message] = []
        self.select(3)
        engine.divide = self.split

    @property
    def absent(self) -> tuple[int, ...]:
        """Return the shards whose contribution to the newest day is missing."""
        known = self._contents.get(self.ended, {}) if self.ended > self.tables_of else None
        return () if known is None else tuple(each for each in range(1, self.shard.count + 1) if each not in known)

    @property
    def begun(self) -> list[int]:
        """Return the days that have begun in other shards and not yet in this one, in order."""
        return sorted(day for day in self._contents if day > self.ended)

    def take_messages(self, messages: Sequence[Message]) -> MessageBlock:
        """Keep contributions, and return the other messages."""
        block = MessageBlock.of(messages)
        is_contribution = self._are_contributions.get(block)
        if not is_contribution.any():
            return block
        for message in block.take(is_contribution):
            self._read(message)
        return block.take(~is_contribution)

    def take_outgoing(self) -> list[Message]:
        """Return and drop what is to be published."""
        taken, self._outgoing = self._outgoing, []
        return taken

    def list_behind(self, day: int) -> Ints:
        """Return the cars that still contribute to the update for a day; they have been silent for long."""
        collects = self.cars.of_lane["collects"]
        return np.flatnonzero((collects >= 0) & (collects < day))

    def end_day(self, day: int) -> None:
        """End the day before a day: publish what was collected, once the cars of `list_behind` have no open ride.

        Nothing may be pending.
        """
        if self.ended < 0 or day <= self.ended:
            if day != self.ended:  # the first day, or a day that began by mistake
                self.ended = self.tables_of = day
            return
        if self.ended > self.tables_of:
            self._make_tables(self.ended)
        behind = np.flatnonzero(self.cars.of_lane["frozen"] < day)
        self._freeze(behind[self.cars.of_lane["collects"][behind] < day], day)
        sealed = self._days[0]
        self._days = [self._days[1], FleetDay()]
        self._sealed[day], self.ended = sealed, day
        content = self._describe(sealed)
        self._contents.setdefault(day, {})[self.shard.index] = content
        self._publish(day, content)
        self.complete()

    def _publish(self, day: int, content: _Content) -> None:
        """Let a contribution be published."""
        packed = base64.b64encode(zlib.compress(msgspec.msgpack.encode(content), 6)).decode()
        payload = msgspec.json.encode(Contribution(str(self.shard), day, packed))
        self._outgoing.append(Message(f"{self._keys}{self.shard.chunk}", payload, round(day * SECONDS_PER_DAY * 1e9)))

    def complete(self) -> None:
        """Make the tables of the day that has begun, if all contributions are there; nothing may be pending."""
        if self.ended > self.tables_of and not self.absent:
            self._make_tables(self.ended)

    def add_rows(self, rows: CleanRows, offset: int, lanes: int) -> tuple[Ints, Ints]:
        """Take cleaned rows, see `CarDays.add_rows`; `offset` is the number of pending messages before the batch."""
        self.cars.grow(lanes)
        place = np.arange(rows.size) if rows.place is None else rows.place
        return self.cars.add_rows(rows.clean.lane, rows.clean.time, place + offset)

    def attach(self, sums: Sums, lanes: int, moved: tuple[Ints, Ints], offset: int) -> Iterator[Sums]:
        """Yield the parts of sums with the yields of displays, while cars begin days between them."""
        collecting, serving = moved
        serving = (
            serving[self.cars.of_lane["serves"][serving] >= self.tables_of] if self.tables_of >= 0 else serving[:0]
        )
        at = self.cars.of_lane["collects_at"][collecting] - 1
        anew = self.cars.find_served(collecting, at) >= self.tables_of
        early, late = collecting[~anew], collecting[anew]
        of_parts = [self.find_classes(part.lane, part.at + offset) for part in sums]
        for number in range(4):
            if number in (1, 3):
                self._freeze(early if number == 1 else late, None)
            if number == 2 and len(serving):
                self._displays.enter_day(serving)
            if any((classes == number).any() for classes in of_parts):
                part = Sums(*(p.rows(np.flatnonzero(c == number)) for p, c in zip(sums, of_parts, strict=True)))
                yield self._displays.attach(part, lanes)

    def find_classes(self, lanes: Ints, at: Ints) -> Ints:
        """Return the class of cars at places: 1 where they contribute to the next update but one, 2 more on new tables.

        The class of a car only grows while nothing ends.
        """
        collects_later = self.cars.find_collected(lanes, at) > self.ended
        return collects_later + 2 * (self.cars.find_served(lanes, at) >= self.tables_of)

    def split(self, due: DueInput) -> Iterator[tuple[Ints, DueInput]]:
        """Yield the parts of an input by class with the numbers of their running rows; select statistics for each."""
        sums = due.sums
        self.cars.grow(len(self._context.lanes))
        classes = [self.find_classes(part.lane, part.at) for part in sums]
        messages = (due.arrivals, due.drivers)
        of_messages = [self.find_classes(*_locate(each)).tolist() for each in messages]
        present = sorted({*np.concatenate(classes).tolist(), *of_messages[0], *of_messages[1]}) or [3]
        weather = self._engine.weather.dump() if len(present) > 1 and due.forecasts else None
        for number in present:
            if weather is not None:
                self._engine.weather.load(weather)
            rows = [np.flatnonzero(of_part == number) for of_part in classes]
            part = Sums(*(totals.rows(which) for totals, which in zip(sums, rows, strict=True)))
            plans, drivers = (
                [each for each, c in zip(some, of_some, strict=True) if c == number]
                for some, of_some in zip(messages, of_messages, strict=True)
            )
            self.select(number)
            yield rows[-1], due._replace(sums=part, arrivals=plans, drivers=drivers)  # type: ignore[arg-type]

    def select_of(self, lane: int) -> None:
        """Let the engine use the statistics of a car as it is now."""
        self.select(int(self.find_classes(np.array([lane]), np.array([np.iinfo(np.int64).max]))[0]))

    def select(self, number: int) -> None:
        """Let the engine use the statistics of a class of cars."""
        statistics = self._tables[number // 2]
        statistics.use_day(self._days[number % 2])
        self._engine.statistics = statistics

    def _freeze(self, lanes: Ints, day: int | None) -> None:
        """Take the contributions of displays of cars, unless it was done for the update to which they contribute."""
        cars = self.cars.of_lane
        days = cars["collects"][lanes] if day is None else np.full(len(lanes), day)
        which = cars["frozen"][lanes] < days
        if which.any():
            self._displays.freeze(lanes[which])
            cars["frozen"][lanes[which]] = days[which]

    def _describe(self, sealed: FleetDay) -> _Content:
        """Return a contribution; its shifts are those of cars that a named driver drove."""
        factors, names = self._tables[1].factors, self._context.lanes.names
        shared = {each.lane for each in sealed.shifts if each.driver is not None}
        of_lane: dict[int, list[ShiftEnergy]] = {}
        for each in sealed.shifts:
            of_lane.setdefault(each.lane, []).append(each)
        ordered = sorted(shared, key=names.__getitem__)
        shifts = [(names[lane], factors.get_car(lane), of_lane[lane]) for lane in ordered]
        sealed.shifts[:] = [each for each in sealed.shifts if each.lane not in shared]
        day = FleetDay()
        day.rides, day.sums = sealed.rides, sealed.sums
        vehicles = {
            name: msgspec.to_builtins(self._context.cars.messages[int(sums.last_edge[_KIND])])
            for name, sums in sealed.rides.items()
            if sums.last_edge[_KIND]
        }
        displays = {name: sums.dump() for name, sums in self._displays.contribute().items()}
        return _Content(day.dump(), vehicles, displays, msgspec.to_builtins(shifts), len(factors))

    def _read(self, message: Message) -> None:
        """Keep a contribution that can be used."""
        try:
            sent = msgspec.json.decode(message.payload, type=Contribution)
            index = int(sent.shard.partition("/")[0])
            fits = sent.shard == f"{index}/{self.shard.count}" and 1 <= index <= self.shard.count
            if not fits or index == self.shard.index or not self.tables_of < sent.day <= LAST_DAY:
                return
            plain = zlib.decompressobj().decompress(base64.b64decode(sent.content), LARGEST)
            content = self._load_content(msgspec.msgpack.decode(plain))
        except (ArithmeticError, ValueError, TypeError, LookupError, zlib.error):
            return
        self._contents.setdefault(sent.day, {})[index] = content

    def _load_content(self, state: Any) -> _Content:
        """Return a contribution; raise an error for one that cannot be used."""
        CONTENT.check(state, {"lanes": 0})
        content = _Content(*state)
        for dumped in content.displays.values():
            _load_sums(dumped)
        self._try_day(self._load_day(content), content.list_guests())
        return content

    def _try_day(self, day: FleetDay, guests: Sequence[GuestCar] = ()) -> None:
        """Raise ValueError or ArithmeticError where no tables can be made of a day, which is used up."""
        statistics = FleetStatistics(self._context, self._width, ExactSums)
        day.shifts, day.patterns = [], []
        statistics.use_day(day)
        with np.errstate(all="ignore"):
            statistics.apply_daily_update(guests)
        learned = statistics.charged_soc.covariance, statistics.correction.covariance, statistics.conformal.table
        if not all(np.isfinite(each).all() for each in learned):
            raise ValueError("no tables can be made of a day")

    def _load_day(self, content: _Content) -> FleetDay:
        """Return the sums of a contribution, with the numbers of this process for its kinds of cars."""
        day = FleetDay(content.day, self._tables[1].rides)
        for name, sums in day.rides.items():
            vehicle = content.vehicles.get(name)
            kind = self._context.cars.find_kind(msgspec.convert(vehicle, Vehicle)) if vehicle else None
            for edge in (sums.first_edge, sums.last_edge):
                edge[_KIND], edge[_CODE] = float(kind or 0), -1.0
        return day

    def _make_tables(self, day: int) -> None:
        """Make the tables of a day of the contributions that are there."""
        contents = dict(sorted(self._contents.get(day, {}).items()))
        self.left_out += self.shard.count - len(contents)
        merged, pooled, guests = FleetDay(), dict[str, ExactSums](), list[GuestCar]()
        for content in contents.values():
            merged.merge(self._load_day(content))
            for name, dumped in content.displays.items():
                pooled.setdefault(name, ExactSums(sums=(2,))).merge(_load_sums(dumped))
            guests += content.list_guests()
        local = self._sealed.get(day, FleetDay())
        merged.shifts, merged.patterns = local.shifts, local.patterns
        old = self._tables[1]
        old.use_day(FleetDay())
        new = FleetStatistics(self._context, self._width, ExactSums)
        new.load(old.dump())
        new.interval_outcomes = old.interval_outcomes
        new.grow(len(self._context.lanes))
        new.use_day(merged)
        new.factors.fleet_cars = sum(content.cars for content in contents.values())
        new.apply_daily_update(sorted(guests, key=lambda guest: guest.name))
        self._tables, self.tables_of = [old, new], day
        self._displays.begin_day(pooled, np.flatnonzero(self.cars.of_lane["serves"] >= day))
        self._contents = {each: known for each, known in self._contents.items() if each > day}
        self._sealed = {each: known for each, known in self._sealed.items() if each > day}
        self.select(3)

    def keep(self, lanes: Ints) -> None:
        """Keep the state of some lanes only, in their order; the engine keeps its own statistics."""
        self.cars.keep(lanes)
        for day in (*self._days, *self._sealed.values()):
            day.keep(lanes)
        for statistics in {id(each): each for each in self._tables}.values():
            if statistics is not self._engine.statistics:
                statistics.keep(lanes)

    def release(self) -> None:
        """Let the engine hold the newest tables, and nothing of the day, so that it can dump its state."""
        self._tables[1].use_day(FleetDay())
        self._engine.statistics = self._tables[1]

    def learn(self) -> None:
        """Begin with the statistics that the engine has learned of earlier recordings."""
        self._tables = [self._engine.statistics] * 2
        self.select(3)

    def dump(self) -> Any:
        """Return the state as plain values, but for the newest tables, which the engine dumps."""
        tables = None
        if self._tables[0] is not self._tables[1]:
            self._tables[0].use_day(FleetDay())
            tables = self._tables[0].dump()
        days = [[day.dump() for day in self._days], {str(day): each.dump() for day, each in self._sealed.items()}]
        contents = [(day, list(known.items())) for day, known in self._contents.items()]
        kept = self.ended, self.tables_of, self.left_out, self.cars.dump()
        return str(self.shard), *kept, tables, *days, contents

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned, after that of the engine."""
        shard, self.ended, self.tables_of, self.left_out, cars, tables, days, sealed, contents = state
        if shard != str(self.shard):
            raise ValueError(f"it is that of shard {shard}, and this is shard {self.shard}")
        newest = self._engine.statistics
        self._tables = [newest, newest]
        if tables is not None:
            self._tables[0] = FleetStatistics(self._context, self._width, ExactSums)
            self._tables[0].load(tables)
            self._tables[0].interval_outcomes = newest.interval_outcomes
        self.cars.load(cars)
        for day in (*days, *sealed.values()):
            self._try_day(FleetDay(day, newest.rides))
        self._days = [FleetDay(day, newest.rides) for day in days]
        self._sealed = {int(day): FleetDay(each, newest.rides) for day, each in sealed.items()}
        self._contents = {day: {index: self._load_content(each) for index, each in known} for day, known in contents}
        self.select(3)
        if (own := self._contents.get(self.ended, {}).get(self.shard.index)) is not None:
            self._publish(self.ended, own)  # it may not have reached the others


def _load_sums(dumped: bytes) -> ExactSums:
    """Return the sums of weight, and weight times factor, of a vehicle model."""
    sums = ExactSums(sums=(2,))
    sums.load(dumped)
    return sums


def _locate(messages: Sequence[Any]) -> tuple[Ints, Ints]:
    """Return the lanes and the places of messages."""
    return np.array([each.lane for each in messages], np.int64), np.array([each.at for each in messages], np.int64)
