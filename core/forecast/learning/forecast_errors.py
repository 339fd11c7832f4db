"""Evaluate forecasts against the charge at the end of their shift, and learn from the errors.

The log keeps one forecast of each car every ten minutes. When the shift has ended, as planned or in silence, the errors
over the forecasts' own standard deviations go to `socast.core.forecast.conformal`. A forecast of the charge at the next
planned charge is evaluated when the car comes to charge. A forecast without a planned charge is not evaluated if the
car charged between it and the end, as no plan announced it. Nor is one with a frozen, absent or jumping reading in
between, because the reading then is no outcome; nor is a forecast below an empty battery: the car stops there, and the
energy that it would have used beyond is unknown. Such a forecast is dropped whatever the outcome, because keeping only
the wrong ones would keep errors of one sign.
"""

from math import nan
from struct import Struct
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Floats, Ints, grown, take_keys, take_lanes
from socast.core.forecast.conformal import OVER_CHARGE, TO_CHARGE

RECORD_PERIOD: Final = 600.0
"""Time between two recorded forecasts of a car. [s]"""
LAST_RECORD: Final = 30.0
"""Time before the shift's end at which the last forecast is recorded. [s]"""


class ForecastRecord(NamedTuple):
    """Hold a forecast of the charge at the end of a shift, or at the next planned charge.

    Parameters
    ----------
    time : When it was made. [s]
    end : The end of the shift that it is for; infinite with `TO_CHARGE`. [s]
    ahead_km : Distance that the energy ahead would usually drive. [km]
    ambient_c : Outside temperature. [°C]
    mean, sd : Forecast charge and its standard deviation. [1]
    lower, upper : Bounds of the published charge, NaN without an interval. [1]
    driving_kwh, waiting_kwh, way_home_kwh : Energy of `PLAN_PARTS` until then, NaN without a plan and with
        `OVER_CHARGE`. [kWh]
    predicted, level : Energy predicted since the car woke [kWh], and the level of `LegEnergyTables` [1].
    """

    time: float
    end: float
    basis: int
    ahead_km: float
    ambient_c: float
    mean: float
    sd: float
    lower: float = nan
    upper: float = nan
    driving_kwh: float = nan
    waiting_kwh: float = nan
    way_home_kwh: float = nan
    predicted: float = nan
    level: float = nan


FORECAST_RECORDS: Final = np.dtype([(name, "f8") for name in ForecastRecord._fields])
"""Recorded forecasts as an array."""
_PACKED: Final = Struct(f"{len(ForecastRecord._fields)}d")
LANE_TIMES: Final = np.dtype(
    [
        ("next", "f8"),  # time of the next record [s]
        ("ends", "f8"),  # first end of a recorded forecast [s]
        ("before_charge", "f8"),  # time of the first record with `TO_CHARGE` [s]
    ]
)
"""When a lane's forecasts are recorded and evaluated."""
_NO_RECORDS: Final = np.array((0.0, np.inf, np.inf), LANE_TIMES)[()]


class Outcome(NamedTuple):
    """Hold what became of the forecasts of a shift.

    Parameters
    ----------
    soc : Charge as reported last. [1]
    charged, faulty : When the car charged last, and when its reading was faulty last, NaN for never. [s]
    predicted, level : The same as in `ForecastRecord`.
    """

    soc: float
    charged: float = nan
    faulty: float = nan
    predicted: float = nan
    level: float = nan

    @classmethod
    def read(cls, record: NDArray[np.void]) -> "Outcome":
        """Return the outcome at a FORECAST_ROW or a CLOSED_SHIFT."""
        return cls(*(float(record[name]) for name in ("last_soc", "charged", "faulty", "awake_predicted", "level")))


class ShiftErrors(NamedTuple):
    """Hold what became of the m forecasts of one shift with the same basis.

    Parameters
    ----------
    records : (m,) FORECAST_RECORDS.
    scores : Standardised errors, NaN of those without an outcome, (m,) float. [1]
    done : Energy of what was done until the end, by the tables, NaN where unknown, (m,) float. [kWh]
    outcomes : Numbers of forecasts with the outcome below, inside and above the published interval, (3,) int.
    """

    records: NDArray[np.void]
    scores: Floats
    done: Floats
    outcomes: Ints

    @property
    def basis(self) -> int:
        """Basis of the forecasts."""
        return int(self.records["basis"][0])

    def dump(self) -> Any:
        """Return the errors as plain values."""
        return tuple(each.tobytes() for each in self)

    @classmethod
    def load(cls, state: Any) -> "ShiftErrors":
        """Return the errors that `dump` returned; raise ValueError where their numbers do not fit."""
        records, scores, done, outcomes = state
        rest = np.frombuffer(scores), np.frombuffer(done), np.frombuffer(outcomes, np.int64)
        known = cls(np.frombuffer(records, FORECAST_RECORDS), *rest)
        if not len(known.records) == len(known.scores) == len(known.done) > 0:
            raise ValueError("scores or energies of another number than the forecasts")
        return known


