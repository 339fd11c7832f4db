"""The metrics of the live service: what each is called and means, and the collector that Prometheus reads.

The loop replaces one immutable `ServiceSnapshot` about once a second. The collector runs in a thread of the web server
and reads nothing else. A scrape therefore never waits for the loop, nor the loop for a scrape.
"""

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from importlib.metadata import version
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple, TypeAlias

from socast.core.errors import SettingsError
from socast.stream.service_snapshot import LAG_BUCKETS, ServiceSnapshot

if TYPE_CHECKING:
    from prometheus_client import CollectorRegistry, Metric

Values: TypeAlias = Mapping[Any, float] | float | None
"""What a metric shows: values by a tuple of labels, one value, or None where the service does not have it."""


class MetricRow(NamedTuple):
    """Describe a metric.

    Parameters
    ----------
    name : str
        Name without the ending `_total` of counters.
    get : callable
        Function that takes a snapshot and the present time [Unix s], and returns the values.
    """

    name: str
    kind: Literal["counter", "gauge"]
    meaning: str
    get: Callable[[ServiceSnapshot, float], Values]
    labels: tuple[str, ...] = ()

    @property
    def exported(self) -> str:
        """Return the name under which Prometheus stores the metric."""
        return f"{self.name}_total" if self.kind == "counter" else self.name


def _by(counts: Mapping[str, float] | None) -> Values:
    """Return counts by one label."""
    return None if counts is None else {(name,): value for name, value in counts.items()}


def _age(moment: float | None, now: float) -> float | None:
    """Return the time since a moment, None without one. [s]"""
    return None if moment is None else max(0.0, now - moment)


def _get_vehicle_ages(snapshot: ServiceSnapshot, now: float) -> Values:
    """Return the age of the newest sample by vehicle. [s]"""
    cars = snapshot.of_vehicles
    return {(name,): now - at for name, at in zip(cars.names, cars.newest_s, strict=True)} if cars else None


def _get_vehicle_losses(snapshot: ServiceSnapshot, _: float) -> Values:
    """Return the number of lost samples by vehicle."""
    cars = snapshot.of_vehicles
    if cars is None or cars.lost is None:
        return None
    return {(name,): lost for name, lost in zip(cars.names, cars.lost, strict=True)}


