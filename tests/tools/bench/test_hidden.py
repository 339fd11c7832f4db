"""The benchmark of hidden effects makes the tables of the product and evaluates names correctly."""

import json
from dataclasses import replace

import msgspec
import numpy as np
import pandas as pd
import pytest

from socast.core import effects
from socast.core.cleaning.kernel import Cleaner
from socast.core.diagnose.dataset import Windows, gather_windows
from socast.core.errors import SettingsError
from socast.core.fit.recipes import fit_to_windows
from socast.core.pipeline import Pipeline
from socast.core.settings import Settings
from socast.core.wire.messages import Telemetry, Weather, encode
from socast.tools.bench.hidden.baselines import RANKED
from socast.tools.bench.hidden.cases import ABSORBED, FRESH, PARTS, Case, Selection, draw_sample
from socast.tools.bench.hidden.drives import FLEET, Scope, simulate_drives
from socast.tools.bench.hidden.evaluation import compute_errors, compute_true_energy, evaluate_case, predict_held_out
from socast.tools.bench.hidden.recording import add_weather_noise, record_drives
from socast.tools.bench.hidden.running import make_tasks, run_cases
from socast.tools.simulator.fleet import simulate
from socast.tools.simulator.hidden import EFFECTS
from socast.tools.simulator.hidden_shapes import OTHER_SHAPES, RIGHT_NAMES, get_right_names, strip_shape
from socast.tools.simulator.settings import STEPS_PER_SAMPLE, Hidden
from tests.support.diagnosed_names import make_name, make_result

pytestmark = pytest.mark.long
SMALL = replace(FLEET, seed=3, vehicles=2, days=2, day_step=100)
COLD = Hidden("cold_rolling", 0.06)


@pytest.fixture(scope="module")
def drives():
    return simulate_drives(SMALL)


@pytest.fixture(scope="module")
def recording(drives):
    return record_drives(drives)


def remove_power(message):
    """Return a message without voltage and current."""
    if not message.key.endswith("telemetry"):
        return message
    try:
        sample = msgspec.json.decode(message.payload, type=Telemetry)
    except msgspec.DecodeError:
        return message
    bare = msgspec.structs.replace(sample, battery_voltage_v=None, battery_current_a=None)
    return message._replace(payload=encode(bare))


def run_pipeline(simulation, measurement):
    """Return rides and windows of a simulation from the whole pipeline, without dispatch's ends of rides.

    The benchmark does not apply these ends: its rides end at the next sample.
    """
    messages = [message for message in simulate(simulation) if b'"event":"end"' not in message.payload]
    pipeline = Pipeline(also=effects.list_tabulated(), keep_forecasts=False, two_sided=True)
    pipeline.take(messages if measurement == "vi" else [remove_power(message) for message in messages])
    pipeline.finish()
    return pipeline.take_rides(), pipeline.take_windows()


