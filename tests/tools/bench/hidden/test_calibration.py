"""The fit of probabilities recovers coefficients, and its data sets have the stated kinds and shapes."""

import json
from collections import Counter
from dataclasses import replace
from math import log

import numpy as np
import pytest
from socast.core.diagnose.posterior.causes import CauseEvidence, SelectedForm
from socast.core.diagnose.posterior.probabilities import CALIBRATION, NONE, SEVERAL, UNKNOWN, compute_probabilities
from socast.tools.bench.hidden.calibration import (
    LEAST_LOG,
    WEIGHTS,
    compute_loss,
    describe_predictions,
    fit_calibration,
    get_log_probability,
    main,
    predict_left_out,
)
from socast.tools.bench.hidden.calibration_data import (
    LabelledEvidence,
    compute_evidence,
    decode_evidence,
    draw_cases,
    drop_effects,
    encode_evidence,
    label_evidence,
    make_seed_records,
)

from socast.tools.bench.hidden import calibration_data
from socast.tools.bench.hidden.cases import Case
from socast.tools.bench.hidden.parts import ABSORBED
from socast.tools.simulator.bent_shapes import BENT
from socast.tools.simulator.hidden_shapes import OTHER, strip_shape
from socast.tools.simulator.settings import Hidden

NAMES = ("snow", "headwind", "payload", "wet_road")


def make_evidence(rng, best=20.0):
    """Return evidence in which the effects are in random order."""
    order = rng.permutation(NAMES).tolist()
    single = dict(zip(order, (best - rng.exponential(4.0, 4).cumsum()).tolist(), strict=True))
    return CauseEvidence(
        single=single,
        forms={name: SelectedForm(name, 1.0) for name in order},
        pairs={(order[0], order[1]): best + rng.exponential(3.0), (order[0], order[2]): best - 1.0},
        stiff={name: value - rng.exponential(2.0) for name, value in single.items()},
        unknown=rng.exponential(5.0),
        beside={name: rng.exponential(2.0) for name in order[:2]},
    )


def make_records(count, calibration=CALIBRATION):
    """Return records whose truth is drawn from the probabilities of a calibration."""
    rng = np.random.default_rng(4)
    kinds = {NONE: "none", SEVERAL: "two", UNKNOWN: "outside"}
    out = []
    for number in range(count):
        evidence = make_evidence(rng, float(rng.uniform(0.0, 15.0)))
        causes = compute_probabilities(evidence, calibration).probabilities
        truth = str(rng.choice(list(causes), p=list(causes.values())))
        kind = kinds.get(truth, "one")
        truths = ((NAMES[0],), (NAMES[1],)) if kind == "two" else ((truth,),)
        out.append(LabelledEvidence(kind, number % 4, truths, evidence))
    return out


def measure_loss(records, calibration):
    """Return the loss of a calibration."""
    return compute_loss(
        [get_log_probability(r, compute_probabilities(r.evidence, calibration)) for r in records], records
    )


class TestFit:
    def test_fit_reaches_the_loss_of_the_coefficients_that_drew_the_truth(self):
        records = make_records(60)
        fitted = fit_calibration(records, CALIBRATION._replace(rivals=0.1, none=4.0, several=-1.0))
        assert measure_loss(records, fitted) < measure_loss(records, CALIBRATION)

    def test_loss_gives_each_kind_its_share(self):
        records = [r for r in make_records(80) if r.kind in {"none", "one"}]
        logs = [-1.0 if r.kind == "none" else -2.0 for r in records]
        none, one = WEIGHTS["none"], WEIGHTS["one"]
        assert compute_loss(logs, records) == pytest.approx((none + 2.0 * one) / (none + one))

    def test_impossible_truth_has_a_bounded_loss(self):
        evidence = make_evidence(np.random.default_rng(0))
        record = LabelledEvidence("one", 0, (("age",),), evidence)
        assert get_log_probability(record, compute_probabilities(evidence)) == LEAST_LOG

    def test_each_seed_is_predicted_by_other_seeds(self, monkeypatch):
        seen = []

        def remember(records, _):
            seen.append({r.seed for r in records})
            return CALIBRATION

        monkeypatch.setattr("socast.tools.bench.hidden.calibration.fit_calibration", remember)
        records = make_records(8)
        assert len(predict_left_out(records)) == 8
        assert sorted(map(sorted, seen)) == [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]

    def test_description_holds_every_kind_and_the_reliability(self):
        records = make_records(200)
        records.append(LabelledEvidence("mixed", 0, (("snow",),), make_evidence(np.random.default_rng(2))))
        text = "\n".join(describe_predictions(records, [compute_probabilities(r.evidence) for r in records]))
        assert all(f"{kind}: " in text for kind in WEIGHTS)
        assert "| 60 to 70 % |" in text


