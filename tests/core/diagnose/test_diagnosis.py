"""Test the whole diagnosis of recorded drives: the keys of its result, and the recovery of a hidden effect."""

import json
import math
from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

import msgspec
import numpy as np
import pandas as pd
import pytest
from msgspec.structs import replace as replace_fields

from socast.core import effects
from socast.core.diagnose import deviations
from socast.core.diagnose import diagnosis as diagnosing
from socast.core.diagnose.add.holdout import drop_dates, select_final_days
from socast.core.diagnose.dataset import LEAST_RIDES, gather_windows
from socast.core.diagnose.diagnosis import diagnose
from socast.core.diagnose.records import CarDeviation, DiagnosedModel, Diagnosis, HeldOutRides
from socast.core.effects import ROAD_LOAD
from socast.core.errors import ModelError
from socast.core.evaluate.compare.models import compare_predictions, compute_errors_by_condition, select_rides
from socast.core.fit.recipes import fit_to_windows, make_term
from socast.core.models.features import list_raw_columns
from socast.tools.bench.hidden import cases
from socast.tools.bench.hidden.cases import Case, SeedData
from socast.tools.report.diagnosis import sentences
from socast.tools.simulator.settings import Hidden
from tests.support.synthetic_windows import make_tables, make_windows

pytestmark = pytest.mark.long

HIDDEN = "headwind"
SHARE = 0.06


@pytest.fixture(scope="module")
def source():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cases, "FLEET", replace(cases.FLEET, vehicles=4, days=24, day_step=13, shift_hours=0.8))
        patch.setattr(cases, "TURNS", 2)
        whole = SeedData(5)
        whole.recording("none")
        return whole


@pytest.fixture(scope="module")
def recorded(source):
    """Return ride and window tables with a hidden effect."""
    tables = source.tables(Case(5, (Hidden(HIDDEN, SHARE),)))
    return tables.rides, tables.windows


@pytest.fixture(scope="module")
def model(recorded):
    return fit_to_windows("road_load", *recorded)


@pytest.fixture(scope="module")
def diagnosis(recorded, model):
    return diagnose(*recorded, model)


@pytest.fixture(scope="module")
def used(recorded):
    """Return the tables without the final hold-out dates."""
    return drop_dates(*recorded, select_final_days((), list(recorded[0]["date"])))


@pytest.fixture(scope="module")
def of_nothing(source):
    tables = source.tables(Case(5))
    return diagnose(tables.rides, tables.windows, fit_to_windows("road_load", tables.rides, tables.windows))


