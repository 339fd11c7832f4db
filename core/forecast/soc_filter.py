"""A Kalman filter per car of the state of charge, the day's consumption factor and the usable capacity.

The state is (s, a, c). `s` is the state of charge [1]. `a` (`log_consumption`) is the logarithm of the energy that this
car uses today with this driver over the predicted energy. `c` (`log_capacity`) is the logarithm of its usable over its
nominal capacity C. Over a stretch with the predicted energy E the charge falls by exp(a - c) E / C. Where voltage and
current are measured, it falls by the measured energy over exp(c) C, and the two energies together measure `a`. Where
the display is a curve, C is the energy that it holds at the present charge.

A meter has a constant gain error, which shifts `a` and `c` alike. Neither the fall of the charge nor the two energies
reveal it, so `a` and `c` are relative to this car's meter. The uncertainty of the gain applies where a capacity is
published in kWh, and does not shrink with the time of measurement.

The covariance follows the slopes of these equations at the point where the shift began, not at the current estimate. So
it depends on when something is measured, and not on the reported values: fewer measurements never give a smaller
variance.

`socast.core.forecast.soc_reading` has the treatment of reported values. Without an accepted reading the prediction
continues alone and its variance grows. After charging and after a long silence the filter starts anew at the reported
value.

References
----------
Kalman, Journal of Basic Engineering 82 (1960) 35, DOI 10.1115/1.3662552; extended, but for its covariance, as in
Jazwinski, Stochastic Processes and Filtering Theory, Academic Press 1970, section 8.3.
"""

from math import exp, isnan, nan
from typing import Any, Final

from socast.core.compiled_cache import njit, watch_sources
from socast.core.forecast import filter_state, kalman_update, soc_reading
from socast.core.forecast.filter_state import (
    CAPACITY_SD,
    CLOSED,
    DEFAULT_QUANTUM,
    DRIVER_NAMED,
    RUNNING,
    SHIFT_CAPACITY_SD,
)
from socast.core.forecast.kalman_update import (
    LARGEST_LOG_CAPACITY,
    LARGEST_LOG_CONSUMPTION,
    apply_named_driver,
    clip,
    update_state,
)
from socast.core.forecast.learning import consumption_terms
from socast.core.forecast.learning.consumption_terms import WARM_UP_DECAY
from socast.core.forecast.soc_reading import (
    LEAST_FAULT,
    compute_jump_variance,
    compute_published_soc,
    discard_soc,
    update_with_reading,
)

FILTER_RESET_SILENCE: Final = 600.0
"""Silence after which the filter discards the charge and starts at the next reading. [s]

It is a property of the filter, and independent of the operator's setting `gap_time`, at which rides are cut."""
SHIFT_GAP: Final = 7200.0
"""A longer silence ends a shift. [s]"""
ENERGY_SD: Final = 0.15
"""Standard deviation of the energy of a stretch that takes 1 kWh, over the predicted; it grows with the root. [1]"""
WARM_UP_TIME: Final = 1200.0
"""Time after waking or charging in which a car warms up, and its consumption is less representative. [s]"""
WARM_UP_VARIANCE_FACTOR: Final = 4.0
"""Factor of the variance of the energy during the warm-up. [1]"""
METER_GAIN_SD: Final = 0.015
"""Standard deviation of the constant gain of a car's meter: 1 % each of voltage and of current. [1]"""
COMPARED_ENERGY: Final = 0.3
"""Predicted energy of a stretch from which its measured energy is compared with it. [kWh]

A shorter stretch may have a predicted energy below 0, as while a car brakes. Without such stretches, the others would
appear to take less than predicted."""
METER_SAMPLING_SD: Final = 0.05
"""Standard deviation of 1 kWh as measured by samples every few seconds; it grows with the root. [1]"""
DRIVER_SD: Final = 0.06
"""Standard deviation of the consumption of drivers about their mean. [1]"""
CONSUMPTION_WANDER: Final = 0.05
"""Standard deviation of the change of `a` in an hour awake. [1]"""
RECOVERY_TIME: Final = 1800.0
"""Time after a fault of the display from which its reading is an outcome again. [s]"""
UNSEEN_TIME: Final = 120.0
"""Time without telemetry in which a car may have driven, so that what it has done of its plan is unknown. [s]"""
UNMODELLED_POWER: Final = 5.0
"""Standard deviation of the power of a car without a prediction and without a meter. [kW]"""
CAPACITY_AGEING: Final = 0.005
"""Standard deviation of the lasting change of `c` from shift to shift, by age and season. [1]"""
BEYOND_MARGIN: Final = 0.1
"""Furthest that the estimate of the charge may lie below empty or above full. [1]

A reading corrects an estimate that is a little beyond. A prediction that continues while the display is frozen must not
lead to -82 %."""
LARGEST_VARIANCE: Final = 0.25
"""Largest variance of a quantity from 0 to 1; an estimate with a larger one knows nothing."""
LEAST_METERED: Final = 0.9
"""Share of the predicted energy of a shift from which its measured energy tells what the shift has used. [1]"""
SHORTEST_CHARGE: Final = 60.0
"""A shorter charging is ignored. [s]"""
DEPARTURE_DISTANCE: Final = 300.0
"""Distance from which the consumption of a shift counts, and by which a car departs after a charge. [m]"""
LEAST_RISE: Final = 0.03
"""Rise of the reading over a silence from which the car has charged meanwhile. [1]"""


