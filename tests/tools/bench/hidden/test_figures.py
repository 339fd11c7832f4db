"""The figures of the benchmark of hidden effects, and its sparse regression, are right."""

import numpy as np
import pytest

from socast.tools.bench.hidden.baselines import fit_stlsq
from socast.tools.bench.hidden.figures import compute_error_reduction, compute_figures, summarise_timing
from socast.tools.bench.hidden.page import (
    list_values,
    make_lines,
    tabulate_baselines,
    tabulate_by_effect,
    tabulate_by_part,
    tabulate_by_share,
    tabulate_wrong_names,
)


def make_record(part="one", outcome="right", probability=0.95, **changes):
    """Return the record of a data set with snow hidden."""
    effect = "snow" if outcome == "right" else "age"
    base = {
        "part": part,
        "seed": 0,
        "hidden": [["snow", 0.03]],
        "measurement": "vi",
        "weather": "none",
        "outcome": outcome,
        "names": []
        if outcome == "none"
        else [{"effect": effect, "probability": probability, "right": outcome == "right"}],
        "set_size": None if outcome == "none" else 1,
        "set_holds": None if outcome == "none" else outcome == "right",
        "found": 1,
        "deviations": [],
        "unknown": part == "outside",
        "missing": [] if outcome == "none" else [{"effect": effect}],
        "intervals": [{"right": True, "holds": True}],
        "left": 0.5,
        "alike": 0.9,
        "visible": True,
        "baselines": {"stlsq": ["snow"], "boosted trees": ["age", "snow"]},
        "errors": {"before": 0.4, "after": 0.3, "truth": 0.2},
        "seconds": 2.0,
    }
    return base | changes


