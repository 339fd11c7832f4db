"""Alerts, the dashboard and the guide find shards without a consumer, and give totals over all shards."""

import json
import re

import pytest
import yaml

from tests.support.paths import ROOT
from tests.support.promql_evaluator import Sample, evaluate

RULES = {
    rule["alert"]: rule["expr"]
    for group in yaml.safe_load((ROOT / "deploy" / "alerts.yml").read_text())["groups"]
    for rule in group["rules"]
}
GUIDE = (ROOT / "docs" / "guide" / "operate.md").read_text()
QUERIES = re.findall(r"^((?:sum|max)[ (].*socast_.*)$", GUIDE, re.MULTILINE)
TOTAL, BY_SHARD, SERVED, UNSERVED, ERROR = QUERIES


def scrape(*consumers: tuple[str, str, float]) -> list[Sample]:
    """Return the samples of consumers by instance, shard and whether it publishes; each has 10 cars and 4 messages."""
    samples = []
    for instance, shard, publishes in consumers:
        labels = {"instance": instance, "job": "socast", "shard": shard}
        values = {"socast_publishes": publishes, "socast_active_vehicles": 10.0, "socast_messages_total": 4.0}
        values["socast_shards"] = float(shard.partition("/")[2])
        samples += [Sample({"__name__": name, **labels}, value) for name, value in values.items()]
    return samples


BOTH = scrape(("a", "1/2", 1.0), ("b", "2/2", 1.0), ("c", "2/2", 0.0))
ONE_PASSIVE = scrape(("a", "1/2", 1.0), ("b", "2/2", 0.0))
ONE_DEAD = scrape(("a", "1/2", 1.0))
JOB = (("job", "socast"),)


def test_totals_of_the_guide_count_each_shard_once():
    assert evaluate(TOTAL, BOTH) == {(): 20.0}
    assert evaluate(BY_SHARD, BOTH) == {(("shard", "1/2"),): 4.0, (("shard", "2/2"),): 4.0}


def test_the_guide_tells_a_passive_shard_from_one_whose_consumers_are_dead():
    assert evaluate(SERVED, ONE_PASSIVE) == {(("shard", "1/2"),): 1.0, (("shard", "2/2"),): 0.0}
    assert evaluate(SERVED, ONE_DEAD) == {(("shard", "1/2"),): 1.0}
    assert [evaluate(UNSERVED, each) for each in (BOTH, ONE_PASSIVE, ONE_DEAD)] == [{(): 0.0}, {(): 1.0}, {(): 1.0}]


def test_the_error_of_the_fleet_weighs_each_consumer_by_its_rides():
    samples = []
    for instance, error, rides in (("a", 0.1, 30.0), ("b", 0.3, 10.0)):
        labels = {"instance": instance, "model": "m"}
        samples.append(Sample({"__name__": "socast_model_mae_kwh", **labels}, error))
        samples.append(Sample({"__name__": "socast_model_rides_total", "result": "predicted", **labels}, rides))
    assert evaluate(ERROR, samples) == {(): pytest.approx(0.15)}


def test_a_shard_of_which_all_consumers_are_passive_raises_an_alert_though_another_shard_publishes():
    alert = RULES["SocastNobodyPublishes"]
    assert evaluate(alert, ONE_PASSIVE) == {(*JOB, ("shard", "2/2")): 0.0}
    assert evaluate(alert, BOTH) == {}
    alone = [Sample({"__name__": "socast_publishes", "instance": "a", "job": "socast"}, 0.0)]
    assert evaluate(alert, alone) == {JOB: 0.0}


def test_a_shard_without_a_living_consumer_raises_an_alert():
    alert = RULES["SocastShardUnserved"]
    assert [evaluate(alert, each) for each in (BOTH, ONE_PASSIVE, ONE_DEAD)] == [{}, {JOB: 1.0}, {JOB: 1.0}]
    assert evaluate(alert, scrape(("a", "1/2", 0.0), ("b", "2/2", 0.0))) == {JOB: 2.0}


def test_consumers_that_overlap_raise_an_alert():
    found = [Sample({"__name__": "socast_overlapping_consumers", "instance": "a"}, value) for value in (0.0, 2.0)]
    assert [evaluate(RULES["SocastConsumersOverlap"], [each]) for each in found] == [{}, {(("instance", "a"),): 2.0}]


def test_the_dashboard_shows_a_passive_shard_and_cars_of_all_shards():
    panels = {
        each["title"]: each for each in json.loads((ROOT / "deploy" / "grafana-dashboard.json").read_text())["panels"]
    }
    asked = {title: panels[title]["targets"][0]["expr"] for title in ("Publishes", "Vehicles active")}
    asked = {title: text.replace("$instance", ".*").replace("$shard", ".*") for title, text in asked.items()}
    assert evaluate(asked["Publishes"], ONE_PASSIVE) == {(): 0.0}
    assert evaluate(asked["Publishes"], BOTH) == {(): 1.0}
    assert evaluate(asked["Vehicles active"], BOTH) == {(): 20.0}
