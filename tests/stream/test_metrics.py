"""Metrics have one line each per value, in the form that Prometheus reads, from one snapshot."""

import builtins
from dataclasses import fields, replace

import pytest
from prometheus_client.exposition import generate_latest
from prometheus_client.parser import text_string_to_metric_families

from socast.core.errors import SettingsError
from socast.stream.metrics import BUILD, LAG, LOOP_AGE, METRICS, READY, list_metric_names, make_registry
from socast.stream.service_snapshot import LAG_BUCKETS, LagCounts, ServiceSnapshot
from tests.support.paths import ROOT
from tests.support.service import FULL, read_metrics

NOW = 101.5


def export(snapshot: ServiceSnapshot | None) -> str:
    """Return the text of all metrics."""
    registry = make_registry(lambda: snapshot, lambda: snapshot is not None, lambda: 0.25, lambda: NOW)
    return generate_latest(registry).decode()


def test_every_value_of_a_snapshot_is_exported_under_its_name():
    samples = read_metrics(export(FULL))
    assert samples["socast_messages_total"] == 9.0
    assert samples['socast_rejected_total{cause="not_json"}'] == 1.0
    assert samples['socast_interval_outcomes_total{basis="plan",place="inside"}'] == 18.0
    assert samples['socast_model_mae_kwh{model="a/1"}'] == 0.25
    assert samples["socast_queue_bytes"] == 300.0
    assert samples["socast_newest_sample_age_seconds"] == 1.5
    assert samples["socast_state_age_seconds"] == 11.5
    assert samples["socast_publishes"] == 1.0
    assert samples["socast_overlapping_consumers"] == 1.0
    assert samples["socast_shards"] == 2.0
    assert samples['socast_vehicle_sample_age_seconds{vehicle="car-2"}'] == 61.5
    assert samples['socast_vehicle_lost_total{vehicle="car-1"}'] == 5.0
    assert samples["socast_condition_age_seconds"] == 21.5
    assert samples['socast_vehicle_consumption_ratio{vehicle="car-1"}'] == 1.05
    assert 'socast_vehicle_consumption_ratio{vehicle="car-2"}' not in samples
    assert samples['socast_vehicle_usable_kwh{vehicle="car-2"}'] == 27.0
    named = {name.partition("{")[0] for name in samples}
    assert set(list_metric_names()) <= named


def test_values_that_the_service_does_not_have_are_not_exported():
    named = {name.partition("{")[0] for name in read_metrics(export(ServiceSnapshot()))}
    assert "socast_messages_total" in named
    assert not {"socast_lost_total", "socast_queue_bytes", "socast_state_age_seconds"} & named
    assert not any(name.startswith("socast_vehicle_") for name in named)


@pytest.mark.parametrize(("publishes", "value"), [(None, 1.0), (True, 1.0), (False, 0.0)])
def test_a_consumer_without_standby_publishes_always(publishes, value):
    assert read_metrics(export(ServiceSnapshot(publishes=publishes)))["socast_publishes"] == value


def test_no_metric_but_those_of_vehicles_has_a_label_for_vehicles():
    assert {row.name for row in METRICS if "vehicle" in row.labels} == {
        "socast_vehicle_sample_age_seconds",
        "socast_vehicle_lost",
        "socast_vehicle_consumption_ratio",
        "socast_vehicle_usable_kwh",
    }


def test_readiness_and_process_are_exported_before_the_first_snapshot():
    samples = read_metrics(export(None))
    assert samples[READY] == 0.0
    assert samples[LOOP_AGE] == 0.25
    assert samples["process_resident_memory_bytes"] > 0.0
    assert any(name.startswith(BUILD) for name in samples)
    assert "socast_messages_total" not in samples


def test_lag_is_a_histogram_whose_buckets_add_up():
    counts = LagCounts((1, 2, *(0,) * (len(LAG_BUCKETS) - 2), 3), 10_801.0)
    samples = read_metrics(export(ServiceSnapshot(lag=counts)))
    assert samples[f'{LAG}_bucket{{le="0.1"}}'] == 1.0
    assert samples[f'{LAG}_bucket{{le="3600.0"}}'] == 3.0
    assert samples[f'{LAG}_bucket{{le="+Inf"}}'] == samples[f"{LAG}_count"] == 6.0
    assert samples[f"{LAG}_sum"] == 10_801.0


def test_text_is_valid_and_explains_every_metric():
    families = {each.name: each for each in text_string_to_metric_families(export(FULL))}
    assert all(families[row.name].documentation == row.meaning for row in METRICS)
    assert all(row.meaning.endswith(".") for row in METRICS)


def test_every_field_of_a_snapshot_is_exported():
    """A value that differs from that of an empty snapshot changes the text."""
    plain = export(ServiceSnapshot())
    for each in fields(ServiceSnapshot):
        others = {"lag": LagCounts((1,) * (len(LAG_BUCKETS) + 1), 1.0), "publishes": False}
        value = others.get(each.name, getattr(FULL, each.name))
        assert export(ServiceSnapshot(**{each.name: value})) != plain or value in (0, None), each.name


def test_missing_package_is_one_line_with_its_remedy(monkeypatch):
    original = builtins.__import__

    def refuse(name, *rest):
        if name.startswith("prometheus_client"):
            raise ImportError(name)
        return original(name, *rest)

    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(SettingsError, match=r"install it with: pip install 'socast\[service\]'"):
        export(None)


def test_guide_describes_every_metric():
    guide = (ROOT / "docs" / "guide" / "operate.md").read_text()
    for row in METRICS:
        labels = f"{{{', '.join(row.labels)}}}" if row.labels else ""
        meaning = row.meaning[0].lower() + row.meaning[1:].rstrip(".")
        assert f"| `{row.exported}{labels}` | {meaning} |" in guide, row.name
    for name in (LAG, READY, LOOP_AGE, BUILD):
        assert name in guide


@pytest.mark.parametrize("odd", ['a"b', "a\nb", "a\\b", "é☃𝄞", "a\0b", '{x="1"} 5\nforged 1'])
def test_odd_label_is_one_value_that_reads_back(odd):
    text = export(replace(FULL, rejected={odd: 1}, model_mae_kwh={odd: 0.25}))
    families = list(text_string_to_metric_families(text))
    values = [sample.labels.get("cause") for family in families for sample in family.samples]
    assert odd in values
    assert {family.name for family in families} == {
        family.name for family in text_string_to_metric_families(export(FULL))
    }
