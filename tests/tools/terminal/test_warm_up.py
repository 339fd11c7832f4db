"""Warm-up with recordings of earlier days narrows the intervals of the first day and changes nothing else."""

import pytest

from socast.core.models import BASIC_PHYSICAL, EXTENDED_PHYSICAL
from socast.core.pipeline import Pipeline
from socast.tools.terminal.forecast_options import learn_from_recordings
from tests.support.commands import called, done, refused
from tests.support.fleet_days import CARS, DAYS, SETTINGS, forecasts, recorded, shift
from tests.support.telemetry import leaf, observed


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """Return recordings of some days: one of the first, one of the others."""
    folder = tmp_path_factory.mktemp("history")
    for name, numbers in (("a", range(2)), ("b", range(2, DAYS))):
        recorded(folder / f"{name}.mcap", numbers)
    return [folder / "a.mcap", folder / "b.mcap"]


def today(pipeline):
    return pipeline.push([observed(temperature_c=10.0), leaf("c"), *(m for _, m in shift("c", DAYS))])


def test_warm_up_narrows_the_intervals_of_the_first_day(recordings):
    fresh, pipeline = Pipeline(settings=SETTINGS), Pipeline(settings=SETTINGS)
    pipeline.learn_from(learn_from_recordings(EXTENDED_PHYSICAL, [], SETTINGS, recordings))
    before, after = forecasts(today(fresh), "c"), forecasts(today(pipeline), "c")
    assert before.keys() == after.keys()
    one, other = (list(each.values())[2].soc_end_of_shift_pct for each in (before, after))
    assert other.p95 - other.p05 < one.p95 - one.p05
    for time, each in before.items():
        assert each.ride_energy_predicted_kwh == after[time].ride_energy_predicted_kwh
        assert each.ride_distance_km == after[time].ride_distance_km


def test_rides_and_counters_exclude_warm_up(recordings):
    """Only the energy by charge may differ: it rests on the capacities that the warm-up has learned."""
    fresh, pipeline = Pipeline(settings=SETTINGS), Pipeline(settings=SETTINGS)
    pipeline.learn_from(learn_from_recordings(EXTENDED_PHYSICAL, [], SETTINGS, recordings))
    for each in (fresh, pipeline):
        today(each)
        each.finish()
    counters, expected = pipeline.quality(), fresh.quality()
    assert counters.pop("vehicles") == len(CARS)
    expected.pop("vehicles")
    assert counters == expected
    by_charge = ["energy_kwh", "energy_sd_kwh", "usable_capacity_kwh", "usable_capacity_sd_kwh"]
    by_charge += ["energy_soc_kwh", "energy_soc_sd_kwh", "energy_soc_noise_kwh"]
    rides, expected_rides = (each.take_rides().drop(columns=by_charge) for each in (pipeline, fresh))
    assert rides.equals(expected_rides)


def test_warm_up_keeps_vehicle_model_of_cars_that_send_none_again(recordings):
    pipeline = Pipeline(settings=SETTINGS)
    pipeline.learn_from(learn_from_recordings(EXTENDED_PHYSICAL, [], SETTINGS, recordings))
    made = forecasts(pipeline.push([m for _, m in shift("c", DAYS)]), "c")
    assert list(made.values())[-1].soc_end_of_shift_pct


def test_shadows_start_with_no_errors_and_restart_continues_unchanged(recordings):
    def made():
        return Pipeline(settings=SETTINGS, shadows=[BASIC_PHYSICAL], keep_tables=False)

    pipeline = made()
    pipeline.learn_from(learn_from_recordings(EXTENDED_PHYSICAL, [BASIC_PHYSICAL], SETTINGS, recordings))
    assert all(errors.overall.rides == 0 for errors in pipeline.shadows.errors())
    messages = [m for _, m in shift("c", DAYS)]
    first, state = pipeline.push(messages[:150]), pipeline.snapshot()
    other = made()
    other.restore(state)
    assert first
    assert pipeline.push(messages[150:]) == other.push(messages[150:])


def test_no_recordings_give_no_pipeline():
    assert learn_from_recordings(EXTENDED_PHYSICAL, [], SETTINGS, None) is None
    assert learn_from_recordings(EXTENDED_PHYSICAL, [], SETTINGS, []) is None


@pytest.mark.parametrize("lost", [0, 9_000], ids=["whole", "killed"])
def test_warm_up_recording_that_ends_after_replay_begins_is_refused(capsys, tmp_path, recordings, lost):
    early, late = recordings
    for name, numbers in (("later", range(2, DAYS)), ("overlapping", range(DAYS)), ("same", range(2))):
        recorded(history := tmp_path / f"{name}.mcap", numbers)
        history.write_bytes(history.read_bytes()[: history.stat().st_size - lost])
        message = refused(capsys, "replay", early, "--warm-up", history)
        assert f"{name}.mcap ends at 2024-01-1" in message
        assert "after the replay begins at 2024-01-15 08:00:00 UTC: " in message
    assert "a.mcap ends at" in refused(capsys, "replay", early, late, "--warm-up", early)
    done("replay", late, "--warm-up", early, "--warm-up", tmp_path / "same.mcap")


def test_invalid_warm_up_recording_is_refused_in_one_line(capsys, tmp_path, recordings):
    assert "nowhere.mcap" in refused(capsys, "live", "--warm-up", tmp_path / "nowhere.mcap")
    replay = ("replay", recordings[0])
    assert "nowhere.mcap" in refused(capsys, *replay, "--warm-up", tmp_path / "nowhere.mcap")
    assert "--warm-up" in refused(capsys, *replay, "--warm-up", recordings[1], "--connect", "tcp/127.0.0.1:1")
    assert "overwritten" in refused(capsys, *replay, "--warm-up", recordings[1], "--json", recordings[1])


def test_consumer_with_existing_state_ignores_warm_up(capsys, tmp_path):
    nobody = ("live", "--connect", "tcp/127.0.0.1:1", "--warm-up", tmp_path / "nowhere.mcap")
    state = tmp_path / "fleet.state"
    assert "nowhere.mcap" in refused(capsys, *nobody, "--state", state)
    state.write_bytes(b"")
    _, printed, code = called(*nobody, "--state", state)
    assert code == 2
    ignored, failure = printed.splitlines()
    assert "--warm-up is ignored" in ignored
    assert "not a snapshot" in failure
