"""The snapshot of the live service: what the thread of the loop reads off the pipeline, the source and the recorder."""

import time
from bisect import bisect_left
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Protocol

import msgspec
import numpy as np

from socast.core.forecast.conformal import BY_HISTORY, BY_PLAN, OVER_CHARGE, TO_CHARGE
from socast.core.pipeline import Pipeline
from socast.core.wire.messages import Message
from socast.core.wire.shard import Shard
from socast.stream.checkpoints import Checkpoints
from socast.stream.loop import Tally
from socast.stream.query_service import QueryService
from socast.stream.recorder import Recorder

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


@dataclass(frozen=True)
class VehicleSnapshot:
    """Hold what is exported of each of n vehicles, if that is asked for.

    Parameters
    ----------
    newest_s : tuple of n float
        Time of the newest sample. [Unix s]
    """

    names: tuple[str, ...]
    newest_s: tuple[float, ...]
    lost: tuple[int, ...] | None = None


@dataclass(frozen=True)
class ServiceSnapshot:
    """Hold the counters and gauges of the service at one moment, as plain values.

    None means that the service does not have a value, and its metric is not exported. Counters that the state file
    keeps continue after a restart; the others begin at 0.

    Parameters
    ----------
    messages, forecasts : int
        Numbers of messages received and of forecasts sent, by this process.
    received, rejected, flagged : mapping of str to int
        Decoded messages by kind, undecodable ones by cause, and samples by quality cause.
    duplicates, lost, recovered, missed : int, optional
        Samples that came again, that never came, that came late after a loss, and that Zenoh counts as missed.
    recorded, unrecorded : int, optional
        Messages that the recorder wrote, and that the disk refused.
    dropped : mapping of str to int, optional
        Samples that a limit dropped, by the limit.
    is_catching_up : bool, optional
        Whether live samples wait for the answers of caches.
    queue_messages, queue_bytes : float, optional
        Messages that wait for the loop, and their size. [B]
    lag : LagCounts
        Times of receipt less times of samples.
    newest_sample_s : float, optional
        Time of the newest sample of all vehicles. [Unix s]
    vehicles, active_vehicles : int
        Vehicles known, and vehicles whose newest sample is recent.
    unfit_rides, unpredicted_rides : mapping of str to int
        Rides that are unfit for training, and rides without a prediction, by reason.
    faulty_loggers : mapping of str to int
        Vehicles of whose logger a ride has shown a fault, by its name.
    refused_forecasts : mapping of str to int, optional
        Forecasts that were not published, by cause.
    interval_outcomes : mapping of (str, str) to int
        Outcomes of forecast intervals by basis of the forecast and by place: `below`, `inside` or `above`.
    model_interval_outcomes : mapping of (str, str) to int
        Rides by model and by the place of their energy beside the model's own interval, for models that have one.
    model_rides : mapping of (str, str) to int
        Rides by model and by whether the model predicted them: `predicted` or `unpredicted`.
    model_mae_kwh, model_bias_kwh, model_mae_ratio : mapping of str to float
        Errors of each model that has predicted rides. [kWh], [kWh], [1]
    saved_s, recorded_s : float, optional
        Time of the last state and of the last sync of the recording. [Unix s]
    publishes : bool, optional
        Whether this consumer publishes, where one of several does; None where it always does.
    overlapping : tuple of str
        Shares of other consumers that publish for the same cars.
    shard : str
        Share of the fleet that is served, such as `2/4`; empty without shards.
    shards : int, optional
        Number of shards that divide the fleet.
    obstacle : str
        Why the service is not ready although its loop moves; empty where it is.
    """

    messages: int = 0
    forecasts: int = 0
    received: Mapping[str, int] = field(default_factory=dict)
    rejected: Mapping[str, int] = field(default_factory=dict)
    flagged: Mapping[str, int] = field(default_factory=dict)
    duplicates: int | None = None
    lost: int | None = None
    recovered: int | None = None
    missed: int | None = None
    recorded: int | None = None
    unrecorded: int | None = None
    dropped: Mapping[str, int] | None = None
    is_catching_up: bool | None = None
    queue_messages: float | None = None
    queue_bytes: float | None = None
    lag: LagCounts = LagCounts()
    newest_sample_s: float | None = None
    vehicles: int = 0
    active_vehicles: int = 0
    rides: int = 0
    unfit_rides: Mapping[str, int] = field(default_factory=dict)
    faulty_loggers: Mapping[str, int] = field(default_factory=dict)
    unpredicted_rides: Mapping[str, int] = field(default_factory=dict)
    refused_forecasts: Mapping[str, int] | None = None
    answered: int = 0
    refused_queries: Mapping[str, int] = field(default_factory=dict)
    interval_outcomes: Mapping[tuple[str, str], int] = field(default_factory=dict)
    model_interval_outcomes: Mapping[tuple[str, str], int] = field(default_factory=dict)
    model_rides: Mapping[tuple[str, str], int] = field(default_factory=dict)
    model_mae_kwh: Mapping[str, float] = field(default_factory=dict)
    model_bias_kwh: Mapping[str, float] = field(default_factory=dict)
    model_mae_ratio: Mapping[str, float] = field(default_factory=dict)
    saved_s: float | None = None
    recorded_s: float | None = None
    publishes: bool | None = None
    overlapping: tuple[str, ...] = ()
    shard: str = ""
    shards: int | None = None
    obstacle: str = ""
    of_vehicles: VehicleSnapshot | None = None


