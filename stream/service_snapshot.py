"""The snapshot of the live service: what the thread of the loop reads off the pipeline, the source and the recorder."""

import time
from bisect import bisect_left
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, fields
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

import msgspec
import numpy as np

from socast.core.files import UNREADABLE
from socast.core.forecast.conformal import BY_HISTORY, BY_PLAN, OVER_CHARGE, TO_CHARGE
from socast.core.pipeline import Pipeline
from socast.core.wire.messages import Message
from socast.core.wire.shard import Shard
from socast.stream.checkpoints import Checkpoints
from socast.stream.loop import Tally
from socast.stream.nightly_diagnosis import UNKNOWN_LEVEL, NightlyCondition
from socast.stream.query_service import QueryService
from socast.stream.recorder import Recorder

if TYPE_CHECKING:
    from socast.stream.zenoh_overlap import OverlapWatch
    from socast.stream.zenoh_standby import Standby

ACTIVE_S: Final = 300.0
"""Age of its newest sample up to which a vehicle is active. [s]"""
AHEAD_S: Final = 60.0
"""Time by which a sample may be ahead of the system clock; a sample further ahead has a wrong time. [s]"""
OF_SOURCE: Final = "missed", "dropped", "queue_messages", "queue_bytes", "is_catching_up"
"""Attributes of a source that a snapshot takes over, see `ServiceSnapshot`; a source may lack any of them."""
PLACES: Final = "below", "inside", "above"
"""Places of an outcome beside an interval."""
_TELEMETRY: Final = "/telemetry"
LAG_BUCKETS: Final = (0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0, 300.0, 3600.0)
"""Upper limits of the buckets of the receipt lag. [s]"""


@dataclass(frozen=True)
class LagCounts:
    """Count observed receipt lags by bucket.

    Parameters
    ----------
    counts : tuple of int
        Number of lags in each bucket of `LAG_BUCKETS`, and above the last.
    total : float
        Sum of the lags. [s]
    """

    counts: tuple[int, ...] = (0,) * (len(LAG_BUCKETS) + 1)
    total: float = 0.0


class MetricRow(NamedTuple):
    """Declare under which name a field is exported, and what it means.

    Parameters
    ----------
    name : Name without the ending `_total` of counters.
    labels : Names of what the keys of a mapping say.
    field : Field of `ServiceSnapshot`, or of `VehicleSnapshot`.
    """

    name: str
    kind: Literal["counter", "gauge"]
    meaning: str
    labels: tuple[str, ...]
    field: str = ""

    @property
    def exported(self) -> str:
        """Return the name under which Prometheus stores the metric."""
        return f"{self.name}_total" if self.kind == "counter" else self.name


def _declare(
    kind: Literal["counter", "gauge"], name: str, meaning: str, *labels: str, default: float | tuple[()] | None = 0
) -> Any:
    """Return a field that is exported; with labels it is a mapping, empty by default."""
    metadata = {"metric": MetricRow(name, kind, meaning, labels)}
    if labels and default is not None:
        return field(default_factory=dict, metadata=metadata)
    return field(default=default, metadata=metadata)


_counter, _gauge = partial(_declare, "counter"), partial(_declare, "gauge")


@dataclass(frozen=True)
class VehicleSnapshot:
    """Hold what is exported of each of n vehicles, if that is asked for."""

    names: tuple[str, ...]
    newest_s: tuple[float, ...] = _gauge(
        "socast_vehicle_sample_age_seconds",
        "Age of the newest sample of a vehicle; only with --metrics-per-car.",
        "vehicle",
        default=None,
    )
    lost: tuple[int, ...] | None = _counter(
        "socast_vehicle_lost",
        "Samples of a vehicle that never came; only with --metrics-per-car.",
        "vehicle",
        default=None,
    )
    consumption_ratio: tuple[float | None, ...] | None = _gauge(
        "socast_vehicle_consumption_ratio",
        "Consumption of a vehicle over that of its siblings; only with --watch and --metrics-per-car.",
        "vehicle",
        default=None,
    )
    usable_kwh: tuple[float | None, ...] | None = _gauge(
        "socast_vehicle_usable_kwh",
        "Usable capacity of a vehicle's battery when it is mild; only with --watch and --metrics-per-car.",
        "vehicle",
        default=None,
    )


