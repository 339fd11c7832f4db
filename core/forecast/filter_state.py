"""Record types of the SOC filter: the state of a car, its events, the published estimate and the closed shift."""

from math import nan
from typing import Final

import numpy as np
from numpy.typing import NDArray

DEFAULT_QUANTUM: Final = 0.01
"""Quantum of a state of charge whose step has not been observed, the coarsest that cars report. [1]"""
CAPACITY_SD: Final = 0.15
"""Standard deviation of `log_capacity` before any data, from age, temperature and the car's definition of full. [1]"""

SHIFT_CAPACITY_SD: Final = 0.015
"""Standard deviation of `log_capacity` of single shifts about that of their car: a display counts with errors. [1]

Estimated: the energy that a percent of a display stood for in whole shifts of simulated cars varied by 0.8 to 1.8 %
about the mean of the car, without any memory from one shift to the next."""

RUNNING, CLOSED, DRIVER_NAMED = range(3)
"""Kinds of events: totals of the ride or idle period in progress; totals of one that has ended; identity of the driver
from the next running totals on."""

FILTER_STATE: Final = np.dtype(
    [
        ("active", "f8"),  # 1 once the car has sent anything
        ("time", "f8"),  # of the newest event [s]
        ("soc", "f8"),  # state of charge [1]
        ("curve", "f8"),  # of the display, see `socast.core.totals.display_yield`, in this shift [1]
        ("log_consumption", "f8"),  # `a`: log of the used over the predicted energy
        ("log_capacity", "f8"),  # `c`: log of the usable over the nominal capacity
        *((name, "f8") for name in ("p_ss", "p_sa", "p_sc", "p_aa", "p_ac", "p_cc")),  # covariances of (soc, a, c)
        ("compared_predicted", "f8"),  # energy predicted since both energies were compared last [kWh]
        ("compared_used", "f8"),  # energy measured since then [kWh]
        ("fall", "f8"),  # charge used since the last accepted reading [1]
        ("quantum", "f8"),  # of the reported state of charge [1]
        ("reported", "f8"),  # last accepted reading, the reference of the next one [1]
        ("frozen", "f8"),  # 1 while the reading stays constant although the charge must have changed
        ("suspect", "f8"),  # reading that jumped and is not accepted yet, less the estimate, NaN for none [1]
        ("suspect_time", "f8"),  # when it was first reported [s]
        ("jump", "f8"),  # jumps of the reading that were accepted in the shift, less those that were taken back [1]
        ("charging", "f8"),  # 1 while plugged in
        ("plugged", "f8"),  # since when [s]
        # totals of the ride or idle period in progress at the previous event, see `FILTER_EVENT`
        *((f"seen_{name}", "f8") for name in ("predicted", "metered", "meter_time", "time", "ambient", "distance")),
        ("ambient", "f8"),  # newest outside temperature [K]
        ("shift", "f8"),  # ordinal of the shift
        ("begin", "f8"),  # of the shift [s]
        ("begin_soc", "f8"),  # [1]
        ("last_soc", "f8"),  # last reading in the shift [1]
        ("lowest_soc", "f8"),  # lowest reading in the shift [1]
        ("distance", "f8"),  # driven in the shift [m]
        ("ride_distance", "f8"),  # driven in the shift on rides [m]
        ("hours", "f8"),  # awake in the shift [h]
        ("predicted", "f8"),  # energy predicted of the shift since the car departed [kWh]
        ("metered_predicted", "f8"),  # the part of it for which there is a measured energy [kWh]
        ("metered_used", "f8"),  # that measured energy [kWh]
        ("awake_predicted", "f8"),  # energy predicted since it woke, NaN after a gap of `UNSEEN_TIME` [kWh]
        ("car_kind", "f8"),  # kind of car by which it is predicted
        ("warmth", "f8"),  # integral of the outside temperature over `hours` [K h]
        ("level", "f8"),  # of the tables that predict it, as a logarithm
        ("charged", "f8"),  # time of the last charging within the shift, NaN for none [s]
        ("faulty", "f8"),  # last time in the shift with a wrong reading or an unsettled clock, NaN for none [s]
        ("connected", "f8"),  # when the present or last charging began, or the silence in which it did [s]
        ("arrived", "f8"),  # the same of the last charge within the shift that lasted, NaN for none [s]
        ("arrival_soc", "f8"),  # last reading before that charge [1]
        ("unplugged", "f8"),  # when it ended, NaN while it lasts [s]
        ("unplugged_distance", "f8"),  # driven in the shift by then [m]
        ("charged_soc", "f8"),  # last reading before the car departed after it [1]
        ("begin_log_capacity", "f8"),  # `c` at the beginning of the shift
        ("cold_loss", "f8"),  # part of it that the cold of the shift takes [1]
        ("car_capacity_variance", "f8"),  # variance of the part of `c` that lasts, at the beginning of the shift
        ("usual", "f8"),  # expected `a - c` of the shift, before any of its data
        ("usual_variance", "f8"),  # variance of that expectation
        ("level_sd", "f8"),  # standard deviation of the level of the tables, part of that variance, NaN unknown [1]
        ("driver", "f8"),  # code of the driver, -1 while unknown
        ("driver_mean", "f8"),  # mean of the driver's part of `a`
        ("driver_variance", "f8"),  # variance of the driver's part
        ("drivers", "f8"),  # number of drivers in the shift
        ("next_driver", "f8"),  # driver named since the last running totals, -1 for none
        *(("next_driver_mean", "f8"), ("next_driver_variance", "f8")),
    ]
)
"""State of the filter of one car."""