@njit(cache=True)
def filter_events(events: Any, state: Any, prior: Any, estimates: Any, shifts: Any) -> int:
    """Run the filters over events in their order."""
    closed = 0
    for i in range(events.shape[0]):
        event = events[i]
        car = state[event.lane]
        if event.kind == DRIVER_NAMED:
            car.next_driver = event.driver
            car.next_driver_mean, car.next_driver_variance = event.driver_mean, event.driver_variance
        else:
            if car.active == 0.0 or event.time - car.time > SHIFT_GAP:
                if car.shift >= 0.0:
                    close_shift(car, i, event.lane, shifts[closed])
                    closed += 1
                open_shift(car, event, prior[event.lane])
            if event.kind == RUNNING:  # closed totals may belong to the shift before
                apply_named_driver(car, CONSUMPTION_WANDER**2 * max(car.time - car.begin, 0.0) / 3600.0)
            quantum = DEFAULT_QUANTUM if isnan(event.quantum) else event.quantum
            car.quantum = min(car.quantum, quantum)
            update_with_totals(car, event)
            car.quantum = quantum
            if event.unsettled:
                car.faulty, car.awake_predicted = event.time, nan
        write_estimate(car, estimates[i])
    return closed


@njit(cache=False)
def open_shift(state: Any, event: Any, prior: Any) -> None:
    """Begin a shift, with an unknown driver and the prior distribution of `a - c`."""
    state.shift += 1.0
    state.begin, state.ambient = event.time, event.ambient_now
    state.distance = state.ride_distance = state.hours = state.warmth = 0.0
    state.predicted = state.awake_predicted = state.compared_predicted = state.compared_used = state.jump = 0.0
    state.metered_predicted = state.metered_used = 0.0
    state.begin_soc = state.last_soc = state.lowest_soc = state.charged = state.faulty = nan
    state.connected = state.arrived = state.arrival_soc = nan
    state.unplugged = state.unplugged_distance = state.charged_soc = nan
    state.driver, state.driver_mean, state.driver_variance, state.drivers = -1.0, 0.0, DRIVER_SD**2, 0.0
    keep_capacity(state)
    state.begin_log_capacity, state.curve = state.log_capacity, event.curve
    state.level, state.level_sd, state.car_kind = event.level, nan, event.car_kind
    state.usual, state.usual_variance = prior.mean, prior.variance
    state.log_consumption, state.p_aa = state.log_capacity + state.usual, state.p_cc + state.usual_variance
    state.p_sa, state.p_ac = state.p_sc, state.p_cc


@njit(cache=False)
def keep_capacity(state: Any) -> None:
    """Keep the car's share of what the shift before has revealed of `c`; the rest and its cold were of that shift."""
    share = state.car_capacity_variance / (state.car_capacity_variance + SHIFT_CAPACITY_SD**2)
    revealed = state.car_capacity_variance + SHIFT_CAPACITY_SD**2 - state.p_cc
    of_shift = state.log_capacity - state.begin_log_capacity
    state.log_capacity = state.begin_log_capacity + state.cold_loss + share * of_shift
    state.cold_loss = 0.0
    lasting = state.car_capacity_variance - share**2 * revealed + CAPACITY_AGEING**2
    state.car_capacity_variance = min(lasting, CAPACITY_SD**2)
    state.p_cc = state.car_capacity_variance + SHIFT_CAPACITY_SD**2