@dataclass(frozen=True)
class ServiceSnapshot:
    """Hold the counters and gauges of the service at one moment, as plain values: each field declares its metric.

    None means that the service does not have a value, and its metric is not exported. Counters that the state file
    keeps continue after a restart; the others begin at 0. Moments, such as `saved_s`, are exported as ages. [Unix s]

    Parameters
    ----------
    lag : Times of receipt less times of samples.
    shard : Share of the fleet that is served, such as `2/4`; empty without shards.
    obstacle : Why the service is not ready although its loop moves; empty where it is.
    """

    messages: int = _counter("socast_messages", "Messages received by this process.")
    received: Mapping[str, int] = _counter("socast_decoded", "Decoded messages by kind.", "kind")
    rejected: Mapping[str, int] = _counter("socast_rejected", "Rejected messages by cause.", "cause")
    flagged: Mapping[str, int] = _counter(
        "socast_samples_flagged", "Samples that were repaired or rejected, by quality cause.", "cause"
    )
    duplicates: int | None = _counter("socast_duplicates", "Messages that were delivered again.", default=None)
    lost: int | None = _counter("socast_lost", "Samples that were sent and never came.", default=None)
    recovered: int | None = _counter("socast_recovered", "Samples that came after they were missed.", default=None)
    missed: int | None = _counter("socast_missed", "Samples that Zenoh could not recover.", default=None)
    dropped: Mapping[str, int] | None = _counter(
        "socast_dropped", "Messages dropped by a limit.", "limit", default=None
    )
    recorded: int | None = _counter("socast_recorded", "Messages that were recorded.", default=None)
    unrecorded: int | None = _counter(
        "socast_unrecorded", "Messages that the disk refused, or whose recording vanished.", default=None
    )
    is_catching_up: bool | None = _gauge(
        "socast_catching_up", "1 while live samples wait for what the caches of publishers hold.", default=None
    )
    queue_messages: float | None = _gauge("socast_queue_messages", "Messages that wait for the loop.", default=None)
    queue_bytes: float | None = _gauge("socast_queue_bytes", "Size of the messages that wait.", default=None)
    newest_sample_s: float | None = _gauge(
        "socast_newest_sample_age_seconds", "Age of the newest sample of all vehicles.", default=None
    )
    vehicles: int = _gauge("socast_vehicles", "Vehicles in the state.")
    active_vehicles: int = _gauge("socast_active_vehicles", "Vehicles with a sample in the last 5 minutes.")
    forecasts: int = _counter("socast_forecasts", "Forecasts made by this process, on standby too.")
    refused_forecasts: Mapping[str, int] | None = _counter(
        "socast_forecasts_refused",
        "Forecasts that were not published because they are not plausible, by cause.",
        "cause",
        default=None,
    )
    rides: int = _counter("socast_rides", "Rides that have ended.")
    unfit_rides: Mapping[str, int] = _counter(
        "socast_rides_unfit", "Ended rides that are unfit for training, by reason.", "reason"
    )
    faulty_loggers: Mapping[str, int] = _gauge(
        "socast_faulty_loggers", "Vehicles of whose logger a ride has shown a fault, by fault.", "fault"
    )
    unpredicted_rides: Mapping[str, int] = _counter(
        "socast_rides_unpredicted", "Ended rides whose energy cannot be predicted, by reason.", "reason"
    )
    interval_outcomes: Mapping[tuple[str, str], int] = _counter(
        "socast_interval_outcomes",
        "Outcomes of forecasts of the charge at the shift's end and at the next planned charge: below, inside or above "
        "the 90 % interval.",
        *("basis", "place"),
    )
    model_interval_outcomes: Mapping[tuple[str, str], int] = _counter(
        "socast_model_interval_outcomes",
        "Ended rides with measured energy: below, inside or above the 90 % interval of a model that has one.",
        *("model", "place"),
    )
    model_rides: Mapping[tuple[str, str], int] = _counter(
        "socast_model_rides",
        "Ended rides with measured energy, by model and by whether it predicted them.",
        *("model", "result"),
    )
    model_mae_kwh: Mapping[str, float] = _gauge(
        "socast_model_mae_kwh", "Mean absolute error of the energy of rides.", "model"
    )
    model_mae_ratio: Mapping[str, float] = _gauge(
        "socast_model_mae_ratio", "Sum of absolute errors over sum of measured energies.", "model"
    )
    model_bias_kwh: Mapping[str, float] = _gauge(
        "socast_model_bias_kwh", "Mean of predicted less measured energy of rides.", "model"
    )
    answered: int = _counter("socast_queries_answered", "Answered queries.")
    refused_queries: Mapping[str, int] = _counter("socast_queries_refused", "Refused queries by cause.", "cause")
    saved_s: float | None = _gauge("socast_state_age_seconds", "Age of the saved state.", default=None)
    recorded_s: float | None = _gauge(
        "socast_recording_age_seconds", "Time since the recording was synced to disk.", default=None
    )
    assessed_s: float | None = _gauge(
        "socast_condition_age_seconds",
        "Time since the condition of the vehicles was assessed; only with --watch.",
        default=None,
    )
    publishes: bool | None = _gauge("socast_publishes", "1 where this consumer publishes, 0 on standby.", default=None)
    overlapping: tuple[str, ...] = _gauge(
        "socast_overlapping_consumers", "Other consumers that publish for the same cars.", default=()
    )
    shards: int | None = _gauge("socast_shards", "Shards that divide the fleet; only with --shard.", default=None)
    lag: LagCounts = LagCounts()
    shard: str = ""
    obstacle: str = ""
    of_vehicles: VehicleSnapshot | None = None


