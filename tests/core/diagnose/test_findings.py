"""Diagnoses of successive nights become findings that are proposed, sure, announced once, and gone."""

import json

import numpy as np
import pandas as pd
import pytest
from scipy.special import logsumexp

from socast.core.diagnose.findings import (
    SURE,
    compute_sure_evidence,
    list_changes,
    list_findings,
    make_finding_message,
    measure_fleet_use,
    merge_findings,
)
from socast.core.diagnose.inference.alternatives import weigh_alone
from socast.core.wire.messages import address
from tests.support.diagnosis_result import make_deviation, make_diagnosis, make_missing_effect
from tests.support.findings import USE, make_finding


def find(*deviations, missing=()):
    """Return the findings of a diagnosis with these deviations."""
    return list_findings(make_diagnosis(deviations=list(deviations), missing=list(missing)), USE)


def test_deviation_becomes_a_sure_finding_with_causes_size_and_savings():
    (finding,) = find(make_deviation())
    assert finding.words == (
        "taxi-005 uses 4.1 ± 0.9 % more since 14 November 2018 (12 to 16 November): low tyre pressure 52 %, "
        "brake drag 41 %; mending it would save 12.1 kWh or 80.7 km of range a month"
    )
    assert (finding.who, finding.effect, finding.status, finding.since) == (
        "taxi-005", "tyre_pressure", "sure", "2018-11-14",
    )  # fmt: skip
    assert finding.probability == pytest.approx(0.9998)
    assert [cause.effect for cause in finding.causes] == ["tyre_pressure", "brake_drag"]
    assert (finding.share, finding.share_lower, finding.share_upper) == (0.041, 0.032, 0.05)
    assert finding.range_km_per_month == pytest.approx(12.1 / 0.15)
    assert (finding.first_seen, finding.sure_since) == ("2018-11-30", "2018-11-30")
    assert finding.time_s == 1543622400.0  # 1 December, 0:00


def test_missing_effect_takes_its_share_of_the_energy_of_a_month():
    (finding,) = find(missing=[make_missing_effect(probability=0.87)])
    assert (finding.who, finding.effect, finding.status) == ("all", "cold_rolling", "proposed")
    assert finding.kwh_per_month == pytest.approx(0.029 * 300.0 / 2.0)
    assert finding.share_lower == pytest.approx(0.029 * 0.9 / 1.1)
    assert finding.words.endswith("below 10 °C; it accounts for 4.35 kWh or 29 km of range a month")


@pytest.mark.parametrize(("probability", "status"), [(0.89, "proposed"), (0.9, "sure")])
def test_missing_effect_is_sure_from_ninety_percent_on(probability, status):
    (finding,) = find(missing=[make_missing_effect(probability=probability)])
    assert finding.status == status


@pytest.mark.parametrize("interval", [[-0.01, 0.09], None])
def test_deviation_that_may_be_zero_is_only_proposed(interval):
    (finding,) = find(make_deviation(share_ci95=interval))
    assert (finding.status, finding.sure_since) == ("proposed", None)


@pytest.mark.parametrize(("above", "status"), [(-0.01, "proposed"), (0.01, "sure")])
def test_deviation_is_sure_from_a_bayes_factor_on_that_grows_with_the_number_of_tests(above, status):
    (finding,) = find(make_deviation(evidence=compute_sure_evidence(500) + above, tests=500))
    assert finding.status == status
    (finding,) = find(make_deviation(evidence=compute_sure_evidence(500) + above, tests=5000))
    assert finding.status == "proposed"


def look_every_night(seed, *, cars=300, nights=160, candidates=3, noise=0.1, size=0.3):
    """Return the Bayes factor of a change of cars without one on each night, (nights, cars).

    The energy of each shift has an error, as a share; candidates are correlated like those of the library. The factor
    is an average over candidates, and over steps and ramps at all dates.
    """
    rng = np.random.default_rng(seed)
    shape = np.linalg.cholesky(0.7 + 0.3 * np.eye(candidates))
    scores = rng.standard_normal((cars, nights, candidates)) @ shape.T / noise
    seen = []
    for night in range(6, nights + 1):
        day, first = np.arange(night), np.arange(3, night - 2)[:, np.newaxis]
        steps = (day >= first).astype(float)
        ramps = np.maximum(day - np.r_[[[0]], first[:-1]], 0.0)
        weights = np.concatenate([steps, ramps / ramps.max(axis=1, keepdims=True)])
        change = size * (weights - weights.mean(axis=1, keepdims=True))
        own = np.tile((change**2).sum(axis=1) / noise**2, candidates)
        match = np.tensordot(scores[:, :night], change.T, (1, 0)).reshape(cars, -1)
        seen.append(logsumexp(weigh_alone(own, match, (-np.inf, np.inf)), axis=1) - np.log(len(own)))
    return np.array(seen)