@njit(cache=False)
def follow_level(state: Any, event: Any) -> None:
    """Express what the shift has used by the tables of an event, if a daily update has replaced those before."""
    if event.level != state.level and not isnan(event.level):
        if not isnan(state.level) and event.car_kind == state.car_kind:  # not of another vehicle model
            change = event.level - state.level
            state.log_consumption = clip(state.log_consumption - change, LARGEST_LOG_CONSUMPTION)
            state.predicted *= exp(change)
            state.metered_predicted *= exp(change)
            state.awake_predicted *= exp(change)
            state.compared_predicted *= exp(change)
            if event.duration > 0.0:  # of the ride so far, as the new tables predict it
                state.seen_predicted = event.predicted * min(state.seen_time / event.duration, 1.0)
        state.level = event.level
    state.car_kind = event.car_kind


@njit(cache=True)
def close_shift(state: Any, event: int, lane: int, row: Any) -> None:
    """Write the summary of a shift that has ended; `row` is a CLOSED_SHIFT."""
    row.event, row.lane, row.shift, row.begin, row.end = event, lane, state.shift, state.begin, state.time
    row.begin_soc, row.last_soc, row.lowest_soc = state.begin_soc, state.last_soc, state.lowest_soc
    row.ride_distance, row.distance = state.ride_distance, state.distance
    row.curve = state.curve
    row.hours, row.predicted, row.warmth = state.hours, state.predicted, state.warmth
    row.awake_predicted, row.level = state.awake_predicted, state.level
    is_metered = state.metered_predicted > max(LEAST_METERED * state.predicted, 0.0)
    scale = state.predicted / state.metered_predicted if is_metered else nan
    row.metered_used = scale * state.metered_used * exp(-state.log_capacity)
    row.charged, row.faulty = state.charged, find_lasting_fault(state)
    row.driver = state.driver if state.drivers == 1.0 else -1.0  # two drivers share the consumption


@njit(cache=False)
def update_with_totals(state: Any, event: Any) -> None:
    """Update the state of a car by the totals of a ride or idle period, and by its reading."""
    passed = event.time - state.time if state.active == 1.0 else 0.0
    follow_level(state, event)
    meter_time, duration = event.meter_time - state.seen_meter_time, event.duration - state.seen_time
    predicted, metered = event.predicted - state.seen_predicted, event.metered - state.seen_metered
    warmth, distance = event.ambient - state.seen_ambient, event.distance - state.seen_distance
    used = metered * duration / meter_time if meter_time > max(0.5 * duration, 0.0) else nan
    remember_totals(state, event)
    if isnan(state.level_sd) and not isnan(event.level_sd):
        state.level_sd = event.level_sd  # what its temperature adds to the prior of a shift
        state.cold_loss = clip(event.cold_loss, LARGEST_LOG_CAPACITY)
        state.usual += state.cold_loss
        state.log_capacity -= state.cold_loss
        state.begin_log_capacity -= state.cold_loss
        state.usual_variance += event.level_sd**2
        state.p_aa += event.level_sd**2
    if duration > 0.0:
        awake = event.time - state.begin
        predicted += event.warm_up * (
            exp(-max(awake - duration, 0.0) / WARM_UP_DECAY) - exp(-max(awake, 0.0) / WARM_UP_DECAY)
        )
        state.ambient = warmth / duration
        state.awake_predicted += 0.0 if isnan(predicted) else predicted
        if passed - duration > UNSEEN_TIME:
            state.awake_predicted = nan
        if state.distance > DEPARTURE_DISTANCE:
            state.hours += duration / 3600.0
            state.warmth += warmth / 3600.0
            add_energies(state, predicted, used)
        state.distance += distance
        state.ride_distance += event.riding * distance
    silent = passed - max(duration, 0.0) > FILTER_RESET_SILENCE
    was_charging = state.charging
    charging = update_charging(state, event, passed)
    update_charge_stop(state, event, was_charging, silent, passed)
    if silent or charging:
        discard_soc(state)
        state.compared_predicted = state.compared_used = 0.0
    elif not isnan(state.soc):
        warming = event.time - state.begin < WARM_UP_TIME or event.since_charge < WARM_UP_TIME
        noise = ENERGY_SD**2 * (WARM_UP_VARIANCE_FACTOR if warming else 1.0)
        capacity = event.capacity * (1.0 + state.curve * (2.0 * state.soc - 1.0))
        predict_state(state, predicted, used, duration, capacity, noise)
    update_with_reading(state, event)
    if state.soc < -BEYOND_MARGIN or state.soc > 1.0 + BEYOND_MARGIN:  # never NaN
        state.soc = min(max(state.soc, -BEYOND_MARGIN), 1.0 + BEYOND_MARGIN)
    if state.p_ss > LARGEST_VARIANCE:
        discard_soc(state)
    if state.charging == 0.0 and isnan(state.suspect) and not isnan(state.reported):
        record_shift_soc(state)


