"""The forecast engine: run the filters, plans and shifts of all cars, and learn from them.

Everything about a car follows from that car's own events, in their order. Statistics of the fleet are collected through
the day and applied by the daily update (`socast.core.forecast.learning.fleet`). So forecasts do not depend on how
messages are cut into batches, nor on which other cars sent samples a moment earlier.
"""

from bisect import bisect_right
from collections.abc import Callable, Sequence
from heapq import heappop, heappush
from math import inf, nan
from operator import attrgetter
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Floats, Ints, RowsOfLanes, grown, take_lanes
from socast.core.columns import JOULES_PER_KWH, ZERO_CELSIUS
from socast.core.forecast.filter_state import (
    CLOSED,
    CLOSED_SHIFT,
    DRIVER_NAMED,
    FILTER_EVENT,
    FILTER_STATE,
    RUNNING,
    SOC_ESTIMATE,
    create_filter_state,
)
from socast.core.forecast.forecast_rows import (
    NEWEST_FORECAST,
    Rows,
    compute_forecast_rows,
    create_records,
    select_newest,
)
from socast.core.forecast.learning.car_driver import compute_driver_code
from socast.core.forecast.learning.fleet import FleetStatistics, ShiftEnergy
from socast.core.forecast.learning.forecast_errors import ForecastLog, Outcome
from socast.core.forecast.learning.leg_energy import LegEnergyTables
from socast.core.forecast.outlook import compute_charge_between, compute_temperature_weights, find_expected_end
from socast.core.forecast.plan_tracker import CUT_SHORT_MARGIN, DriverNamed, PlanArrival, PlanTracker
from socast.core.forecast.soc_filter import close_shift, filter_events
from socast.core.forecast.weather_forecasts import ForecastArrival, WeatherForecasts
from socast.core.totals.accumulator import Sums, Totals, join_totals
from socast.core.totals.context import RunContext
from socast.core.totals.tables import has_unsettled_clock, model_columns
from socast.core.vehicles.fleet import UNKNOWN, Cars, ReplacedKind

SHORT_SHIFT: Final = 0.5
"""A shorter shift does not update the consumption factors. [h]"""
_NO_FORECAST: Final = np.full(len(NEWEST_FORECAST.names or ()), np.nan).view(NEWEST_FORECAST)[0]


class DueInput(NamedTuple):
    """Hold totals and messages for which forecasts are to be computed.

    Parameters
    ----------
    replaced : Kinds of car that vehicle messages replaced among these messages, and after them.
    """

    sums: Sums
    arrivals: Sequence[PlanArrival] = ()
    drivers: Sequence[DriverNamed] = ()
    forecasts: Sequence[ForecastArrival] = ()
    replaced: Sequence[ReplacedKind] = ()


class KindHistory:
    """Find the kind that a car was of at a place among the messages of a batch."""

    def __init__(self, cars: Cars, replaced: Sequence[ReplacedKind]) -> None:
        self._of_lane = cars.of_lane
        self._replaced: dict[int, list[ReplacedKind]] = {}
        for each in replaced:
            self._replaced.setdefault(each.lane, []).append(each)

    def find(self, lane: int, at: int) -> int:
        """Return the kind of the car of a lane at a place."""
        later = self._replaced.get(lane, ())
        first = bisect_right(later, at, key=attrgetter("at"))
        if first < len(later):
            return later[first].kind
        return int(self._of_lane[lane]) if lane < len(self._of_lane) else UNKNOWN


