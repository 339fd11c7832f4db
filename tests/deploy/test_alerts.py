"""Alert rules name metrics that exist, and say what happened and what to do."""

import re

import pytest
import yaml

from socast.stream.metrics import METRICS, list_metric_names
from tests.support.paths import ROOT
from tests.support.promql import STANDARD, list_metrics

GROUPS = yaml.safe_load((ROOT / "deploy" / "alerts.yml").read_text())["groups"]
RULES = [rule for group in GROUPS for rule in group["rules"]]
LABELS = {row.exported: set(row.labels) for row in METRICS}


def test_names_of_alerts_are_unique_and_of_the_service():
    names = [rule["alert"] for rule in RULES]
    assert len(set(names)) == len(names) > 10
    assert all(name.startswith("Socast") for name in names)


@pytest.mark.parametrize("rule", RULES, ids=[rule["alert"] for rule in RULES])
def test_alert_has_metrics_that_exist_and_words(rule):
    used = list_metrics(rule["expr"])
    assert used
    assert used <= set(list_metric_names()) | STANDARD
    assert rule["expr"].count("(") == rule["expr"].count(")")
    assert rule["labels"]["severity"] in {"page", "ticket"}
    assert set(rule["annotations"]) == {"summary", "remedy"}
    assert re.fullmatch(r"\d+[mh]", rule.get("for", "0m"))
    assert set(rule) <= {"alert", "expr", "for", "labels", "annotations"}


@pytest.mark.parametrize("rule", RULES, ids=[rule["alert"] for rule in RULES])
def test_alert_names_labels_that_its_metrics_have(rule):
    known = {"instance", "job", "shard", "le"}.union(*(LABELS.get(name, set()) for name in list_metrics(rule["expr"])))
    named = set(re.findall(r'(\w+)=~?"', rule["expr"]))
    named |= {label for group in re.findall(r"\b(?:by|on) \(([^)]*)\)", rule["expr"]) for label in group.split(", ")}
    named |= set(re.findall(r"\$labels\.(\w+)", rule["annotations"]["summary"]))
    assert named <= known


def test_guide_says_what_to_do_for_each_alert_and_no_other():
    guide = (ROOT / "docs" / "guide" / "operate.md").read_text()
    told = re.findall(r"^\| `(Socast\w+)` \| (\w+) \| .{20,} \|$", guide, re.MULTILINE)
    assert told == [(rule["alert"], rule["labels"]["severity"]) for rule in RULES]


def test_an_unknown_metric_would_be_found():
    assert list_metrics('sum by (a) (rate(x_total{cause="y"}[5m])) > 0.01 * z') == {"x_total", "z"}
