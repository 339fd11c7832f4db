"""What is ahead of every car, as samples come: the filter, what is learned of shifts, and the forecast of the charge.

Everything of a car follows from that car's own events, in their order. What is learned of the fleet is gathered through
the day and learned overnight (`core.forecast.lessons`). So forecasts do not depend on how messages are cut into batches,
nor on who else was served a moment earlier.
"""

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.batch import Floats, Ints, grown
from core.columns import JOULES_PER_KWH, ZERO_CELSIUS
from core.forecast import outlook, soc_filter
from core.forecast.learning.car_driver import Habit, code_of
from core.forecast.learning.fleet import Lessons
from core.forecast.learning.forecast_errors import Note, ShiftLog
from core.forecast.outlook import Known
from core.forecast.plan_tracker import Arrival, Courses, Driving, ride_km
from core.totals.accumulator import Sums, Totals, join_totals
from core.totals.context import RunContext
from core.totals.tables import model_columns

SEEN: Final = (
    *("soc", "soc_sd", "mean", "p05", "p95", "risk", "range", "range_p05", "range_p95", "expected", "spread"),
    *("end", "kind", "ahead_km", "far_km", "reserve", "ambient", "shift", "begin", "begin_soc", "distance"),
    *("reported", "charged", "lean"),
)
"""What is told at each row: the charge and its standard deviation; the charge at the shift's end, its 5th and 95th
percentile, and the risk of ending below the reserve [1]; the range to the reserve [km]; that charge and its standard
deviation before errors are learned from [1]; when the shift ends [s]; whether by plan (0) or by habit (1); the
kilometres ahead, and those that all the energy ahead would usually do; the reserve [1]; the outside temperature [°C];
the shift's ordinal, beginning [s], charge then [1] and distance so far [m]; the charge as reported last [1]; when it
last charged within the shift [s]; the factor of the energy ahead by what forecasts were short by."""
_EXPECTED: Final = SEEN.index("expected")
_END: Final = [SEEN.index(name) for name in ("mean", "p05", "p95", "risk")]
CUT: Final = 900.0
"""A shift that lacks more of its plan when a recording ends was cut off with it. [s]"""
SHORT_SHIFT: Final = 0.5
"""A shift that was shorter tells nothing. [h]"""


class Rows(NamedTuple):
    """What is told at rows of running totals: the energy predicted so far [kWh], and `SEEN`, (n, len(SEEN))."""

    predicted: Floats
    seen: Floats

    def at(self, name: str) -> Floats:
        """Return a column of `SEEN`."""
        return self.seen[:, SEEN.index(name)]

    def rows(self, which: Ints) -> "Rows":
        """Return some of the rows."""
        return Rows(self.predicted[which], self.seen[which])

    @classmethod
    def joined(cls, parts: Sequence["Rows"]) -> "Rows":
        """Return rows one after another."""
        none = cls(np.empty(0), np.empty((0, len(SEEN))))
        return cls(*(np.concatenate(columns) for columns in zip(none, *parts, strict=True)))