class TestData:
    def test_seed_has_singles_pairs_and_nothing_in_first_and_bent_shapes(self):
        cases = [case for seed in (420, 421, 422) for case in draw_cases(seed)]
        counts = Counter((len(case.hidden), case.measurement) for case in cases)
        assert counts[0, "vi"] == counts[0, "soc"] == 3
        assert counts[2, "vi"] == 9
        assert counts[1, "soc"] >= 9
        effects = [effect for case in cases for effect, _ in case.hidden]
        assert not any(effect.endswith(OTHER) for effect in effects)
        assert 0.4 < np.mean([BENT in effect for effect in effects]) < 0.9
        assert not {strip_shape(effect) for effect in effects} & set(ABSORBED)
        assert {case.weather for case in cases} == {"none", "noisy"}
        assert draw_cases(420) == cases[: len(draw_cases(420))]

    def test_one_effect_is_also_evidence_without_it(self):
        evidence = make_evidence(np.random.default_rng(1))
        one, outside = label_evidence([("snow~bent3", 0.03)], 7, evidence)
        assert (one.kind, one.truths, outside.kind, outside.truths) == ("one", (("snow",),), "outside", ((UNKNOWN,),))
        assert "snow" in one.evidence.single
        dropped = outside.evidence
        assert "snow" not in {*dropped.single, *dropped.forms, *dropped.stiff, *dropped.beside}
        assert all("snow" not in pair for pair in dropped.pairs)
        assert [r.kind for r in label_evidence([], 7, evidence)] == ["none"]

    def test_two_effects_are_also_evidence_of_the_one_that_leads_without_the_other(self):
        evidence = make_evidence(np.random.default_rng(1))
        first, _, third, _ = sorted(evidence.single, key=lambda name: -evidence.single[name])
        two, mixed = label_evidence([(first, 0.03), (third, 0.03)], 7, evidence)
        assert (two.kind, two.truths) == ("two", ((first,), (third,)))
        assert (mixed.kind, mixed.truths) == ("mixed", ((first,),))
        assert third not in mixed.evidence.single
        faint = replace(evidence, single={name: value - 18.0 for name, value in evidence.single.items()})
        assert [r.kind for r in label_evidence([(first, 0.03), (third, 0.03)], 7, faint)] == ["two"]

    def test_dropping_nothing_changes_nothing(self):
        evidence = make_evidence(np.random.default_rng(1))
        assert drop_effects(evidence, ()) == evidence

    def test_stored_evidence_is_the_same(self):
        evidence = replace(make_evidence(np.random.default_rng(2)), unknown=float("-inf"))
        assert decode_evidence(json.loads(json.dumps(encode_evidence(evidence)))) == evidence

    def test_evidence_favours_what_is_hidden(self, source):
        evidence = compute_evidence(Case(5, (Hidden("headwind", 0.15),)), source)
        assert max(evidence.single, key=lambda name: evidence.single[name]) == "headwind"
        assert evidence.single["headwind"] > log(20.0)

    def test_kept_evidence_is_not_computed_again(self, tmp_path, monkeypatch):
        calls = []

        def remember(case, _):
            calls.append(case)
            return make_evidence(np.random.default_rng(len(calls)))

        monkeypatch.setattr(calibration_data, "compute_evidence", remember)
        first = make_seed_records(420, tmp_path)
        assert make_seed_records(420, tmp_path) == first
        assert len(calls) == len(draw_cases(420))

    def test_command_prints_the_fit(self, tmp_path, monkeypatch, capsys):
        monkeypatch.setattr("socast.tools.bench.hidden.calibration.make_seed_records", lambda _, __: make_records(12))
        monkeypatch.setattr("socast.tools.bench.hidden.calibration.fit_calibration", lambda *_: CALIBRATION)
        assert main(["--seeds", "420-421", "--keep", str(tmp_path), "--processes", "1"]) == 0
        out = capsys.readouterr().out
        assert str(CALIBRATION) in out
        assert "log loss" in out
        assert main(["--seeds", "x"]) == 2