def test_repeated_looks_at_cars_without_a_change_make_fewer_sure_findings_than_stated():
    """With one test per car, as a family of alternatives is one."""
    evidence = look_every_night(seed=1)
    ever = evidence.max(axis=0)
    assert np.mean(evidence > np.log(1.0 / (1.0 - SURE)), axis=1).max() < 1.0 - SURE  # holds on each night alone,
    assert np.mean(ever > np.log(1.0 / (1.0 - SURE))) > 1.0 - SURE  # but not on all nights
    assert np.mean(ever > compute_sure_evidence(1)) < 1.0 - SURE


def test_unknown_numbers_of_a_diagnosis_stay_unknown():
    (finding,) = find(make_deviation(kwh_per_month=None, share_ci95=None))
    assert (finding.kwh_per_month, finding.range_km_per_month, finding.share_lower) == (None, None, None)
    assert "mending" not in finding.words


def test_deviation_that_saves_energy_is_not_to_be_mended():
    (finding,) = find(make_deviation(share=-0.04, share_ci95=[-0.05, -0.03], kwh_per_month=-12.0))
    assert "mending" not in finding.words


def test_finding_becomes_sure_once_and_is_gone_once():
    def see(probability):
        return find(missing=[make_missing_effect(probability=probability)])

    nights = [see(0.6), see(0.95), see(0.8), [], [], see(0.95)]
    findings, announced = [], []
    for found in nights:
        before, findings = findings, merge_findings(findings, found, USE)
        announced.append([one.status for one in list_changes(before, findings)])
    assert announced == [[], ["sure"], [], ["gone"], [], ["sure"]]


def test_proposed_finding_that_vanishes_leaves_no_trace():
    assert merge_findings([make_finding(status="proposed", sure_since=None)], [], USE) == []


def test_finding_keeps_its_key_and_dates_when_its_causes_change_places():
    causes = [{"effect": "brake_drag", "probability": 0.6}, {"effect": "tyre_pressure", "probability": 0.3}]
    (merged,) = merge_findings([make_finding()], find(make_deviation(effect="brake_drag", causes=causes)), USE)
    assert (merged.effect, merged.first_seen, merged.sure_since) == ("tyre_pressure", "2018-11-28", "2018-11-30")
    assert merged.causes[0].effect == "brake_drag"
    assert list_changes([make_finding()], [merged]) == []


@pytest.mark.parametrize("other", [{"who": "taxi-006"}, {"effect": "roof_load", "causes": []}])
def test_other_car_or_other_cause_is_another_finding(other):
    merged = merge_findings([make_finding()], [make_finding(**other)], USE)
    assert [one.status for one in merged] == ["sure", "gone"]


def test_message_of_a_finding_has_a_key_of_the_contract():
    message = make_finding_message(make_finding(who="depot north"), "montreal/")
    assert message.key == "montreal/findings/depot_north/tyre_pressure"
    assert address(message.key) == ("finding", "depot_north/tyre_pressure")
    assert json.loads(message.payload)["status"] == "sure"
    assert message.receipt_ns == 1543622400 * 10**9


def test_fleet_use_counts_rides_with_measured_energy():
    rides = pd.DataFrame(
        {
            "energy_kwh": [1.0, 2.0, None],
            "distance_km": [10.0, 10.0, 50.0],
            "date": ["2018-11-01", "2018-11-30", "2018-12-01"],
        }
    )
    use = measure_fleet_use(rides)
    assert (use.energy, use.distance, use.last_day.isoformat()) == (3.0, 20.0, "2018-12-01")
    assert use.months == pytest.approx(31 / 30.4375)