class Candidate(Protocol):
    """Define what a snapshot reads of a consumer on standby, such as `socast.stream.zenoh_standby.Standby`."""

    @property
    def failure(self) -> str:
        """Return why the consumer has left the election for good; an empty text while it takes part."""

    @property
    def is_active(self) -> bool:
        """Return whether the consumer publishes now."""


class Overlapping(Protocol):
    """Define what a snapshot reads of the watch on other consumers, `socast.stream.zenoh_overlap.OverlapWatch`."""

    @property
    def found(self) -> tuple[str, ...]:
        """Return the shares of other consumers that publish for the same cars."""


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
            except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
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
    candidate : Candidate, optional
        Tells whether this consumer publishes, where one of several does.
    overlap : Overlapping, optional
        Tells which other consumers publish for the same cars.
    shard : Shard, optional
        Share of the fleet that is served.
    per_vehicle : bool
        Whether to export values of each vehicle.
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
        candidate: Candidate | None = None,
        overlap: Overlapping | None = None,
        *,
        shard: Shard | None = None,
        per_vehicle: bool = False,
        now: Callable[[], float] = time.time,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._pipeline, self._source, self._recorder = pipeline, source, recorder
        self._checkpoints, self._queries, self._candidate = checkpoints, queries, candidate
        self._overlap, self._shard, self._per_vehicle = overlap, shard, per_vehicle
        self._now, self._clock = now, clock

    def __call__(self, tally: Tally, lag: LagMeter) -> ServiceSnapshot:
        """Return the present snapshot."""
        recorder, queries = self._recorder, self._queries
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
            lag=lag.count(),
            answered=queries.answered if queries else 0,
            refused_queries=dict(queries.refused) if queries else {},
            publishes=self._candidate.is_active if self._candidate else None,
            overlapping=self._overlap.found if self._overlap else (),
            obstacle=self._candidate.failure if self._candidate else "",
            shard=str(self._shard or ""),
            shards=self._shard.count if self._shard else None,
            **_read_quality(self._pipeline.quality()),
            **self._read_vehicles(),
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

    def _read_vehicles(self) -> dict[str, Any]:
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
            out["of_vehicles"] = VehicleSnapshot(heard, tuple(newest.tolist()), tuple(lost.tolist()))
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