class ForecastLog:
    """Record forecasts of the shifts in progress until their end."""

    def __init__(self) -> None:
        self._records: dict[int, bytearray] = {}  # packed `ForecastRecord`s of each lane
        self._times = np.zeros(0, LANE_TIMES)

    def grow(self, lanes: int) -> None:
        """Make room for a number of lanes."""
        self._times = grown(self._times, lanes, _NO_RECORDS)

    def is_due(self, lane: Any, time: Any, mean: Any = 0.0, arrived: Any = nan) -> Any:
        """Return where a forecast is to be recorded, or a recorded one has come to its end.

        Units: mean [1], NaN without a forecast; arrived [s] when the car came to charge last, NaN for never.
        """
        ended = (time >= self._times["ends"][lane]) | (arrived >= self._times["before_charge"][lane])
        return ((time >= self._times["next"][lane]) & np.isfinite(mean)) | ended

    def record(self, lane: int, forecast: ForecastRecord, to_charge: ForecastRecord | None = None) -> None:
        """Record a forecast, unless the last record is more recent than `RECORD_PERIOD`."""
        if forecast.time >= self._times["next"][lane] and np.isfinite(forecast.mean):
            records = self._records.setdefault(lane, bytearray())
            records.extend(_PACKED.pack(*forecast))
            if to_charge is not None:
                records.extend(_PACKED.pack(*to_charge))
                self._times["before_charge"][lane] = min(self._times["before_charge"][lane], to_charge.time)
            last, following = forecast.end - LAST_RECORD, forecast.time + RECORD_PERIOD
            self._times["next"][lane] = min(following, last) if last > forecast.time else following
            self._times["ends"][lane] = min(self._times["ends"][lane], forecast.end)

    def evaluate_arrival(self, lane: int, arrived: float, outcome: Outcome) -> list[ShiftErrors]:
        """Return the errors of a lane's forecasts for the charge that a car came to, and drop them from the log.

        Units: arrived [s], NaN for never.
        """
        if not arrived >= self._times["before_charge"][lane]:
            return []
        records = self.get_records(lane)
        due = (records["basis"] == TO_CHARGE) & (records["time"] <= arrived)
        return self._evaluate(lane, records, due, outcome._replace(charged=nan))

    def evaluate_until(self, lane: int, time: float, outcome: Outcome) -> list[ShiftErrors]:
        """Return the errors of a lane's forecasts for ends up to a time, and drop them from the log."""
        if not time >= self._times["ends"][lane]:
            return []
        records = self.get_records(lane)
        return self._evaluate(lane, records, records["end"] <= time, outcome)

    def _evaluate(
        self, lane: int, records: NDArray[np.void], due: NDArray[np.bool_], outcome: Outcome
    ) -> list[ShiftErrors]:
        """Return the errors of those records of a lane that are due, and keep the others."""
        left = records[~due]
        self._records[lane] = bytearray(left.tobytes())
        self._times["ends"][lane] = left["end"].min(initial=np.inf)
        self._times["before_charge"][lane] = left["time"][left["basis"] == TO_CHARGE].min(initial=np.inf)
        return compute_shift_errors(records[due], outcome)

    def evaluate_shift(self, lane: int, outcome: Outcome) -> list[ShiftErrors]:
        """Return the errors of all forecasts of a shift that is over."""
        records = self.get_records(lane)
        self._records.pop(lane, None)
        self._times[lane] = _NO_RECORDS
        return compute_shift_errors(records[records["basis"] != TO_CHARGE], outcome)

    def keep(self, lanes: Ints) -> None:
        """Keep the state of some lanes only, in their order."""
        self._records = take_keys(self._records, lanes)
        self._times = take_lanes(self._times, lanes)

    def get_records(self, lane: int) -> NDArray[np.void]:
        """Return the recorded forecasts of a lane, (n,) FORECAST_RECORDS."""
        return np.frombuffer(bytes(self._records.get(lane, b"")), FORECAST_RECORDS)

    def dump(self) -> Any:
        """Return the state as plain values."""
        return list(self._records.items()), *(self._times[name].tobytes() for name in LANE_TIMES.names or ())

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned."""
        records, *times = state
        self._records = {int(lane): bytearray(packed) for lane, packed in records}
        self._times = np.zeros(len(times[0]) // 8, LANE_TIMES)
        for name, packed in zip(LANE_TIMES.names or (), times, strict=True):
            self._times[name] = np.frombuffer(packed)


def compute_shift_errors(records: NDArray[np.void], outcome: Outcome) -> list[ShiftErrors]:
    """Return the errors of forecasts by basis, without those before a charging or a fault, or below an empty battery.

    What was done of a plan is known nevertheless, unless the car charged unplanned.
    """
    out = []
    for basis in np.unique(records["basis"]):
        of_basis = records[records["basis"] == basis]
        last = outcome.faulty if basis == OVER_CHARGE else np.fmax(outcome.charged, outcome.faulty)
        known = ~(last >= of_basis["time"]) & (of_basis["mean"] >= 0.0) & np.isfinite(outcome.soc)
        scores = np.where(known, (outcome.soc - of_basis["mean"]) / of_basis["sd"], nan)
        done = outcome.predicted * np.exp(of_basis["level"] - outcome.level) - of_basis["predicted"]
        done[outcome.charged >= of_basis["time"]] = nan
        counts = count_outcomes(of_basis["lower"][known], of_basis["upper"][known], outcome.soc)
        out.append(ShiftErrors(of_basis, scores, done, counts))
    return out


def count_outcomes(lower: Floats, upper: Floats, outcome: Floats | float) -> Ints:
    """Return how many intervals have their outcome below, inside and above them; bounds that are NaN do not count.

    Examples
    --------
    >>> count_outcomes(np.array([0.2, 0.4, 0.6, np.nan]), np.array([0.3, 0.5, 0.7, np.nan]), 0.5).tolist()
    [1, 1, 1]
    """
    known = np.isfinite(lower) & np.isfinite(upper)
    below, above = known & (outcome < lower), known & (outcome > upper)
    return np.array([below.sum(), (known & ~below & ~above).sum(), above.sum()], np.int64)