class TestData:
    @pytest.mark.parametrize("hidden", [(COLD,), (Hidden("regen_full_battery~other", 0.06), Hidden("headwind", 0.03))])
    @pytest.mark.parametrize("measurement", ["vi", "soc"])
    def test_tables_equal_those_of_the_pipeline(self, drives, recording, hidden, measurement):
        simulation = replace(SMALL, hidden=hidden, faults=replace(SMALL.faults, quantised=1.0))
        made = recording.tables(drives.measured(hidden), measurement, [effect for effect, _ in hidden])
        order = ["vehicle_id", "start_s"]
        for whole, table in zip(run_pipeline(simulation, measurement), made[:2], strict=True):
            repeated = [
                "quality_duplicate",
                "quality_late",
                "samples",
            ]  # the pipeline drops repetitions before it counts
            expected = whole.drop(columns=repeated, errors="ignore")
            pd.testing.assert_frame_equal(
                table[expected.columns].sort_values(order, ignore_index=True),
                expected.sort_values(order, ignore_index=True),
                rtol=1e-12,
                atol=1e-12,
            )

    def test_smoothed_climb_is_nearer_the_truth_than_the_causal_one(self, drives, recording):
        heights = np.full((len(drives.vehicles), max(leg.first + leg.samples for leg in drives.legs)), np.nan)
        for leg in drives.legs:
            at = slice(STEPS_PER_SAMPLE - 1, leg.samples * STEPS_PER_SAMPLE, STEPS_PER_SAMPLE)
            rows = slice(leg.first, leg.first + leg.samples)
            heights[drives.vehicles.index(leg.member.name), rows] = leg.driven.view.trace.elevation[at]
        true = heights[recording.car, recording.number]
        clean = Cleaner(Settings()).clean(recording.batch, len(recording.lanes))
        errors, causal_errors, gained, true_gained = [], [], 0.0, 0.0
        for lane, ride in set(zip(clean.lane.tolist(), clean.ride.tolist(), strict=True)):
            rows = np.flatnonzero((clean.lane == lane) & (clean.ride == ride) & (clean.dt > 0.0))
            if ride < 0 or len(rows) < 20:
                continue
            climb = np.diff(true[rows])
            windows = np.flatnonzero(np.diff(clean.window[rows[1:]], prepend=-1))
            errors += np.add.reduceat(recording.climb[rows[1:]] - climb, windows).tolist()
            causal_errors += np.add.reduceat(clean.causal_climb[rows[1:]] - climb, windows).tolist()
            gained += np.maximum(recording.climb[rows[1:]], 0.0).sum()
            true_gained += np.maximum(climb, 0.0).sum()
        assert len(errors) > 100
        assert np.square(errors).mean() < 0.36 * np.square(causal_errors).mean()
        assert gained == pytest.approx(true_gained, rel=0.1)

    def test_hidden_energy_equals_the_increase_of_measured_energy(self, drives, recording):
        base = recording.tables(drives.measured(), "vi").windows
        with_it = recording.tables(drives.measured([COLD]), "vi", ["cold_rolling"])
        gained = with_it.windows["energy_vi_kwh"] - base["energy_vi_kwh"]
        truth = with_it.hidden["cold_rolling"].where(gained.notna())
        assert gained.sum() == pytest.approx(truth.sum(), rel=0.01)
        np.testing.assert_allclose(gained, truth, atol=5e-4)

    def test_effect_takes_its_share_of_the_energy_of_rides(self, drives, recording):
        made = recording.tables(drives.measured([COLD]), "vi", ["cold_rolling"])
        assert made.hidden["cold_rolling"].sum() / made.windows["energy_kwh"].sum() == pytest.approx(0.06, rel=0.05)

    @pytest.mark.parametrize("where", [Scope(vehicle="taxi-002"), Scope(since="2018-04-01")])
    def test_effect_is_hidden_in_its_scope_only(self, drives, recording, where):
        made = recording.tables(drives.measured([COLD], where), "vi", ["cold_rolling"])
        table = made.windows.assign(truth=made.hidden["cold_rolling"])
        within = table["vehicle_id"] == "taxi-002" if where.vehicle else table["start_s"] >= 1522540800.0
        assert not table.loc[~within, "truth"].any()
        assert table.loc[within, "truth"].sum() / table.loc[within, "energy_kwh"].sum() == pytest.approx(0.06, rel=0.05)

    def test_noisy_weather_changes_wind_and_rain_only(self, drives):
        exact = [msgspec.json.decode(m.payload, type=Weather) for m in drives.messages if m.key.startswith("weather")]
        blurred = add_weather_noise(drives.messages, 1)
        other = [msgspec.json.decode(m.payload, type=Weather) for m in blurred if m.key.startswith("weather")]
        ratio = np.array([b.wind_speed_kmh / a.wind_speed_kmh for a, b in zip(exact, other, strict=True)])
        assert np.log(ratio).std() == pytest.approx(0.3, abs=0.02)
        assert ratio.mean() == pytest.approx(1.0, abs=0.02)
        turned = [(b.wind_from_deg - a.wind_from_deg + 180) % 360 - 180 for a, b in zip(exact, other, strict=True)]
        assert np.std(turned) == pytest.approx(20.0, abs=1.5)
        assert [a.temperature_c for a in exact] == [b.temperature_c for b in other]
        others = [a == b for a, b in zip(drives.messages, blurred, strict=True) if not a.key.startswith("weather")]
        assert all(others)

    def test_cars_drive_on_different_days(self):
        taken = simulate_drives(replace(SMALL, days=4, day_step=7), 2)
        dates: dict[str, list[int]] = {name: [] for name in taken.vehicles}
        for leg in taken.legs:
            dates[leg.member.name].append(int((leg.driven.shift.time - SMALL.start.timestamp()) // 86400.0))
        assert dates == {"taxi-001": [0, 14], "taxi-002": [7, 21]}

    def test_bare_cars_have_no_climate_control(self, source):
        heated = source.tables(Case(5)).rides["energy_kwh"].sum()
        bare = source.tables(Case(5, (Hidden("cabin_heating", 0.0075),)))
        assert bare.rides["energy_kwh"].sum() < 0.9 * heated
        assert not bare.rides["hvac_kwh"].fillna(0.0).any()


class TestNames:
    def test_every_hidden_effect_has_a_right_name_in_the_library(self):
        assert set(EFFECTS) == set(OTHER_SHAPES)
        assert set(RIGHT_NAMES) | set(ABSORBED) <= set(EFFECTS)
        for effect in EFFECTS:
            assert all(name in effects.get_library() for name in get_right_names(effect))
        assert [strip_shape(f"snow{end}") for end in ("", "~other", "~bent7")] == ["snow"] * 3
        assert get_right_names("snow~other") == ("snow",)


class TestEvaluation:
    def test_record_contains_the_truth(self, source):
        case = Case(5, (Hidden("headwind", 0.06),))
        tables = source.tables(case)

        def diagnose(_rides, _windows, model):
            assert model.recipe == "road_load"
            return make_result(make_name("headwind", value=0.6))

        record = evaluate_case(case, tables, diagnose, timed=True)
        assert json.loads(json.dumps(record)) == record
        (interval,) = record["intervals"]
        assert interval["right"]
        assert 0.8 < record["left"] <= 1.0
        assert 0.8 < record["alike"] <= 1.0
        assert record["z"] > 3.0
        assert record["visible"] is True
        assert record["baselines"]["stlsq"][0] == "headwind"
        assert record["baselines"][RANKED][0] == "headwind"
        assert 0.05 < interval["truth"] < 3.0
        assert max(record["errors"]["truth"], record["errors"]["after"]) < record["errors"]["before"]
        assert record["stlsq_seconds"] > 0.0

    def test_excluded_effects_are_passed_to_diagnosis(self, source):
        case = Case(5, (Hidden("headwind", 0.06),), without=("headwind",))
        calls = []

        def diagnose(*_, without):
            calls.append(without)
            return make_result()

        evaluate_case(case, source.tables(case), diagnose)
        assert calls == [("headwind",)]

    @pytest.mark.parametrize("measurement", ["vi", "soc"])
    def test_true_energy_belongs_to_its_window(self, source, measurement):
        tables = source.tables(Case(5, (Hidden("snow", 0.06),), measurement))
        windows = gather_windows(
            tables.rides, tables.windows, fit_to_windows("road_load", tables.rides, tables.windows)
        )
        truth = compute_true_energy(windows, tables.hidden.sample(frac=1.0, random_state=0))
        assert truth.shape == (len(windows.measured), 1)
        summer = windows.table["ambient_c"] > 10.0
        assert not truth[summer].any()
        rides = tables.hidden["ride_key"].isin(set(windows.rides["ride_key"]))
        assert truth.sum() == pytest.approx(tables.hidden.loc[rides, "snow"].sum(), rel=0.05)


class TestErrors:
    def test_held_out_days_do_not_affect_their_predictions(self):
        rng = np.random.default_rng(0)
        columns, fold = rng.normal(size=(60, 2)), np.arange(60) % 3
        energy = columns @ np.array([2.0, -1.0])
        np.testing.assert_allclose(predict_held_out(columns, energy, fold), energy)
        spoilt = energy + 100.0 * (fold == 1)
        np.testing.assert_allclose(predict_held_out(columns, spoilt, fold)[fold == 1], energy[fold == 1])

    def test_error_with_known_truth_equals_error_without_hidden_energy(self, source):
        tables = source.tables(Case(5, (Hidden("solar_load", 0.06),)))
        windows = gather_windows(
            tables.rides, tables.windows, fit_to_windows("road_load", tables.rides, tables.windows)
        )
        hidden = 50.0 * np.random.default_rng(1).normal(size=len(windows.measured)) * windows.measured.std()
        spoilt = Windows(**{**vars(windows), "measured": windows.measured + hidden})
        model = fit_to_windows("road_load", tables.rides, tables.windows)
        errors, clean = compute_errors(spoilt, model, hidden, []), compute_errors(windows, model, 0.0 * hidden, [])
        assert errors.truth == pytest.approx(clean.before)
        assert errors.before > 10.0 * clean.before
        assert errors.after == errors.before


class TestParts:
    def test_parts_contain_the_selected_data_sets(self):
        choice = Selection(seeds=10)
        one = list(PARTS["one"](choice))
        assert len(one) == len(set(one)) == len(EFFECTS) * 10 * 4 * 2 * 2 * 3
        none = list(PARTS["none"](choice))
        assert len(none) >= 100
        assert all(case.seed >= FRESH and not case.hidden for case in none)
        two = list(PARTS["two"](choice))
        assert all(len({strip_shape(e) for e, _ in case.hidden} - set(ABSORBED)) == 2 for case in two)
        assert all(case.without == get_right_names(case.hidden[0].effect) for case in PARTS["outside"](choice))

    def test_bent_shapes_differ_between_seeds(self):
        choice = Selection(seeds=2, effects=("snow",), shares=(0.03,), measurements=("vi",), weathers=("none",))
        names = [case.hidden[0].effect for case in PARTS["one"](choice)]
        assert names == ["snow", "snow~other", "snow~bent0", "snow", "snow~other", "snow~bent1"]
        assert {e.partition("~")[2] for case in PARTS["two"](Selection(seeds=5)) for e, _ in case.hidden} >= {
            "",
            "other",
        }

    def test_different_seeds_have_different_drives(self):
        for part in PARTS.values():
            early, late = (part(Selection(seeds=2, first=first, effects=("snow", "wet_road"))) for first in (0, 2))
            early_seeds, late_seeds = ({case.seed for case in cases} for cases in (early, late))
            assert early_seeds.isdisjoint(late_seeds)
            assert len(late_seeds) == len(early_seeds)
        assert {case.seed for case in PARTS["one"](Selection(seeds=2, first=40))} == {40, 41}

    def test_sample_is_a_reproducible_subset(self):
        every = list(PARTS["one"](Selection(seeds=2)))
        some = draw_sample(every, 50)
        assert len(some) == 50
        assert some == draw_sample(every, 50)
        assert set(some) < set(every)
        assert draw_sample(every[:10], 50) == every[:10]

    def test_tasks_have_one_seed_each(self):
        todo = make_tasks("one", list(PARTS["one"](Selection(seeds=3, effects=("snow",)))))
        assert [{case.seed for case in cases} for _, cases in todo] == [{0}, {1}, {2}]


class TestRunning:
    def test_kept_records_are_not_made_again(self, source, tmp_path, monkeypatch):
        monkeypatch.setattr("socast.tools.bench.hidden.running._source", lambda _: source)
        calls = []

        def diagnose(rides, *_):
            calls.append(len(rides))
            return make_result()

        todo = [Case(5, (Hidden("snow", 0.03),)), Case(5)]
        first = run_cases("one", todo, diagnose, tmp_path)
        again = run_cases("one", [*todo, Case(5, measurement="soc")], diagnose, tmp_path)
        assert len(calls) == 3
        assert again[:2] == first

    def test_impossible_data_set_gives_a_record_with_the_reason(self, source, monkeypatch):
        monkeypatch.setattr("socast.tools.bench.hidden.running._source", lambda _: source)
        roofless = next(leg.member.name for leg in source.drives.legs if not leg.member.car.roof_drag_area)
        case = Case(5, (Hidden("roof_load", 0.03),), where=Scope(vehicle=roofless))
        (record,) = run_cases("vehicle", [case], lambda *_: make_result())
        assert "too little" in record["refused"]

    def test_effect_that_never_acts_is_rejected(self, drives):
        with pytest.raises(SettingsError, match="too little"):
            drives.measured([Hidden("snow", 0.03)], Scope(since="2018-04-20"))