METRICS: Final = (
    MetricRow("socast_messages", "counter", "Messages received by this process.", lambda s, _: s.messages),
    MetricRow("socast_decoded", "counter", "Decoded messages by kind.", lambda s, _: _by(s.received), ("kind",)),
    MetricRow("socast_rejected", "counter", "Rejected messages by cause.", lambda s, _: _by(s.rejected), ("cause",)),
    MetricRow(
        "socast_samples_flagged",
        "counter",
        "Samples that were repaired or rejected, by quality cause.",
        lambda s, _: _by(s.flagged),
        ("cause",),
    ),
    MetricRow("socast_duplicates", "counter", "Messages that were delivered again.", lambda s, _: s.duplicates),
    MetricRow("socast_lost", "counter", "Samples that were sent and never came.", lambda s, _: s.lost),
    MetricRow("socast_recovered", "counter", "Samples that came after they were missed.", lambda s, _: s.recovered),
    MetricRow("socast_missed", "counter", "Samples that Zenoh could not recover.", lambda s, _: s.missed),
    MetricRow("socast_dropped", "counter", "Messages dropped by a limit.", lambda s, _: _by(s.dropped), ("limit",)),
    MetricRow("socast_recorded", "counter", "Messages that were recorded.", lambda s, _: s.recorded),
    MetricRow("socast_unrecorded", "counter", "Messages that the disk refused.", lambda s, _: s.unrecorded),
    MetricRow(
        "socast_catching_up",
        "gauge",
        "1 while live samples wait for what the caches of publishers hold.",
        lambda s, _: s.is_catching_up,
    ),
    MetricRow("socast_queue_messages", "gauge", "Messages that wait for the loop.", lambda s, _: s.queue_messages),
    MetricRow("socast_queue_bytes", "gauge", "Size of the messages that wait.", lambda s, _: s.queue_bytes),
    MetricRow(
        "socast_newest_sample_age_seconds",
        "gauge",
        "Age of the newest sample of all vehicles.",
        lambda s, now: _age(s.newest_sample_s, now),
    ),
    MetricRow("socast_vehicles", "gauge", "Vehicles in the state.", lambda s, _: s.vehicles),
    MetricRow(
        "socast_active_vehicles",
        "gauge",
        "Vehicles with a sample in the last 5 minutes.",
        lambda s, _: s.active_vehicles,
    ),
    MetricRow(
        "socast_forecasts", "counter", "Forecasts made by this process, on standby too.", lambda s, _: s.forecasts
    ),
    MetricRow(
        "socast_forecasts_refused",
        "counter",
        "Forecasts that were not published because they are not plausible, by cause.",
        lambda s, _: _by(s.refused_forecasts),
        ("cause",),
    ),
    MetricRow("socast_rides", "counter", "Rides that have ended.", lambda s, _: s.rides),
    MetricRow(
        "socast_rides_unfit",
        "counter",
        "Ended rides that are unfit for training, by reason.",
        lambda s, _: _by(s.unfit_rides),
        ("reason",),
    ),
    MetricRow(
        "socast_faulty_loggers",
        "gauge",
        "Vehicles of whose logger a ride has shown a fault, by fault.",
        lambda s, _: _by(s.faulty_loggers),
        ("fault",),
    ),
    MetricRow(
        "socast_rides_unpredicted",
        "counter",
        "Ended rides whose energy cannot be predicted, by reason.",
        lambda s, _: _by(s.unpredicted_rides),
        ("reason",),
    ),
    MetricRow(
        "socast_interval_outcomes",
        "counter",
        "Outcomes of forecasts of the charge at the shift's end and at the next planned charge: below, inside or above "
        "the 90 % interval.",
        lambda s, _: s.interval_outcomes,
        ("basis", "place"),
    ),
    MetricRow(
        "socast_model_interval_outcomes",
        "counter",
        "Ended rides with measured energy: below, inside or above the 90 % interval of a model that has one.",
        lambda s, _: s.model_interval_outcomes,
        ("model", "place"),
    ),
    MetricRow(
        "socast_model_rides",
        "counter",
        "Ended rides with measured energy, by model and by whether it predicted them.",
        lambda s, _: s.model_rides,
        ("model", "result"),
    ),
    MetricRow(
        "socast_model_mae_kwh",
        "gauge",
        "Mean absolute error of the energy of rides.",
        lambda s, _: _by(s.model_mae_kwh),
        ("model",),
    ),
    MetricRow(
        "socast_model_mae_ratio",
        "gauge",
        "Sum of absolute errors over sum of measured energies.",
        lambda s, _: _by(s.model_mae_ratio),
        ("model",),
    ),
    MetricRow(
        "socast_model_bias_kwh",
        "gauge",
        "Mean of predicted less measured energy of rides.",
        lambda s, _: _by(s.model_bias_kwh),
        ("model",),
    ),
    MetricRow("socast_queries_answered", "counter", "Answered queries.", lambda s, _: s.answered),
    MetricRow(
        "socast_queries_refused",
        "counter",
        "Refused queries by cause.",
        lambda s, _: _by(s.refused_queries),
        ("cause",),
    ),
    MetricRow("socast_state_age_seconds", "gauge", "Age of the saved state.", lambda s, now: _age(s.saved_s, now)),
    MetricRow(
        "socast_recording_age_seconds",
        "gauge",
        "Time since the recording was synced to disk.",
        lambda s, now: _age(s.recorded_s, now),
    ),
    MetricRow(
        "socast_publishes",
        "gauge",
        "1 where this consumer publishes, 0 on standby.",
        lambda s, _: s.publishes is not False,
    ),
    MetricRow(
        "socast_overlapping_consumers",
        "gauge",
        "Other consumers that publish for the same cars.",
        lambda s, _: len(s.overlapping),
    ),
    MetricRow(
        "socast_shards",
        "gauge",
        "Shards that divide the fleet; only with --shard.",
        lambda s, _: s.shards,
    ),
    MetricRow(
        "socast_vehicle_sample_age_seconds",
        "gauge",
        "Age of the newest sample of a vehicle; only with --metrics-per-car.",
        _get_vehicle_ages,
        ("vehicle",),
    ),
    MetricRow(
        "socast_vehicle_lost",
        "counter",
        "Samples of a vehicle that never came; only with --metrics-per-car.",
        _get_vehicle_losses,
        ("vehicle",),
    ),
)
"""Every metric that a snapshot holds, but for the histogram of the lag."""
LAG: Final = "socast_receipt_lag_seconds"
"""Histogram of the time of receipt less the time of the sample."""
LAG_MEANING: Final = "Time of receipt less the time of a sample, of one sample of each list that the loop takes."
READY: Final = "socast_ready"
"""Gauge that is 1 where /readyz answers 200."""
LOOP_AGE: Final = "socast_loop_age_seconds"
"""Gauge of the time since the loop moved."""
BUILD: Final = "socast_build_info"
"""Gauge that is always 1, with the version as its label."""


