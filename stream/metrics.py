"""The metrics of the live service: what each is called and means, and the collector that Prometheus reads.

The loop replaces one immutable `ServiceSnapshot` about once a second. The collector runs in a thread of the web server
and reads nothing else. A scrape therefore never waits for the loop, nor the loop for a scrape.
"""

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from importlib.metadata import version
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

from socast.core.errors import SettingsError
from socast.stream.service_snapshot import LAG_BUCKETS, METRICS, MetricRow, ServiceSnapshot

if TYPE_CHECKING:
    from prometheus_client import CollectorRegistry, Metric

_AGE: Final = "_age_seconds"  # end of the names of metrics whose field is a moment
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
        values = _read_values(row, snapshot, now)
        if values is None:
            continue
        family: Any = CounterMetricFamily if row.kind == "counter" else GaugeMetricFamily
        made = family(row.name, row.meaning, labels=(*row.labels, *shard))
        for of_labels, value in values.items():
            made.add_metric((*of_labels, *shard.values()), float(value))
        yield made
    running, buckets = 0, []
    for limit, count in zip((*map(str, LAG_BUCKETS), "+Inf"), snapshot.lag.counts, strict=True):
        running += count
        buckets.append((limit, running))
    lag = HistogramMetricFamily(LAG, LAG_MEANING, labels=list(shard))
    lag.add_metric(list(shard.values()), buckets, snapshot.lag.total)
    yield lag


def _read_values(row: MetricRow, snapshot: ServiceSnapshot, now: float) -> Mapping[Any, float] | None:
    """Return the values of a metric by a tuple of labels; None where the service does not have it."""
    value: Any
    if row.labels == ("vehicle",):
        cars = snapshot.of_vehicles
        found = getattr(cars, row.field, None)
        value = (
            None
            if cars is None or found is None
            else {name: each for name, each in zip(cars.names, found, strict=True) if each is not None}
        )
    else:
        value = getattr(snapshot, row.field)
    if row.field == "publishes":  # None where it always does
        return {(): value is not False}
    if value is None:
        return None
    if not isinstance(value, Mapping):
        number = len(value) if isinstance(value, tuple) else value
        return {(): max(0.0, now - number) if row.name.endswith(_AGE) else number}
    values = {labels if isinstance(labels, tuple) else (labels,): each for labels, each in value.items()}
    return {labels: now - moment for labels, moment in values.items()} if row.name.endswith(_AGE) else values


def _make_gauge(name: str, meaning: str, value: float, labels: Mapping[str, str] | None = None) -> "Metric":
    """Return a gauge with one value."""
    from prometheus_client.core import GaugeMetricFamily  # noqa: PLC0415 - an extra

    labels = labels or {}
    family = GaugeMetricFamily(name, meaning, labels=list(labels))
    family.add_metric(list(labels.values()), value)
    return family
