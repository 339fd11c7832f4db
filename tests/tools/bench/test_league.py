"""Test that the league makes plausible drives, and notices whatever is wrong with a ride."""

import json

import numpy as np
import pytest

from socast.tools.bench.league import __main__ as league
from socast.tools.bench.league.drives import JOULES, STEP, make_track
from socast.tools.bench.league.faults import FAULTS
from socast.tools.bench.league.fleet import choose_faults, list_fleets, make_entry, tabulate, write_stream
from socast.tools.bench.league.laws import ODD, REPAIRED, RIGHT, UNFIT, WRONG, judge
from socast.tools.bench.league.loggers import are_compatible

SEED, CAR = 11, 1


@pytest.fixture(scope="module")
def entry():
    """Return a car without a fault."""
    return make_entry(SEED, CAR, [])


@pytest.fixture(scope="module")
def rides(entry):
    """Return the rides of its three drives."""
    return tabulate(write_stream([entry]))


def words(entry, rides, **changes):
    """Return the word and reason of the first drive, with some columns of its ride changed."""
    changed = rides.copy()
    for name, value in changes.items():
        changed.loc[changed.index[0], name] = value
    verdict = judge(entry.number, entry.log, entry.truths, entry.starts, entry.faults, changed)[0]
    return verdict.word, verdict.why


@pytest.mark.parametrize("seed", range(4))
def test_drives_are_those_of_a_plausible_car(seed):
    track = make_track(np.random.default_rng(seed), 3, 1.7e9)
    assert (np.diff(track.time) > 0.0).all()
    assert track.speed.max() < 36.0
    assert np.abs(np.diff(track.speed)).max() < 4.0 * STEP
    assert track.soc.min() > 0.1
    assert track.soc.max() < 1.0
    for begin, end in track.drives:
        assert 280.0 < end - begin < 2500.0
        km, kwh = 1e-3 * (track.at("distance", end) - track.at("distance", begin)), track.at("energy", end)
        assert 0.05 < (kwh - track.at("energy", begin)) / JOULES / km < 0.4


def test_fault_free_drives_are_right(entry, rides):
    assert words(entry, rides)[0] in {RIGHT, REPAIRED}


@pytest.mark.parametrize(
    ("column", "factor", "why"),
    [("distance_km", 1.08, "distance"), ("energy_kwh", 0.85, "energy"), ("duration_s", 1.5, "duration")],
)
def test_wrong_amount_of_a_fit_ride_is_noticed(entry, rides, column, factor, why):
    value = rides[column].iloc[0] * factor
    assert words(entry, rides, **{column: value, "energy_sd_kwh": 0.01}) == (WRONG, why)


def test_wrong_beginning_of_a_fit_ride_is_noticed(entry, rides):
    assert words(entry, rides, start_s=rides["start_s"].iloc[0] + 86_400.0) == (WRONG, "start")


def test_ride_of_two_drives_is_noticed(entry, rides):
    assert words(entry, rides, occupants=rides["occupants"].iloc[0] + 1.0) == (WRONG, "merged")


def test_reason_of_an_unfit_ride_must_be_that_of_the_fault(rides):
    entry = make_entry(SEED, CAR, [FAULTS["speed_in_mph"]])
    unfit = {"fit_for_training": False}
    assert words(entry, rides, unfit_reason="speed_rejected", **unfit) == (UNFIT, "speed_rejected")
    assert words(entry, rides, unfit_reason="soc_jump", **unfit) == (ODD, "soc_jump")


def test_missing_ride_is_noticed(entry, rides):
    assert words(entry, rides.iloc[1:]) == (ODD, "no_ride")


def test_league_is_the_same_whenever_it_runs():
    faults = choose_faults(SEED, 7)
    assert write_stream([make_entry(SEED, 7, faults)]) == write_stream([make_entry(SEED, 7, faults)])
    assert sum(map(len, list_fleets(1000))) == 334


def test_wrong_speed_always_has_a_witness():
    for number, name in enumerate(("speed_in_mph", "speed_stuck", "speed_absent", "speed_missing")):
        for other in ("odometer_in_miles", "odometer_absent", "position_absent", "position_frozen"):
            faults = [FAULTS[name], FAULTS[other]]
            assert are_compatible(*faults)
            columns = make_entry(SEED, number, faults).log.columns
            witness = "latitude_deg" if "odometer" in other else "odometer_km"
            assert np.isfinite(columns[witness]).any()


@pytest.mark.parametrize("name", FAULTS)
def test_every_fault_changes_the_samples(name):
    with_fault, without = (make_entry(SEED, CAR, faults) for faults in ([FAULTS[name]], []))
    assert write_stream([with_fault]) != write_stream([without])
    assert FAULTS[name].meaning.endswith(".")


def test_command_prints_json_and_publishes(monkeypatch, capsys):
    published = {}
    monkeypatch.setattr(league, "publish", lambda name, *found: published.update({name: found}))
    code = league.main(["--drives", "6", "--faults", "none,clock_jitter", "--json", "--publish"])
    printed = json.loads(capsys.readouterr().out)
    assert code == int(any(each["word"] == WRONG for each in printed["drives"]))
    assert len(printed["drives"]) == 6
    command, lines, values = published["league"]
    assert command == "python -m socast.tools.bench.league --drives 6 --seed 1"
    assert any(line.startswith("| `clock_jitter` | Shift each stamp") for line in lines)
    assert values["wrong_on"] == "6 simulated drives with faults"


def test_command_shows_one_drive(capsys):
    assert league.main(["--drives", "6", "--drive", "4", "--faults", "clock_jitter"]) == 0
    printed = capsys.readouterr().out
    assert "car-00001: clock_jitter; every" in printed
    assert "in its fleet: " in printed


def test_unknown_fault_is_refused_in_one_line(capsys):
    assert league.main(["--faults", "clock_jitters"]) == 2
    assert "clock_jitters: no such fault" in capsys.readouterr().err