class TestPromise:
    def test_result_holds_values_of_its_declared_types(self, diagnosis, of_nothing):
        for each in (diagnosis, of_nothing):
            assert msgspec.convert(each.to_json(), Diagnosis) == each
            assert json.loads(json.dumps(each.to_json())) == json.loads(msgspec.json.encode(each))

    def test_parts_of_the_result_are_dataframes_too(self, diagnosis):
        assert list(diagnosis.candidates["effect"]) == [row.effect for row in diagnosis.tested]
        assert list(diagnosis.errors["mae_kwh"]) == [step.mae_kwh for step in diagnosis.steps]
        assert list(diagnosis.coefficients["value"]) == [one.coefficient.value for one in diagnosis.missing]

    def test_result_describes_given_data_and_model(self, diagnosis, used, model):
        seen = gather_windows(*used, model)
        data = diagnosis.data
        assert (data.rides, data.windows) == (len(seen.rides), len(seen.table))
        assert (data.vehicles, data.measured) == (4, "vi")
        assert data.days == len(set(zip(seen.table["vehicle_id"], seen.table["date"], strict=True)))
        assert data.first_date == min(seen.table["date"])
        assert data.last_date == max(seen.table["date"])
        assert 50.0 < data.resolution_s < 70.0
        rides, windows = used
        fit = windows["ride_key"].isin(rides.loc[rides["unfit_reason"].isna(), "ride_key"])
        silent = int((windows.loc[fit, "energy_source"] != "vi").sum())
        assert silent > 0
        left_out = Counter(rides["unfit_reason"].dropna()) + Counter({"windows without voltage and current": silent})
        assert Counter(data.left_out) == left_out
        assert diagnosis.model == DiagnosedModel(name=model.name, version=model.version, recipe="road_load")

    def test_dates_of_the_caller_are_left_out(self, recorded, model, monkeypatch):
        used = []
        monkeypatch.setattr(diagnosing, "_diagnose", lambda seen, *_, **__: used.append(seen) or Diagnosis())
        first, *_ = sorted(set(recorded[0]["date"]))
        result = diagnose(*recorded, model, leave_out=[first, "1999-01-01"])
        assert first not in set(used[0].rides["date"])
        assert result.data.held_out == HeldOutRides(dates=[first], rides=int((recorded[0]["date"] == first).sum()))
        assert diagnose(*recorded, model, leave_out=()).data.held_out.rides == 0

    def test_errors_are_per_ride_and_above_noise_floor(self, diagnosis, used, model):
        seen, error = gather_windows(*used, model), diagnosis.error
        off = model.predict_energy(seen.rides) - seen.rides["energy_kwh"]
        assert error.mae_kwh == pytest.approx(np.mean(np.abs(off)))
        assert error.bias_kwh == pytest.approx(np.mean(off))
        assert error.relative == pytest.approx(error.mae_kwh / np.mean(seen.rides["energy_kwh"]))
        # both are estimates of few rides, and the power that no sample shows is as uncertain as that of a real car
        assert 0.0 < error.noise_floor_kwh < 1.1 * error.mae_refitted_kwh
        assert error.mae_refitted_kwh <= error.mae_kwh

    def test_every_effect_of_library_is_listed_once(self, diagnosis):
        names = [row.effect for row in diagnosis.tested]
        assert len(names) == len(set(names))
        assert set(names) == set(effects.get_library()) - {effect.name for effect in ROAD_LOAD}
        for row in diagnosis.tested:
            tested = row.gain is not None
            assert tested == (row.status.startswith(("missing", "not needed", "not there", "wrong", "not disting"))), (
                row
            )
            if tested:
                assert 0.0 <= row.probability <= 1.0
        chances = [row.probability for row in diagnosis.tested if row.probability is not None]
        assert chances == sorted(chances, reverse=True)

    def test_result_is_reproducible(self, recorded, model, diagnosis):
        assert diagnose(*recorded, model) == diagnosis

    def test_result_does_not_depend_on_row_order(self, recorded, model, diagnosis):
        rides, windows = (table.sample(frac=1.0, random_state=5) for table in recorded)
        other = diagnose(rides, windows, model)
        assert other.verdict == diagnosis.verdict
        assert other.error.to_json() == pytest.approx(diagnosis.error.to_json())
        coefficient = diagnosis.missing[0].coefficient.value
        assert other.missing[0].coefficient.value == pytest.approx(coefficient)