class TestFigures:
    def select_figure(self, records, what):
        return next(f for f in compute_figures(records) if what in f.what)

    def test_share_of_right_names_has_a_wilson_interval(self):
        records = [make_record(), make_record(outcome="none"), make_record(outcome="wrong"), make_record()]
        figure = self.select_figure(records, "V·I, 1.5 % or more, all")
        assert (figure.value, figure.of, figure.met, figure.interval) == (0.5, 4, False, "15.0 to 85.0 %")
        assert self.select_figure(records, "wrong name first").value == 0.25
        assert self.select_figure(records, "SOC only, 3 % or more, all").of == 0

    def test_visible_effects_have_a_separate_figure(self):
        records = [make_record(), make_record(outcome="none", visible=False), make_record(outcome="none")]
        assert self.select_figure(records, "V·I, 1.5 % or more, visible").value == 0.5
        assert self.select_figure(records, "V·I, 1.5 % or more, all").value == pytest.approx(1 / 3)

    def test_absorbed_effects_are_counted_separately(self):
        for effect in ("roof_load", "age~bent3"):
            records = [make_record(), make_record(outcome="wrong", hidden=[[effect, 0.03]])]
            assert self.select_figure(records, "V·I, 1.5 % or more, all").of == 1
            assert self.select_figure(records, "names given with 90 %").of == 1
            assert any("with the shape of the base" in line for line in tabulate_by_part(records))

    def test_small_shares_are_not_counted(self):
        assert self.select_figure([make_record(hidden=[["snow", 0.0075]])], "V·I, 1.5 % or more, all").of == 0

    def test_likely_names_on_empty_data_sets_are_counted(self):
        records = [
            make_record("none", "wrong", 0.6, hidden=[]),
            make_record("none", "wrong", 0.4, hidden=[]),
            make_record("none", "none", hidden=[]),
            make_record("none", "none", hidden=[]),
        ]
        assert self.select_figure(records, "nothing hidden").value == 0.25

    def test_wrong_and_sure_names_are_counted(self):
        records = [
            make_record("outside", "wrong", 0.93),
            make_record("outside", "wrong", 0.6),
            make_record("outside", "none"),
            make_record("one", "wrong", 0.99),
            make_record("one", "right", 0.99),
        ]
        assert self.select_figure(records, "not in the library: wrong and sure").value == pytest.approx(1 / 3)
        assert self.select_figure(records, "a name that is wrong and sure").value == 0.5

    def test_any_wrong_name_may_be_sure_not_only_the_first(self):
        names = [{"effect": name, "probability": p, "right": False} for name, p in (("age", 0.6), ("payload", 0.95))]
        records = [make_record("outside", "wrong", names=names), make_record("outside", "none")]
        assert self.select_figure(records, "not in the library: wrong and sure").value == 0.5
        remains = self.select_figure(records, "a cause outside it is told")
        assert (remains.value, remains.of) == (1.0, 1)

    def test_cars_and_changes_that_are_blamed_falsely_are_counted_in_all_data_sets(self):
        records = [make_record("none", "none", hidden=[]), make_record(deviations=[{"who": "taxi-1"}])]
        assert self.select_figure(records, "blamed falsely").value == 0.5

    def test_stated_probabilities_are_those_of_every_name(self):
        records = [
            make_record(probability=0.95),
            make_record("outside", "wrong", 0.95),
            make_record("none", "wrong", 0.55, hidden=[]),
            make_record("two", "right", 0.95),
        ]
        sure = self.select_figure(records, "names given with 90 %")
        assert (sure.value, sure.of) == (pytest.approx(2 / 3), 3)
        error = self.select_figure(records, "expected calibration error")
        assert error.of == 4
        assert error.value == pytest.approx((3 * (0.95 - 2 / 3) + 0.55) / 4)

    def test_credible_sets_have_a_range_and_a_size(self):
        records = [make_record(set_holds=i > 0, set_size=i % 4) for i in range(10)]
        figure = self.select_figure(records, "credible set of 90 %")
        assert (figure.value, figure.met) == (0.9, True)
        assert not self.select_figure([make_record()], "credible set of 90 %").met
        assert self.select_figure(records, "median size").value == 1.0
        assert self.select_figure([*records, make_record(outcome="none")], "credible set of 90 %").of == 10

    def test_two_visible_effects_must_both_be_found(self):
        pair = [["snow", 0.03], ["payload", 0.03]]
        records = [
            make_record("two", hidden=pair, found=2),
            make_record("two", hidden=pair),
            make_record("two", hidden=pair, visible=False),
        ]
        figure = self.select_figure(records, "two effects")
        assert (figure.value, figure.of) == (0.5, 2)

    def test_way_counts_only_where_the_truth_reduces_the_error(self):
        near = make_record(errors={"before": 0.4, "after": 0.5, "truth": 0.39})
        figure = self.select_figure([make_record(), near], "fall of the error")
        assert (figure.value, figure.of) == (pytest.approx(0.5), 1)

    def test_error_reduction_is_relative_to_the_truth(self):
        assert compute_error_reduction(
            [make_record(), make_record(errors={"before": 0.4, "after": 0.2, "truth": 0.2})]
        ) == pytest.approx(0.75)

    def test_timing_covers_timed_data_sets_only(self):
        assert summarise_timing([make_record(seconds=9.0), make_record(stlsq_seconds=0.1)])[1] == pytest.approx(20.0)

    def test_no_goal_is_met_without_records(self):
        assert not any(figure.met for figure in compute_figures([]))

    def test_lines_hold_every_table_and_values_their_number_of_data_sets(self):
        records = [
            make_record(),
            make_record("outside", "wrong"),
            make_record("two", hidden=[["snow", 0.03], ["payload", 0.03]]),
            {**make_record(), "refused": "no"},
        ]
        new = "\n".join(make_lines(records))
        for table in (
            tabulate_by_effect(records),
            tabulate_by_share(records),
            tabulate_by_part(records),
            tabulate_wrong_names(records),
            tabulate_baselines(records),
        ):
            assert len({line.count("|") for line in table}) == 1
            assert all(line in new for line in table)
        assert list_values(records)["wrong_on"].endswith(" of 3 simulated data sets")


class TestBaselines:
    def test_methods_are_compared_on_visible_effects(self):
        records = [make_record(), make_record(outcome="none"), make_record(visible=False), make_record("outside")]
        rows = {line.split("|")[1].strip().partition(":")[0]: line for line in tabulate_baselines(records)[2:]}
        assert "50 %" in rows["`socast diagnose`"]
        assert "100 %" in rows["STLSQ"]
        assert "| 0 %" in next(line for name, line in rows.items() if "boosted" in name)
        assert "PySINDy" not in rows


class TestStlsq:
    def test_stlsq_recovers_a_sparse_sum(self):
        rng = np.random.default_rng(1)
        columns = rng.normal(size=(500, 30)) * rng.uniform(0.1, 10.0, 30)
        truth = np.zeros(30)
        truth[[3, 17]] = 5.0, -2.0
        coefficients = fit_stlsq(columns, columns @ truth + 0.01 * rng.normal(size=500), threshold=5.0, alpha=0.0)
        assert set(np.flatnonzero(coefficients)) == {3, 17}
        np.testing.assert_allclose(coefficients[[3, 17]], [5.0, -2.0], rtol=0.01)

    def test_threshold_above_all_coefficients_leaves_none(self):
        columns = np.random.default_rng(2).normal(size=(50, 3))
        assert not fit_stlsq(columns, columns[:, 0], threshold=1e6).any()