class ForecastEngine:
    """Run the filters, plans and shifts of every lane, with the statistics of the fleet.

    Attributes
    ----------
    state : (lanes,) FILTER_STATE
    newest : (lanes,) NEWEST_FORECAST
        Newest forecast of each lane, NaN before the first one.
    filter_events : callable
        Function that runs the filters over events; `socast verify` listens here.
    """

    def __init__(self, context: RunContext) -> None:
        self.context, self._cars = context, context.cars
        self.statistics = FleetStatistics(context)
        self.plans, self.weather, self.log = PlanTracker(), WeatherForecasts(), ForecastLog()
        self.state = create_filter_state(0)
        self.filter_events: Callable[..., int] = filter_events
        self.newest = np.zeros(0, NEWEST_FORECAST)
        self.closed: list[NDArray[np.void]] = []

    def process(self, due: DueInput) -> Rows:
        """Process the totals and dispatch messages of a batch; return the forecasts at each of its running rows."""
        sums, kinds = due.sums, KindHistory(self._cars, due.replaced)
        lanes = len(self.context.lanes)
        self._grow(lanes)
        parts = sums.rides, sums.idle_periods, sums.running
        whole = join_totals(parts, sums.running)
        closed = len(sums.rides.lane) + len(sums.idle_periods.lane)
        events, at, order = self._build_events(whole, closed, due.drivers)
        estimates, shifts = np.empty(len(events), SOC_ESTIMATE), np.empty(len(events), CLOSED_SHIFT)
        shifts = shifts[: self.filter_events(events, self.state, self.statistics.prior, estimates, shifts)]
        if closed:
            begin = np.empty(len(events))
            begin[order] = estimates["begin"]
            self.statistics.add_stretches(sums.rides, sums.idle_periods, begin[:closed])
        estimates = estimates.compress(events["kind"] == RUNNING)

        def get_tables(lane: int, at: int) -> LegEnergyTables | None:
            return self.statistics.get_tables(lane, kinds.find(lane, at))

        progress = self.plans.process(sums.running, sums.rides, due.arrivals, estimates, get_tables, lanes)
        self.statistics.charged_soc.add_charges(self.plans.outcomes)
        time, patterns = sums.running.at_last("time"), self.statistics.patterns[sums.running.lane]
        expected_end = find_expected_end(progress, time, estimates["begin"], patterns)
        now = estimates["ambient"], time, expected_end, self.statistics.daily_cycle
        ambient = self.weather.expect_between(sums.running.at, due.forecasts, *now)
        rows = compute_forecast_rows(
            sums.running, self._predict(sums.running), estimates, progress, ambient, self.statistics, self._cars
        )
        self.newest.put(sums.running.lane, select_newest(rows))
        self._evaluate(sums.running, rows, shifts, at, kinds)
        return rows

    def _grow(self, lanes: int) -> None:
        """Make room for a number of lanes."""
        if len(self.state) < lanes:
            self.state = grown(self.state, lanes, create_filter_state(1)[0])
        self.newest = grown(self.newest, lanes, _NO_FORECAST)
        self.log.grow(lanes)
        self.statistics.grow(lanes)

    def get_newest(self, lanes: Ints) -> NDArray[np.void]:
        """Return the newest forecast of some lanes, (n,) NEWEST_FORECAST."""
        return grown(self.newest, len(self.context.lanes), _NO_FORECAST)[lanes]

    def has_sample(self, lane: int) -> bool:
        """Return whether the car of a lane has sent anything."""
        return lane < len(self.state) and bool(self.state["active"][lane])

    def _predict(self, totals: Totals) -> Floats:
        """Return the energy that the model predicts of totals. [kWh]"""
        if not len(totals.lane):
            return np.empty(0)
        model = self.context.model
        return model.predict_energy(model_columns(totals, self.context, model.needs))

    def _build_events(
        self, totals: Totals, closed: int, drivers: Sequence[DriverNamed]
    ) -> tuple[NDArray[np.void], Ints, Ints]:
        """Return the events of the filters in order, the place of each, and its number before; closed totals first."""
        n = len(totals.lane)
        events = np.empty(n + len(drivers), FILTER_EVENT)
        self._fill_totals(totals, events[:n])
        events["kind"][:closed], events["kind"][closed:n] = CLOSED, RUNNING
        self._fill_drivers(drivers, events[n:])
        if n == len(events) and not closed:
            return events, totals.at, np.arange(n)
        at = np.concatenate([totals.at, np.array([d.at for d in drivers], dtype=np.int64)])
        rank = np.repeat([1, 2, 0], [closed, n - closed, len(drivers)])
        order = np.lexsort((rank, at))
        return events.take(order), at[order], order

    def _fill_totals(self, totals: Totals, out: NDArray[np.void]) -> None:
        """Write totals as events."""
        duration, riding = totals.amount("duration"), totals.ride >= 0
        ambient = totals.amount("ambient")
        kind, now = totals.kinds, totals.at_last("ambient")
        mean_ambient = totals.share("ambient", otherwise=now)
        weights = compute_temperature_weights(mean_ambient)
        out["cold_loss"] = self.statistics.factors.expect_cold_loss(mean_ambient - ZERO_CELSIUS)
        out["lane"], out["time"], out["car_kind"] = totals.lane, totals.at_last("time"), kind
        self.statistics.predict_energies(totals, weights, out)
        out["metered"] = totals.amount("energy") / JOULES_PER_KWH
        out["meter_time"], out["duration"] = totals.amount("metered"), duration
        out["riding"], out["distance"] = riding, totals.amount("distance")
        out["ambient"], out["ambient_now"] = ambient, now
        out["soc"], out["quantum"] = totals.at_last("soc"), totals.at_last("soc_step")
        out["curve"], out["unsettled"] = totals.display["curve"], has_unsettled_clock(totals)
        out["since_charge"], out["capacity"] = totals.at_last("since_charge"), self._cars.capacity[kind]
        out["driver"], out["driver_mean"], out["driver_variance"] = -1.0, np.nan, np.nan

    def _fill_drivers(self, drivers: Sequence[DriverNamed], out: NDArray[np.void]) -> None:
        """Write names of drivers as events."""
        out[:] = np.zeros((), FILTER_EVENT)
        for event, named in zip(out, drivers, strict=True):
            code = compute_driver_code(named.driver)
            part = self.statistics.factors.get_driver(code)
            event["kind"], event["lane"], event["driver"] = DRIVER_NAMED, named.lane, code
            event["driver_mean"], event["driver_variance"] = part.mean, part.variance

    def _evaluate(self, running: Totals, rows: Rows, shifts: NDArray[np.void], at: Ints, kinds: "KindHistory") -> None:
        """Record forecasts, and evaluate those whose end has come, in the order of their places.

        `at` is the place of each event in the batch. A step has a place, whether a forecast is due there, and a number.
        """
        steps = [(int(at[shift["event"]]), False, i) for i, shift in enumerate(shifts)]
        time, mean, arrived = rows["time"], rows["raw_end_soc"], rows["arrived"]
        rows_of_lanes = RowsOfLanes(running.lane)

        def add_next(lane: int, first: int) -> None:
            """Add the first row of a lane, from a place on, at which a forecast is due."""
            of_lane = rows_of_lanes.find(lane)
            left = of_lane[np.searchsorted(running.at[of_lane], first) :]
            due = self.log.is_due(lane, time[left], mean[left], arrived[left])
            if due.any():
                row = int(left[due.argmax()])
                heappush(steps, (int(running.at[row]), True, row))

        for lane in np.unique(running.lane[self.log.is_due(running.lane, time, mean, arrived)]).tolist():
            add_next(lane, 0)
        while steps:
            place, of_forecast, i = heappop(steps)
            if not of_forecast:
                lane = int(shifts[i]["lane"])
                self._close_shift(shifts[i], kinds.find(lane, place))
                add_next(lane, place)
            elif self.log.is_due(lane := int(running.lane[i]), time[i], mean[i], arrived[i]):
                outcome = Outcome.read(rows[i])
                at_charge = outcome._replace(soc=float(rows["arrival_soc"][i]))
                self.statistics.add_errors(lane, self.log.evaluate_arrival(lane, float(rows["arrived"][i]), at_charge))
                self.statistics.add_errors(lane, self.log.evaluate_until(lane, float(time[i]), outcome))
                self.log.record(lane, *create_records(rows[i]))
                add_next(lane, place + 1)

    def _close_shift(self, shift: NDArray[np.void], kind: int) -> None:
        """Learn from a shift of a car of a kind that has ended."""
        lane = int(shift["lane"])
        self.closed.append(shift.copy())
        errors = self.log.evaluate_shift(lane, Outcome.read(shift))
        if shift["end"] < shift["begin"]:  # its clock leapt back
            self.statistics.distrust(lane)
            return
        self.statistics.add_errors(lane, errors)
        capacity = float(self._cars.capacity[kind])
        begin_soc, last_soc, curve = (float(shift[name]) for name in ("begin_soc", "last_soc", "curve"))
        used = compute_charge_between(begin_soc, last_soc, curve) * capacity
        if np.isfinite(shift["faulty"]):  # by voltage and current alone
            used = float(shift["metered_used"])
        if shift["hours"] > 0.0 and np.isnan(shift["charged"]):
            energy = ShiftEnergy(
                lane=lane,
                driver=int(shift["driver"]) if shift["driver"] >= 0.0 else None,
                predicted_kwh=float(shift["predicted"]),
                used_kwh=used if shift["hours"] >= SHORT_SHIFT else nan,
                capacity_kwh=capacity,
                model=self._cars.name(kind) or "",
                level=float(shift["level"]),
                ambient_c=float(shift["warmth"] / shift["hours"]) - ZERO_CELSIUS,
                hours=(float(shift["end"]) - float(shift["begin"])) / 3600.0,
            )
            self.statistics.add_shift(energy)

    def apply_daily_update(self, midnight: float = -inf) -> None:
        """Let the statistics of the day take effect, and forget the weather forecasts for times before midnight [s]."""
        self.statistics.apply_daily_update()
        self.weather.forget_before(midnight)
        self.plans.renew_energies(midnight, self.statistics.get_tables)

    def finish(self, *, interrupted: bool = False) -> None:
        """Close every shift in progress at the end of the stream; if it interrupts them, those over by plan."""
        is_open = self.state["shift"] >= 0.0
        if interrupted:
            progress = self.plans.progress[: len(is_open)]
            is_open[len(progress) :] = False
            is_open[: len(progress)] &= (progress["planned"] == 1.0) & (
                self.state["time"][: len(progress)] >= progress["end"] - CUT_SHORT_MARGIN
            )
        open_lanes = np.flatnonzero(is_open)
        shifts = np.empty(1, CLOSED_SHIFT)
        for lane in open_lanes.tolist():
            close_shift(self.state[lane], 0, lane, shifts[0])
            self._close_shift(shifts[0], int(self._cars.of_lane[lane]))
        self.state["shift"][open_lanes] = -1.0
        self.state["active"][open_lanes] = 0.0

    def learn_from(self, earlier: "ForecastEngine") -> None:
        """Copy what another engine has learned of the same cars, but none of its shifts."""
        earlier.finish(interrupted=True)
        earlier.apply_daily_update()
        self.statistics.load(earlier.statistics.dump())
        self.state = create_filter_state(len(earlier.state))
        for name in ("log_capacity", "begin_log_capacity", "cold_loss", "car_capacity_variance", "p_cc"):
            self.state[name] = earlier.state[name]
        self.log.grow(len(self.state))

    def take_shifts(self) -> NDArray[np.void]:
        """Return the shifts that have ended since the last call, (n,) CLOSED_SHIFT."""
        taken, self.closed = self.closed, []
        return np.array(taken, CLOSED_SHIFT)

    def keep(self, lanes: Ints) -> None:
        """Keep the state of some lanes only, in their order; call it after the daily update."""
        self.state, self.newest = take_lanes(self.state, lanes), take_lanes(self.newest, lanes)
        for part in (self.statistics, self.plans, self.log):
            part.keep(lanes)

    def dump(self) -> Any:
        """Return the state as plain values."""
        parts = (each.dump() for each in (self.statistics, self.plans, self.weather, self.log))
        return *parts, self.newest.tobytes(), self.state.tobytes()

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned, once the cars are known."""
        statistics, plans, weather, log, newest, filters = state
        self.statistics.load(statistics)
        self.plans.load(plans)
        self.weather.load(weather)
        self.log.load(log)
        self.newest = np.frombuffer(newest, NEWEST_FORECAST).copy()
        self.state = np.frombuffer(filters, FILTER_STATE).copy()