class TestHiddenEffect:
    def test_is_named_first(self, diagnosis):
        assert diagnosis.verdict == HIDDEN
        first = diagnosis.missing[0]
        assert first.effect == HIDDEN
        assert first.credible_set[0] == HIDDEN
        assert first.causes == diagnosis.causes
        assert diagnosis.causes[0].effect == HIDDEN
        assert sum(cause.probability for cause in diagnosis.causes) == pytest.approx(1.0)
        assert first.scope == []
        assert first.columns == [f"effect_{first.variant}"]
        assert list_raw_columns(first.columns[0])
        assert first.probability > 0.8
        (row,) = (row for row in diagnosis.tested if row.effect == HIDDEN)
        assert row.status == "missing"
        assert row is diagnosis.tested[0] or row.gain > 0.0

    def test_has_plausible_coefficient_and_interval(self, diagnosis):
        first = diagnosis.missing[0]
        coefficient, effect = first.coefficient, effects.get(first.variant)
        assert coefficient.unit == effect.unit
        assert (coefficient.low, coefficient.high) == (effect.low, effect.high)
        low, high = coefficient.ci95
        assert low < coefficient.value < high
        assert low > 0.0
        assert coefficient.plausible == (effect.low <= coefficient.value <= effect.high)
        low, high = first.gain_ci95
        assert low < first.gain < high
        assert math.isfinite(first.energy_share)
        assert first.words
        assert len(first.equivalents) == 3

    def test_lowers_the_error_of_held_out_days(self, diagnosis):
        steps = diagnosis.steps
        assert [step.effect for step in steps] == [None, *(each.effect for each in diagnosis.missing)]
        assert steps[1].mae_kwh < steps[0].mae_kwh
        assert {step.noise_floor_kwh for step in steps} == {diagnosis.error.noise_floor_kwh}
        assert steps[0].mae_kwh == pytest.approx(diagnosis.error.mae_refitted_kwh)

    def test_leaves_nothing_outside_the_library(self, diagnosis):
        assert diagnosis.unknown == []

    def test_is_not_reported_if_excluded(self, recorded, model):
        without = diagnose(*recorded, model, without=(HIDDEN,), places=False)
        assert HIDDEN not in {row.effect for row in without.missing}
        assert HIDDEN not in {row.effect for row in without.tested}


def test_nothing_is_reported_without_hidden_effect(of_nothing):
    assert of_nothing.verdict is None
    assert of_nothing.missing == []
    assert of_nothing.unknown == []
    assert len(of_nothing.steps) == 1
    assert "missing" not in {row.status for row in of_nothing.tested}


@pytest.fixture(scope="module")
def small():
    """Tables of two cars, and a model fitted to them."""
    tables = make_tables(make_windows(cars=2, days=8))
    return tables, fit_to_windows("road_load", *tables, covariance=False)


def test_error_of_a_ride_is_the_one_that_a_comparison_states(small):
    """A constant is added once to a ride, however many windows it has."""
    (rides, windows), model = small
    fits = {key: replace_fields(fit, coefficients=(*fit.coefficients, 0.2)) for key, fit in model.fits.items()}
    with_constant = replace_fields(model, terms=(*model.terms, make_term()), fits=fits)
    error = diagnose(rides, windows, with_constant, places=False).error
    compared = compare_predictions(select_rides(rides, {"it": with_constant})).models["it"]
    assert error.mae_kwh == pytest.approx(compared.mae_kwh.value)
    assert error.relative == pytest.approx(compared.relative)
    assert error.bias_kwh == pytest.approx(compared.bias_kwh.value)


def test_bins_that_compare_marks_are_those_of_the_diagnosis(small):
    (rides, windows), model = small
    warm = set(rides.loc[rides["ambient_c"] > rides["ambient_c"].median(), "ride_key"])
    rides, windows = (
        table.assign(energy_kwh=table["energy_kwh"] * np.where(table["ride_key"].isin(warm), 0.8, 1.0))
        for table in (rides, windows)
    )
    compared = select_rides(rides, {"model": model})
    by = compute_errors_by_condition(compared, compared.predicted["model"])
    marked = {(name, one.bin) for name, bins in by.items() for one in bins if one.is_significant and one.n < len(rides)}
    found = diagnose(rides, windows, model, leave_out=(), places=False).biased_bins
    assert marked
    assert {(one.condition, one.bin) for one in found} == marked