FILTER_EVENT: Final = np.dtype(
    [
        ("kind", "i8"),  # `RUNNING`, `CLOSED` or `DRIVER_NAMED`
        ("lane", "i8"),
        ("time", "f8"),  # [s]
        ("predicted", "f8"),  # energy predicted of the ride or idle period so far [kWh]
        ("warm_up", "f8"),  # energy predicted of the whole warm-up of a shift [kWh]
        ("car_kind", "f8"),  # kind of car by which it is predicted
        ("level", "f8"),  # of the tables that predict it, as a logarithm
        ("level_sd", "f8"),  # relative standard deviation of the energy of the usual mix [1]
        ("cold_loss", "f8"),  # logarithm of the capacity that the battery lacks at the outside temperature [1]
        ("metered", "f8"),  # energy so far by voltage and current [kWh]
        ("meter_time", "f8"),  # time for which that is known [s]
        ("duration", "f8"),  # so far [s]
        ("distance", "f8"),  # so far [m]
        ("riding", "f8"),  # 1 for a ride
        ("ambient", "f8"),  # integral of the outside temperature so far [K s]
        ("ambient_now", "f8"),  # outside temperature at the newest sample [K]
        ("soc", "f8"),  # reported state of charge, NaN for none [1]
        ("quantum", "f8"),  # its quantum, NaN while unknown [1]
        ("since_charge", "f8"),  # time since charging, NaN for never [s]
        ("capacity", "f8"),  # nominal usable capacity [kWh]
        ("curve", "f8"),  # of the display, see `socast.core.totals.display_yield` [1]
        ("unsettled", "f8"),  # 1 where the clock alternates or is not yet understood
        # of `DRIVER_NAMED` only
        ("driver", "f8"),  # code of the driver
        ("driver_mean", "f8"),  # mean of the driver's part of `a`
        ("driver_variance", "f8"),  # variance of the driver's part
    ]
)
"""Input of the filter: totals of a ride or idle period, or the name of a driver."""

_OF_BOTH: Final = [
    (name, "f8")
    for name in (
        *("shift", "begin", "begin_soc", "last_soc", "curve", "distance", "awake_predicted", "level"),
        *("charged", "faulty"),
    )
]
"""Fields of the state that an estimate and a closed shift copy; `faulty` is NaN once the reading has recovered."""
SOC_ESTIMATE: Final = np.dtype(
    [
        ("soc", "f8"),  # published state of charge [1]
        ("variance", "f8"),  # of `soc`
        ("log_factor", "f8"),  # `a - c`
        ("log_factor_variance", "f8"),
        ("covariance", "f8"),  # of `soc` and `log_factor`
        ("usual", "f8"),  # expected `log_factor` of the shift, before any of its data
        ("level_sd", "f8"),  # that of `FILTER_STATE` [1]
        ("departed", "f8"),  # 1 once the car has driven on after the last charge within the shift
        *_OF_BOTH,
        *((name, "f8") for name in ("ambient", "quantum", "arrived", "arrival_soc", "unplugged", "charged_soc")),
    ]
)
"""Output of the filter after each event."""

CLOSED_SHIFT: Final = np.dtype(
    [
        ("event", "i8"),  # index of the event that closed the shift
        ("lane", "i8"),
        ("end", "f8"),  # time of the newest event [s]
        ("driver", "f8"),  # code of the only driver, -1 where unknown or more than one
        *_OF_BOTH,
        *((name, "f8") for name in ("lowest_soc", "ride_distance", "hours", "predicted", "metered_used", "warmth")),
    ]
)
"""Summary of a shift that has ended; `metered_used` is of the whole shift, over that of the capacity. [kWh]"""

LOG_FACTOR_PRIOR: Final = np.dtype([("mean", "f8"), ("variance", "f8")])
"""Normal distribution of `a - c` of a car at the beginning of a shift."""

_INITIALLY_NAN: Final = (
    *("soc", "p_ss", "reported", "suspect", "charged", "faulty", "ambient"),
    *("begin_soc", "last_soc", "lowest_soc"),
    *("connected", "arrived", "arrival_soc", "unplugged", "unplugged_distance", "charged_soc"),
)


def create_filter_state(lanes: int) -> NDArray[np.void]:
    """Return the state of cars that have sent nothing."""
    state = np.zeros(lanes, FILTER_STATE)
    for name in _INITIALLY_NAN:
        state[name] = nan
    state["shift"] = state["driver"] = state["next_driver"] = -1.0
    state["car_capacity_variance"] = CAPACITY_SD**2
    state["p_cc"] = CAPACITY_SD**2 + SHIFT_CAPACITY_SD**2
    state["quantum"] = DEFAULT_QUANTUM
    return state
