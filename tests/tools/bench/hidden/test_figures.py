"""The figures of the benchmark of hidden effects, and its sparse regression, are right."""

import numpy as np
import pytest

from tools.bench.hidden.figures import (
    compute_error_reduction,
    compute_figures,
    summarise_timing,
    tabulate_by_effect,
    tabulate_by_part,
    tabulate_by_share,
    tabulate_wrong_names,
)
from tools.bench.hidden.page import make_section, read_section, replace_section
from tools.bench.hidden.stlsq import fit_stlsq


def make_record(part="one", outcome="right", **changes):
    """Return the record of a data set with snow hidden."""
    base = {
        "part": part,
        "seed": 0,
        "hidden": [["snow", 0.03]],
        "measurement": "vi",
        "weather": "none",
        "vehicle": None,
        "since": None,
        "outcome": outcome,
        "scope_right": True,
        "found": 1,
        "names": 0 if outcome == "none" else 1,
        "doubt": False,
        "missing": [] if outcome == "none" else [{"effect": "snow" if outcome == "right" else "age"}],
        "intervals": [{"right": True, "holds": True}],
        "left": 0.5,
        "alike": 0.9,
        "z": 5.0,
        "errors": {"before": 0.4, "after": 0.3, "truth": 0.2},
        "seconds": 2.0,
    }
    return base | changes


class TestFigures:
    def select_figure(self, records, what):
        return next(f for f in compute_figures(records) if what in f.what)

    def test_hit_rate_counts_right_names_and_groups(self):
        records = [
            make_record(),
            make_record(outcome="group"),
            make_record(outcome="none"),
            make_record(outcome="wrong"),
        ]
        figure = self.select_figure(records, "V·I")
        assert (figure.value, figure.of, figure.met) == (0.5, 4, False)
        assert self.select_figure(records, "SOC").of == 0

    def test_absorbed_effects_are_counted_separately(self):
        records = [make_record(), make_record(outcome="none", hidden=[["roof_load", 0.03]])]
        assert self.select_figure(records, "V·I").of == 1
        assert any("with the shape of the base" in line for line in tabulate_by_part(records))

    def test_small_shares_are_not_counted(self):
        assert self.select_figure([make_record(hidden=[["snow", 0.0075]])], "V·I").of == 0

    def test_names_on_empty_data_sets_are_counted(self):
        records = [make_record("none", "wrong", hidden=[], names=2), make_record("none", "none", hidden=[])]
        assert self.select_figure(records, "nothing is hidden").value == 1.0

    def test_wrong_names_reported_as_certain_are_counted(self):
        records = [
            make_record("outside", "wrong"),
            make_record("outside", "wrong", doubt=True),
            make_record("outside", "none"),
        ]
        assert self.select_figure(records, "not in the library").value == pytest.approx(1 / 3)

    def test_error_reduction_is_relative_to_the_truth(self):
        assert compute_error_reduction(
            [make_record(), make_record(errors={"before": 0.4, "after": 0.2, "truth": 0.2})]
        ) == pytest.approx(0.75)

    def test_visible_effects_have_a_separate_hit_rate(self):
        records = [make_record(), make_record(outcome="none", z=1.0), make_record(outcome="none", z=4.0)]
        assert "V·I at 1.5 % or more: 50 % right of 2 of 3" in make_section(records, "")

    def test_timing_covers_timed_data_sets_only(self):
        assert summarise_timing([make_record(seconds=9.0), make_record(stlsq_seconds=0.1)])[1] == pytest.approx(20.0)

    def test_no_goal_is_met_without_records(self):
        assert not any(figure.met for figure in compute_figures([]))

    def test_section_replaces_the_existing_one(self, tmp_path):
        records = [
            make_record(),
            make_record("outside", "wrong"),
            make_record("date"),
            {**make_record(), "refused": "no"},
        ]
        new = make_section(records, "2 seeds")
        for table in (
            tabulate_by_effect(records),
            tabulate_by_share(records),
            tabulate_by_part(records),
            tabulate_wrong_names(records),
        ):
            assert len({line.count("|") for line in table}) == 1
            assert all(line in new for line in table)
        page = replace_section("# Benchmarks\n\nspeed\n", new)
        assert page.startswith("# Benchmarks\n\nspeed\n\n")
        assert replace_section(page, new) == page
        (tmp_path / "page.md").write_text(page, encoding="utf-8")
        assert read_section(tmp_path / "page.md") == new
        assert read_section(tmp_path / "none.md") == ""


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