@pytest.mark.parametrize("dated", [True, False])
def test_nothing_is_said_of_what_began_at_an_invented_date(small, monkeypatch, dated):
    found = [CarDeviation(who="a"), CarDeviation(who="b", since="2020-06-22")]
    given = {one.who: one for one in found}
    scoped = [SimpleNamespace(is_likely=True, family=SimpleNamespace(is_scoped=True, who=one.who)) for one in found]
    monkeypatch.setattr(deviations, "_describe", lambda _, __, one: given[one.family.who])
    said = deviations.describe_deviations(None, SimpleNamespace(findings=scoped), dated=dated)
    assert said == (found if dated else found[:1])
    tables, model = small
    result = diagnose(*tables, model, dated=dated, places=False)
    assert result.data.dated == dated
    said = any("dates are invented" in line for line in sentences.describe_data(result))
    assert said == (not dated)


class TestInsufficientData:
    def refused(self, rides, windows, model):
        with pytest.raises(ModelError) as refusal:
            diagnose(rides, windows, model)
        assert "\n" not in str(refusal.value)
        return str(refusal.value)

    @pytest.mark.parametrize("count", [1, 2, LEAST_RIDES - 1])
    def test_few_rides_are_refused_in_one_line(self, small, count):
        (rides, windows), model = small
        few = rides.iloc[:count]
        kept = windows[windows["ride_key"].isin(few["ride_key"])]
        message = self.refused(few, kept, model)
        assert message == f"{count} rides with measured energy to diagnose, and it takes {LEAST_RIDES}: give more rides"

    def test_no_rides_are_refused_in_one_line(self, small):
        (rides, windows), model = small
        assert self.refused(rides.iloc[:0], windows.iloc[:0], model).startswith("there are no rides to diagnose")

    def test_rides_without_measured_energy_are_refused_in_one_line(self, small):
        tables, model = small
        nothing = dict.fromkeys(("energy_kwh", "energy_vi_kwh", "energy_soc_kwh"), np.nan)
        message = self.refused(*(table.assign(**nothing) for table in tables), model)
        assert message.startswith("0 rides with measured energy to diagnose (48 no measured energy left out)")

    def test_one_day_of_one_car_is_refused_in_one_line(self, small):
        rides, windows = (table[table["vehicle_id"] == "taxi-0"] for table in small[0])
        message = self.refused(rides.assign(date="2018-01-01"), windows, small[1])
        assert message.startswith("all 24 rides are of 1 vehicle-days")

    def test_a_model_of_other_vehicles_is_refused_in_one_line(self, small):
        tables, model = small
        other = msgspec.structs.replace(model, fits={"tesla-model-s": next(iter(model.fits.values()))})
        message = self.refused(*tables, other)
        assert "is of tesla-model-s, and these rides are of kia-soul-ev-2015" in message

    def test_tables_of_different_recordings_are_refused_in_one_line(self, small):
        (rides, windows), model = small
        message = self.refused(rides, windows.assign(ride_key="van" + windows["ride_key"]), model)
        assert message.startswith("no window belongs to any of the rides")

    def test_least_number_of_rides_is_diagnosed(self, small):
        (rides, windows), model = small
        rides = rides[rides["ride_key"].isin([f"taxi-{car}#{n}" for car in (0, 1) for n in range(10)])]
        diagnosis = diagnose(rides, windows[windows["ride_key"].isin(rides["ride_key"])], model)
        assert diagnosis.data.rides == LEAST_RIDES
        assert msgspec.convert(diagnosis.to_json(), Diagnosis) == diagnosis


def test_rides_are_diagnosed_by_state_of_charge_without_meter():
    rides, windows = (
        table.assign(energy_vi_kwh=np.nan, energy_soc_kwh=table["energy_kwh"])
        for table in make_tables(make_windows(cars=3, days=12), {"headwind": 0.10})
    )
    model = fit_to_windows("road_load", rides, windows, covariance=False)
    diagnosis = diagnose(rides, windows, model, places=False)
    assert diagnosis.data.measured == "soc"
    assert diagnosis.data.windows == diagnosis.data.rides == len(rides)
    assert msgspec.convert(diagnosis.to_json(), Diagnosis) == diagnosis
    assert isinstance(pd.Series(diagnosis.error.to_json()).min(), float)