def list_metric_names() -> list[str]:
    """Return the names of all metrics of the service as Prometheus stores them; a histogram has three."""
    histogram = [f"{LAG}_{part}" for part in ("bucket", "count", "sum")]
    return [*(row.exported for row in METRICS), *histogram, READY, LOOP_AGE, BUILD]


def make_registry(
    get_snapshot: Callable[[], ServiceSnapshot | None],
    is_ready: Callable[[], bool],
    get_loop_age: Callable[[], float],
    now: Callable[[], float] = time.time,
    shard: str = "",
) -> "CollectorRegistry":
    """Return the registry of the metrics of the service and of its process.

    Units: now [Unix s].

    Parameters
    ----------
    shard : str
        Shard of the service, such as `2/4`, which becomes a label of each metric; empty without shards.
    """
    try:
        from prometheus_client import CollectorRegistry, ProcessCollector  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise SettingsError(
            "--metrics needs the package prometheus-client; install it with: pip install 'socast[service]'"
        ) from error
    registry = CollectorRegistry()
    ProcessCollector(registry=registry)
    registry.register(_ServiceCollector(get_snapshot, is_ready, get_loop_age, now, shard))
    return registry


class _ServiceCollector:
    """Collect the metrics of the newest snapshot."""

    def __init__(
        self,
        get_snapshot: Callable[[], ServiceSnapshot | None],
        is_ready: Callable[[], bool],
        get_loop_age: Callable[[], float],
        now: Callable[[], float],
        shard: str,
    ) -> None:
        self._shard = {"shard": shard} if shard else {}
        self._get_snapshot, self._is_ready, self._get_loop_age, self._now = get_snapshot, is_ready, get_loop_age, now

    def collect(self) -> Iterator["Metric"]:
        """Yield the metric families."""
        yield _make_gauge(BUILD, "Version of socast.", 1.0, {"version": version("socast")} | self._shard)
        yield _make_gauge(READY, "1 where the service is ready.", float(self._is_ready()), self._shard)
        yield _make_gauge(LOOP_AGE, "Time since the loop moved.", self._get_loop_age(), self._shard)
        snapshot = self._get_snapshot()
        if snapshot is not None:
            yield from make_families(snapshot, self._now(), self._shard)


def make_families(
    snapshot: ServiceSnapshot, now: float, shard: Mapping[str, str] = MappingProxyType({})
) -> Iterable["Metric"]:
    """Yield the metric families of a snapshot.

    Units: now [Unix s].
    """
    from prometheus_client.core import (  # noqa: PLC0415 - an extra
        CounterMetricFamily,
        GaugeMetricFamily,
        HistogramMetricFamily,
    )

    for row in METRICS:
        values = row.get(snapshot, now)
        if values is None:
            continue
        family: Any = CounterMetricFamily if row.kind == "counter" else GaugeMetricFamily
        made = family(row.name, row.meaning, labels=(*row.labels, *shard))
        for of_labels, value in (values if isinstance(values, Mapping) else {(): values}).items():
            made.add_metric((*of_labels, *shard.values()), float(value))
        yield made
    running, buckets = 0, []
    for limit, count in zip((*map(str, LAG_BUCKETS), "+Inf"), snapshot.lag.counts, strict=True):
        running += count
        buckets.append((limit, running))
    lag = HistogramMetricFamily(LAG, LAG_MEANING, labels=list(shard))
    lag.add_metric(list(shard.values()), buckets, snapshot.lag.total)
    yield lag


def _make_gauge(name: str, meaning: str, value: float, labels: Mapping[str, str] | None = None) -> "Metric":
    """Return a gauge with one value."""
    from prometheus_client.core import GaugeMetricFamily  # noqa: PLC0415 - an extra

    labels = labels or {}
    family = GaugeMetricFamily(name, meaning, labels=list(labels))
    family.add_metric(list(labels.values()), value)
    return family