@njit(cache=False)
def add_energies(state: Any, predicted: float, used: float) -> None:
    """Add the energies of a stretch to those of the shift, NaN where unknown. [kWh]"""
    state.predicted += 0.0 if isnan(predicted) else predicted
    if not isnan(predicted + used):
        state.metered_predicted += predicted
        state.metered_used += used


@njit(cache=False)
def remember_totals(state: Any, event: Any) -> None:
    """Remember the totals of an event, from which the next event's changes are counted."""
    if event.kind == CLOSED:
        state.seen_predicted = state.seen_metered = state.seen_meter_time = 0.0
        state.seen_time = state.seen_ambient = state.seen_distance = 0.0
    else:
        # the energy of a ride's beginning is used once the ride has lasted
        state.seen_predicted = 0.0 if isnan(event.predicted) or event.duration <= 0.0 else event.predicted
        state.seen_metered, state.seen_meter_time = event.metered, event.meter_time
        state.seen_time, state.seen_ambient, state.seen_distance = event.duration, event.ambient, event.distance


@njit(cache=False)
def update_charging(state: Any, event: Any, passed: float) -> bool:
    """Update when the car was active, plugged in and charged; return whether it charges. `passed` is in seconds."""
    charging = event.since_charge < passed or (event.since_charge == 0.0 and passed == 0.0 and state.charging == 1.0)
    state.active, state.time = 1.0, event.time
    if charging and state.charging == 0.0:
        state.plugged = event.time
    state.charging = 1.0 if charging else 0.0
    if charging and state.distance > DEPARTURE_DISTANCE and event.time - state.plugged >= SHORTEST_CHARGE:
        state.charged = event.time
    return bool(charging)


@njit(cache=False)
def update_charge_stop(state: Any, event: Any, was_charging: float, silent: bool, passed: float) -> None:
    """Update when the car came to charge and left, before the reading of an event applies.

    A charge is one from the first report that the car charges until it has driven on, however often the report is
    interrupted. Of a car that is silent while it charges, the charge begins when it falls silent, and is known by a
    reading that has risen.
    """
    departed = state.distance - state.unplugged_distance > DEPARTURE_DISTANCE
    before = event.time - passed if silent else event.time
    charged = event.time - event.since_charge  # the last time, NaN for never
    if state.charging == 1.0 and was_charging == 0.0 and (isnan(state.unplugged) or departed):
        state.connected = before
    if state.charging == 1.0 or was_charging == 1.0:
        confirm_charge(state, charged)
    if state.charging == 0.0 and was_charging == 1.0:
        end_charge(state, event.time)
    if state.charging == 0.0 and silent and event.soc - state.last_soc > LEAST_RISE:
        state.connected = before
        confirm_charge(state, event.time)
        end_charge(state, event.time)
    if not isnan(state.unplugged) and not departed and not isnan(event.soc):
        state.charged_soc = event.soc


@njit(cache=False)
def confirm_charge(state: Any, time: float) -> None:
    """Record the present charge once it has lasted; an interrupted one continues."""
    if state.distance > DEPARTURE_DISTANCE and time - state.connected >= SHORTEST_CHARGE:
        if state.arrived != state.connected:
            state.arrived, state.arrival_soc, state.charged_soc = state.connected, state.last_soc, nan
        state.unplugged = state.unplugged_distance = nan


@njit(cache=False)
def end_charge(state: Any, time: float) -> None:
    """Record the end of the present charge, if it has lasted."""
    if state.arrived == state.connected:
        state.unplugged, state.unplugged_distance = time, state.distance