class Foresight:
    """The filters, the plans and the shifts of every lane, and what was learned of the fleet.

    Parameters
    ----------
    context : RunContext
    width : int
        Amounts that are summed of a ride.

    Attributes
    ----------
    ends : (lanes, 4) float
        The newest forecast of each lane's charge at the shift's end: mean, 5th and 95th percentile, and the risk of
        ending below the reserve; NaN before there is one, also after a restart. [1]
    """

    def __init__(self, context: RunContext, width: int) -> None:
        self.context, self._cars = context, context.cars
        self.lessons = Lessons(context, width)
        self.courses, self.log = Courses(), ShiftLog()
        self.state = soc_filter.new_state(0)
        self.ends = np.zeros((0, len(_END)))
        self.closed: list[NDArray[np.void]] = []

    def follow(self, sums: Sums, arrivals: Sequence[Arrival], drivings: Sequence[Driving]) -> Rows:
        """Take what a batch brought; return what is told at each of its running rows.

        Parameters
        ----------
        sums : Sums
        arrivals : sequence of Arrival
            Plans that came.
        drivings : sequence of Driving
            Who drives.
        """
        lanes = len(self.context.lanes)
        if len(self.state) < lanes:
            self.state = grown(self.state, lanes, soc_filter.new_state(1)[0])
        self.ends = grown(self.ends, lanes, np.nan)
        self.log.grow(lanes)
        self.lessons.grow(lanes)
        parts = sums.rides, sums.rests, sums.running
        whole = join_totals(parts, sums.running)
        ends = np.cumsum([len(part.lane) for part in parts])
        predicted = self._predict(whole)
        of_rides, of_rests, of_running = np.split(predicted, ends[:-1])
        self.lessons.rides(sums.rides, of_rides)
        self.lessons.rests(sums.rests, of_rests)
        events, at = self._events(whole, predicted, int(ends[1]), drivings)
        told = np.empty((len(events), len(soc_filter.TOLD)))
        shifts = np.empty(len(events), soc_filter.CLOSED_SHIFT)
        shifts = shifts[: soc_filter.follow(events, self.state, self.lessons.prior, told, shifts)]
        told = told[events["kind"] == soc_filter.RUNNING]
        courses = self.courses.follow(sums.running, sums.rides, arrivals, self.lessons.tables, lanes)
        rows = Rows(of_running, self._tell(sums.running, told, courses))
        self.ends[sums.running.lane] = rows.seen[:, _END]
        self._judge(sums.running, rows, shifts, at)
        return rows

    def _predict(self, totals: Totals) -> Floats:
        """Return the energy that the model predicts of totals. [kWh]"""
        if not len(totals.lane):
            return np.empty(0)
        model = self.context.model
        return model.predict(model_columns(totals, self.context, model.needs))

    def _events(
        self, totals: Totals, predicted: Floats, ended: int, drivings: Sequence[Driving]
    ) -> tuple[NDArray[np.void], Ints]:
        """Return what the filters hear, in order, and the row of the batch of each; the first totals have ended."""
        n = len(totals.lane)
        events = np.empty(n + len(drivings), soc_filter.EVENT)
        self._hear(totals, predicted, events[:n])
        events["kind"][:ended], events["kind"][ended:n] = soc_filter.CLOSED, soc_filter.RUNNING
        self._hear_of(drivings, events[n:])
        if n == len(events) and not ended:
            return events, totals.at
        at = np.concatenate([totals.at, np.array([d.at for d in drivings], dtype=np.int64)])
        rank = np.repeat([1, 2, 0], [ended, n - ended, len(drivings)])
        order = np.lexsort((rank, at))
        return events[order], at[order]

    def _hear(self, totals: Totals, predicted: Floats, out: NDArray[np.void]) -> None:
        """Write totals down as events."""
        duration, riding = totals.amount("duration"), totals.ride >= 0
        car = totals.at_last("kind").astype(np.int64)
        known = np.divide(totals.amount("ambient"), duration, out=np.full(len(duration), np.nan), where=duration > 0.0)
        out["lane"], out["time"] = totals.lane, totals.at_last("time")
        out["predicted"] = predicted
        out["factor"], out["power"] = self.lessons.corrected(car, riding, outlook.temperature_weights(known))
        out["metered"] = totals.amount("energy") / JOULES_PER_KWH
        out["meter_time"], out["duration"] = totals.amount("metered"), duration
        out["riding"] = riding
        out["distance"], out["ambient"] = totals.amount("distance"), totals.amount("ambient")
        out["soc"], out["step"] = totals.at_last("soc"), totals.at_last("soc_step")
        out["since_charge"], out["capacity"] = totals.at_last("since_charge"), self._cars.capacity[car]

    def _hear_of(self, drivings: Sequence[Driving], out: NDArray[np.void]) -> None:
        """Write down as events who drives."""
        out[:] = np.zeros((), soc_filter.EVENT)
        for event, driving in zip(out, drivings, strict=True):
            code = code_of(driving.driver)
            event["kind"], event["lane"], event["duration"] = soc_filter.NAMED, driving.lane, code
            event["predicted"], event["metered"] = self.lessons.scales.part_of(code)

    def _tell(self, running: Totals, told: Floats, courses: NDArray[np.void]) -> Floats:
        """Return `SEEN` of each row."""
        seen = dict(zip(soc_filter.TOLD, told.T, strict=True))
        time, car = running.at_last("time"), running.at_last("kind").astype(np.int64)
        usual = self.lessons.usual(car, outlook.temperature_weights(seen["ambient"]))
        known = Known.of(seen, self._cars.capacity[car])
        ahead = outlook.by_plan(courses, time, ride_km(running), running.ride >= 0, usual)
        ahead = outlook.by_habit(ahead, usual, time - seen["begin"], time, *self.lessons.habits_of(running.lane))
        celsius = seen["ambient"] - ZERO_CELSIUS
        lean = self.lessons.lean.factor[ahead.kind]
        ahead = ahead._replace(energy=ahead.energy * lean)
        end = outlook.at_end(known, ahead.energy, ahead.hours)
        far_km = ahead.energy / usual.per_km
        errors, bounds = self.lessons.conformal.quantiles(ahead.kind, far_km, celsius)
        ends = np.clip(end.mean[:, np.newaxis] + end.sd[:, np.newaxis] * bounds, 0.0, 1.0)
        reach = outlook.reach(known, ahead.reserve, usual)
        kinds = np.zeros_like(ahead.kind)
        far, by_habit = (self.lessons.conformal.quantiles(kinds + k, reach.mean, celsius)[1] for k in (0, 1))
        far = np.where(np.isfinite(far), far, by_habit)
        ranges = np.maximum(reach.mean[:, np.newaxis] + reach.sd[:, np.newaxis] * far, 0.0)
        risk = outlook.risk(end, ahead.reserve, errors)
        return np.column_stack(
            [
                *(
                    known.soc,
                    np.sqrt(np.maximum(known.variance, soc_filter.FLOOR**2)),
                    *ends.T,
                    risk,
                    *ranges.T,
                    end.mean,
                    end.sd,
                ),
                *(ahead.end, ahead.kind, ahead.km, far_km, ahead.reserve, celsius, seen["shift"], seen["begin"]),
                *(seen["begin_soc"], seen["distance"], seen["reported"], seen["charged"], lean),
            ]
        )

    def _judge(self, running: Totals, rows: Rows, shifts: NDArray[np.void], at: Ints) -> None:
        """Note forecasts, and judge those whose end has come, in the order in which things happened.

        `at` is the row of the batch of each event.
        """
        steps: list[tuple[int, int, int]] = [(int(at[int(shift["event"])]), 0, i) for i, shift in enumerate(shifts)]
        time = running.at_last("time")
        due = np.unique(running.lane[self.log.due(running.lane, time, rows.at("expected"))])
        due = np.union1d(due, shifts["lane"].astype(np.int64))
        mine = np.flatnonzero(np.isin(running.lane, due)) if len(due) else due
        steps += [(row, 1, i) for row, i in zip(running.at[mine].tolist(), mine.tolist(), strict=True)]
        for _, what, i in sorted(steps):
            if what == 0:
                self._close(shifts[i])
            elif self.log.due(lane := int(running.lane[i]), time[i], rows.seen[i, _EXPECTED]):
                row = dict(zip(SEEN, rows.seen[i].tolist(), strict=True))
                told = (row[name] for name in ("far_km", "ambient", "expected", "spread", "soc", "lean"))
                note = Note(float(time[i]), row["end"], int(row["kind"]), *told)
                self.lessons.judged(self.log.ended(lane, note.time, row["reported"], row["charged"]))
                self.log.note(lane, note)

    def _close(self, shift: NDArray[np.void]) -> None:
        """Learn from a shift that has ended."""
        lane = int(shift["lane"])
        self.closed.append(shift.copy())
        self.lessons.judged(self.log.closed(lane, float(shift["last_soc"]), float(shift["charged"])))
        capacity = float(self._cars.capacity[self._cars.of_lane[lane]])
        used = (float(shift["begin_soc"]) - float(shift["last_soc"])) * capacity
        if shift["hours"] >= SHORT_SHIFT and np.isnan(shift["charged"]) and np.isfinite(used):
            ambient = np.array([float(shift["warmth"] / shift["hours"])])
            usual = self.lessons.usual(self._cars.of_lane[[lane]], outlook.temperature_weights(ambient))
            length = (float(shift["end"]) - float(shift["begin"])) / 3600.0
            predicted = float(shift["predicted"])
            driver = int(shift["driver"]) if shift["driver"] >= 0.0 else None
            busy = predicted / (float(usual.power[0]) * length)
            self.lessons.shift(lane, (driver, predicted, used, capacity), Habit(length, busy) if busy > 0.0 else None)

    def overnight(self) -> None:
        """Learn what the day taught."""
        self.lessons.overnight()

    def finish(self, *, cut: bool = False) -> None:
        """Close every shift in progress, at the end of the stream; where that was cut, those that were over by plan."""
        there = self.state["shift"] >= 0.0
        if cut:
            courses = self.courses.of_lane[: len(there)]
            there[len(courses) :] = False
            there[: len(courses)] &= (courses["planned"] == 1.0) & (
                self.state["time"][: len(courses)] >= courses["end"] - CUT
            )
        open_lanes = np.flatnonzero(there)
        shifts = np.empty(1, soc_filter.CLOSED_SHIFT)
        for lane in open_lanes.tolist():
            soc_filter.close_shift(self.state[lane], 0, lane, shifts[0])
            self._close(shifts[0])
        self.state["shift"][open_lanes] = -1.0
        self.state["heard"][open_lanes] = 0.0

    def learn_from(self, earlier: "Foresight") -> None:
        """Take up what another one has learned by now, of the same cars; nothing of its shifts."""
        earlier.finish(cut=True)
        earlier.overnight()
        self.lessons.load(earlier.lessons.dump())
        self.state = soc_filter.new_state(len(earlier.state))
        for name in ("c", "cc"):
            self.state[name] = earlier.state[name]
        self.log.grow(len(self.state))

    def take_shifts(self) -> NDArray[np.void]:
        """Return the shifts that have ended since the last call, (n,) CLOSED_SHIFT."""
        taken, self.closed = self.closed, []
        return np.array(taken, soc_filter.CLOSED_SHIFT)

    def dump(self) -> Any:
        """Return the state as plain values."""
        return self.lessons.dump(), self.courses.dump(), self.log.dump(), self.state.tobytes()

    def load(self, state: Any) -> None:
        """Take up a state that `dump` returned, once the cars are known."""
        lessons, courses, log, filters = state
        self.lessons.load(lessons)
        self.courses.load(courses)
        self.log.load(log)
        self.state = np.frombuffer(filters, soc_filter.STATE).copy()
