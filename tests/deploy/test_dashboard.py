"""The dashboard shows every metric of the service, with a unit, and names none that does not exist."""

import json
import re
from itertools import combinations

import pytest

from socast.stream.metrics import BUILD, LAG, LOOP_AGE, METRICS, READY, list_metric_names
from tests.support.paths import ROOT
from tests.support.promql import STANDARD, list_metrics

BOARD = json.loads((ROOT / "deploy" / "grafana-dashboard.json").read_text())
PANELS = [panel for panel in BOARD["panels"] if panel["type"] != "row"]
UNITS = {"none", "s", "bytes", "cps", "percentunit", "kwatth"}
SUFFIXES = {"_seconds": "s", "_bytes": "bytes", "_kwh": "kwatth", "_ratio": "percentunit"}
"""Ending of a metric's name -> unit of its panel."""
GAUGES = {row.exported for row in METRICS if row.kind == "gauge"} | {READY, LOOP_AGE, BUILD}


def find_used(panel) -> set[str]:
    """Return the metrics of a panel."""
    return {name for target in panel["targets"] for name in list_metrics(target["expr"])}


def test_every_metric_is_shown():
    shown = set().union(*map(find_used, PANELS))
    assert set(list_metric_names()) - shown == set()
    assert "process_resident_memory_bytes" in shown


@pytest.mark.parametrize("panel", PANELS, ids=[panel["title"] for panel in PANELS])
def test_panel_has_metrics_that_exist_a_unit_and_words(panel):
    used = find_used(panel)
    assert used
    assert used <= set(list_metric_names()) | STANDARD
    assert panel["fieldConfig"]["defaults"]["unit"] in UNITS
    assert panel["description"].endswith(".")
    assert panel["datasource"] == {"type": "prometheus", "uid": "${datasource}"}
    assert len({target["refId"] for target in panel["targets"]}) == len(panel["targets"])
    for name in used & GAUGES:
        wanted = [unit for suffix, unit in SUFFIXES.items() if name.endswith(suffix)]
        assert panel["fieldConfig"]["defaults"]["unit"] in (wanted or {"none"}), name


@pytest.mark.parametrize("panel", PANELS, ids=[panel["title"] for panel in PANELS])
def test_counters_are_shown_as_rates_and_labels_exist(panel):
    labels = {row.exported: set(row.labels) for row in METRICS}
    for target in panel["targets"]:
        expression, names = target["expr"], list_metrics(target["expr"])
        for name in names - GAUGES - {"process_resident_memory_bytes"}:
            assert re.search(rf"(rate|increase)\({name}\b", expression), name
        known = {"instance", "shard", "le", "version"}.union(*(labels.get(name, set()) for name in names))
        named = set(re.findall(r"\{\{(\w+)\}\}", target["legendFormat"])) | set(re.findall(r'(\w+)=~?"', expression))
        named |= {label for group in re.findall(r"\bby \(([^)]*)\)", expression) for label in group.split(", ")}
        assert named <= known
        assert expression.count("(") == expression.count(")")


def test_panels_have_own_numbers_and_do_not_overlap():
    assert len({panel["id"] for panel in BOARD["panels"]}) == len(BOARD["panels"])
    places = [panel["gridPos"] for panel in BOARD["panels"]]
    assert all(place["x"] >= 0 and place["x"] + place["w"] <= 24 for place in places)
    for one, other in combinations(places, 2):
        beside = one["x"] + one["w"] <= other["x"] or other["x"] + other["w"] <= one["x"]
        below = one["y"] + one["h"] <= other["y"] or other["y"] + other["h"] <= one["y"]
        assert beside or below


def test_dashboard_is_of_grafana_10_and_asks_for_its_data_source():
    assert BOARD["schemaVersion"] >= 38
    assert {variable["name"]: variable["type"] for variable in BOARD["templating"]["list"]} == {
        "datasource": "datasource",
        "instance": "query",
        "shard": "query",
    }
    assert {"title", "uid", "panels", "time", "refresh"} <= set(BOARD)
    assert any(LAG in name for name in set().union(*map(find_used, PANELS)))