@njit(cache=False)
def predict_state(
    state: Any, predicted: float, used: float, duration: float, capacity: float, energy_variance: float
) -> None:
    """Predict the state at the end of a stretch: the charge falls by the measured or by the predicted energy.

    Units: predicted [kWh] and used [kWh], NaN where unknown; capacity [kWh]; energy_variance [kWh] of a stretch that
    takes 1 kWh, to which it is proportional.
    """
    if isnan(capacity) or duration <= 0.0:
        return
    state.p_aa += CONSUMPTION_WANDER**2 * duration / 3600.0
    if isnan(predicted) and isnan(used):
        slope_c = UNMODELLED_POWER * duration / 3600.0 / capacity
        state.fall += slope_c
        state.p_ss += slope_c**2
        return
    if isnan(used):
        state.soc -= exp(state.log_consumption - state.log_capacity) * predicted / capacity
        slope_c = exp(state.usual) * predicted / capacity
        slope_a, noise = -slope_c, energy_variance * abs(predicted) / capacity**2
    else:
        if not isnan(predicted):
            state.compared_predicted += predicted
            state.compared_used += used
        if state.compared_predicted >= COMPARED_ENERGY:
            update_with_meter(state, energy_variance + METER_SAMPLING_SD**2)
        state.soc -= used / (capacity * exp(state.log_capacity))
        slope_c = used / (capacity * exp(state.begin_log_capacity))
        slope_a, noise = 0.0, METER_SAMPLING_SD**2 * abs(used) / capacity**2
    state.fall += slope_c
    state.p_ss += (
        slope_a**2 * state.p_aa
        + slope_c**2 * state.p_cc
        + 2.0 * (slope_a * state.p_sa + slope_c * state.p_sc + slope_a * slope_c * state.p_ac)
        + noise
    )
    state.p_sa += slope_a * state.p_aa + slope_c * state.p_ac
    state.p_sc += slope_a * state.p_ac + slope_c * state.p_cc


@njit(cache=False)
def update_with_meter(state: Any, variance: float) -> None:
    """Update `a` by the measured energy of a stretch, with the variance of its residual over its energy. [kWh]"""
    predicted = state.compared_predicted
    slope = exp(state.begin_log_capacity + state.usual) * predicted
    total = slope**2 * state.p_aa + variance * predicted
    residual = state.compared_used - exp(state.log_consumption) * predicted
    state.compared_predicted = state.compared_used = 0.0
    update_state(state, residual, slope * state.p_sa, slope * state.p_aa, slope * state.p_ac, total)


@njit(cache=False)
def record_shift_soc(state: Any) -> None:
    """Record the accepted reading as last of the shift, and where it applies as first or lowest."""
    state.last_soc = state.reported
    if isnan(state.begin_soc) or state.distance <= DEPARTURE_DISTANCE:
        state.begin_soc = state.lowest_soc = state.reported
    state.lowest_soc = min(state.lowest_soc, state.reported)


@njit(cache=False)
def find_lasting_fault(state: Any) -> float:
    """Return when the reading was faulty last in the shift, NaN if it has recovered since without a lasting jump."""
    recovered = abs(state.jump) < LEAST_FAULT and state.time - state.faulty > RECOVERY_TIME
    return nan if recovered else float(state.faulty)


@njit(cache=False)
def write_estimate(state: Any, out: Any) -> None:
    """Write the estimate of a car, with a charge from empty to full; `out` is a SOC_ESTIMATE."""
    soc = compute_published_soc(state, state.quantum)
    out.soc = soc if isnan(soc) else min(max(soc, 0.0), 1.0)
    out.variance = state.p_ss + compute_jump_variance(state)
    out.log_factor = state.log_consumption - state.log_capacity
    out.log_factor_variance = state.p_aa + state.p_cc - 2.0 * state.p_ac
    out.covariance = state.p_sa - state.p_sc
    out.curve = state.curve
    out.ambient, out.shift, out.quantum = state.ambient, state.shift, state.quantum
    out.charged, out.faulty, out.last_soc = state.charged, find_lasting_fault(state), state.last_soc
    out.awake_predicted, out.level = state.awake_predicted, state.level
    out.begin, out.begin_soc, out.distance = state.begin, state.begin_soc, state.distance
    lasting = state.level_sd**2 / state.usual_variance if state.level_sd > 0.0 else 0.0  # what no hours change
    out.usual = state.usual + lasting * (out.log_factor - state.usual)
    out.arrived, out.arrival_soc, out.charged_soc = state.arrived, state.arrival_soc, state.charged_soc
    out.unplugged, out.level_sd = state.unplugged, state.level_sd
    out.departed = 1.0 if state.distance - state.unplugged_distance > DEPARTURE_DISTANCE else 0.0


watch_sources(filter_events, consumption_terms, filter_state, kalman_update, soc_reading)
watch_sources(close_shift, consumption_terms, filter_state, kalman_update, soc_reading)