METRICS: Final = tuple(
    each.metadata["metric"]._replace(field=each.name)
    for record in (ServiceSnapshot, VehicleSnapshot)
    for each in fields(record)
    if "metric" in each.metadata
)
"""Every metric that a snapshot holds, but for the histogram of the lag."""


class _Stamped(msgspec.Struct):
    """Hold the time of a sample."""

    time_s: float


class LagMeter:
    """Count the times of receipt less the times of samples, by bucket."""

    def __init__(self) -> None:
        self._decode = msgspec.json.Decoder(_Stamped).decode
        self._counts = [0] * (len(LAG_BUCKETS) + 1)
        self._total = 0.0

    def observe(self, message: Message) -> None:
        """Count the lag of a message if it is one sample of telemetry; a lag below 0 counts as 0."""
        if message.key.endswith(_TELEMETRY):
            try:
                lag = message.receipt_ns * 1e-9 - self._decode(message.payload).time_s
            except UNREADABLE:
                return
            lag = max(0.0, lag)
            self._counts[bisect_left(LAG_BUCKETS, lag)] += 1
            self._total += lag

    def count(self) -> LagCounts:
        """Return the counts so far."""
        return LagCounts(tuple(self._counts), self._total)


class SnapshotTaker:
    """Take snapshots of the service; call it in the thread of the loop only.

    Parameters
    ----------
    source : object
        Source of the messages. Those of its attributes that `OF_SOURCE` names are exported.
    candidate : Standby, optional
        Tells whether this consumer publishes, where one of several does.
    overlap : OverlapWatch, optional
        Tells which other consumers publish for the same cars.
    shard : Shard, optional
        Share of the fleet that is served.
    per_vehicle : bool
        Whether to export values of each vehicle.
    get_condition : callable
        Function that returns the condition of the vehicles, None where it is unknown.
    now, clock : callable
        Functions that return Unix time and monotonic time. [s]
    """

    def __init__(
        self,
        pipeline: Pipeline,
        source: object,
        recorder: Recorder | None = None,
        checkpoints: Checkpoints | None = None,
        queries: QueryService | None = None,
        candidate: "Standby | None" = None,
        overlap: "OverlapWatch | None" = None,
        *,
        shard: Shard | None = None,
        per_vehicle: bool = False,
        get_condition: Callable[[], NightlyCondition | None] = lambda: None,
        now: Callable[[], float] = time.time,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._pipeline, self._source, self._recorder = pipeline, source, recorder
        self._checkpoints, self._queries, self._candidate = checkpoints, queries, candidate
        self._overlap, self._shard, self._per_vehicle = overlap, shard, per_vehicle
        self._now, self._clock, self._get_condition = now, clock, get_condition

    def __call__(self, tally: Tally, lag: LagMeter) -> ServiceSnapshot:
        """Return the present snapshot."""
        recorder, queries, condition = self._recorder, self._queries, self._get_condition()
        saved_s = self._checkpoints.saved_s if self._checkpoints else None
        return ServiceSnapshot(
            messages=tally.received,
            forecasts=tally.forecasts,
            **self._read_source(),
            duplicates=self._pipeline.duplicates.dropped,
            lost=int(self._pipeline.decoder.losses.lost().sum()),
            recovered=tally.recovered,
            recorded=recorder.recorded if recorder else None,
            unrecorded=recorder.unrecorded if recorder else None,
            recorded_s=self._to_unix(recorder.synced_s if recorder else None),
            saved_s=self._to_unix(saved_s),
            assessed_s=condition.assessed_s if condition else None,
            lag=lag.count(),
            answered=queries.answered if queries else 0,
            refused_queries=dict(queries.refused) if queries else {},
            publishes=self._candidate.is_active if self._candidate else None,
            overlapping=self._overlap.found if self._overlap else (),
            obstacle=self._candidate.failure if self._candidate else "",
            shard=str(self._shard or ""),
            shards=self._shard.count if self._shard else None,
            **_read_quality(self._pipeline.quality()),
            **self._read_vehicles(condition),
            **self._read_models(),
            interval_outcomes=dict(self._list_outcomes()),
        )

    def _to_unix(self, moment: float | None) -> float | None:
        """Return the Unix time of a monotonic time. [s]"""
        return None if moment is None else self._now() - (self._clock() - moment)

    def _read_source(self) -> dict[str, Any]:
        """Return the counts of the source."""
        counts = {name: getattr(self._source, name, None) for name in OF_SOURCE}
        return {name: dict(value) if isinstance(value, Mapping) else value for name, value in counts.items()}

    def _read_vehicles(self, condition: NightlyCondition | None) -> dict[str, Any]:
        """Return the numbers of vehicles, the newest sample and, if asked for, values of each vehicle."""
        now, lanes = self._now(), self._pipeline.totals.cleaner.lanes_heard()
        newest = self._pipeline.totals.cleaner.state["stamp"][lanes]
        possible = newest[newest <= now + AHEAD_S]
        out: dict[str, Any] = {
            "active_vehicles": int(np.count_nonzero(possible >= now - ACTIVE_S)),
            "newest_sample_s": float(possible.max()) if len(possible) else None,
        }
        if self._per_vehicle:
            names = self._pipeline.lanes.names
            lost = self._pipeline.decoder.losses.lost()[lanes]
            heard = tuple(names[lane] for lane in lanes.tolist())
            levels = [condition.cars.get(name, UNKNOWN_LEVEL) for name in heard] if condition else []
            of_condition = zip(*levels, strict=True) if levels else (None, None)
            out["of_vehicles"] = VehicleSnapshot(heard, tuple(newest.tolist()), tuple(lost.tolist()), *of_condition)
        return out

    def _read_models(self) -> dict[str, Any]:
        """Return the errors of each model."""
        errors = {each.model: each.overall for each in self._pipeline.shadows.errors()}
        predicted = {model: one for model, one in errors.items() if one.rides}
        return {
            "model_rides": {(model, "predicted"): one.rides for model, one in errors.items()}
            | {(model, "unpredicted"): one.unpredicted_rides for model, one in errors.items()},
            "model_interval_outcomes": {
                (monitor.label, place): count
                for monitor in self._pipeline.shadows.monitors
                for place, count in zip(PLACES, monitor.interval_outcomes.tolist(), strict=True)
                if monitor.interval_outcomes.any()
            },
            "model_mae_kwh": {model: one.mae_kwh for model, one in predicted.items()},
            "model_bias_kwh": {model: one.bias_kwh for model, one in predicted.items()},
            "model_mae_ratio": {
                model: one.mae_pct / 100.0 for model, one in predicted.items() if one.mae_pct is not None
            },
        }

    def _list_outcomes(self) -> Iterator[tuple[tuple[str, str], int]]:
        """Yield the outcomes of intervals by basis and place."""
        outcomes = self._pipeline.engine.statistics.interval_outcomes
        names = {BY_PLAN: "plan", BY_HISTORY: "history", TO_CHARGE: "next_charge", OVER_CHARGE: "plan_with_charge"}
        for basis, name in names.items():
            for place, count in zip(PLACES, outcomes[basis].tolist(), strict=True):
                yield (name, place), count


def _read_quality(quality: dict[str, Any]) -> dict[str, Any]:
    """Return what the counters of quality tell."""
    return {
        "received": quality["received"],
        "rejected": quality["undecodable"],
        "flagged": quality["samples"],
        "vehicles": quality["vehicles"],
        "rides": quality["rides"],
        "unfit_rides": quality["unfit"],
        "faulty_loggers": {name: len(cars) for name, cars in quality["logger_faults"].items()},
        "unpredicted_rides": quality["unpredicted"],
        "refused_forecasts": quality["implausible_forecasts"],
    }
