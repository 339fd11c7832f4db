"""Real rides strung into shifts: nothing is lost, time and state of charge go on, and plans tell what is ahead."""

from itertools import pairwise
from zoneinfo import ZoneInfo

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from core.forecast.plan_checks import refusal
from core.wire.messages import Plan
from stream.mcap_reader import McapSource
from tests.support.paths import ROOT
from tests.support.published_files import made
from tools.commands.import_drives import app, collect
from tools.importers import ved
from tools.importers.drive import Drive
from tools.importers.shifts import (
    FULL,
    HILL,
    LEAST,
    NIGHT,
    PAUSE,
    SEASON,
    climbed,
    distance_km,
    leg,
    plans,
    strung,
)

DATA = ROOT.parent / "shared" / "data"
START = 1_514_764_800.0
HOUR = 3600.0


def drive(number, start, minutes=20.0, fall=4.0, car="taxi", speed=36.0):
    """Return a ride at an even pace whose state of charge falls evenly from 60 %."""
    elapsed = np.arange(0.0, 60.0 * minutes + 0.5, 1.0)
    rows = {"speed_kmh": np.full(len(elapsed), speed), "soc_pct": 60.0 - fall * elapsed / elapsed[-1]}
    return Drive(car, "nissan-leaf-2013", f"ride-{number}", START + start, elapsed, rows, "file.csv")


def decoded(messages):
    return [msgspec.json.decode(message.payload, type=Plan) for message in messages]


RIDES = st.lists(
    st.tuples(st.floats(0.1, 40.0), st.floats(1.0, 90.0), st.floats(-1.0, 30.0), st.sampled_from("ab")), max_size=30
)


@given(rides=RIDES, hours=st.floats(0.5, 10.0))
def test_every_ride_is_driven_once_in_order_and_nothing_overlaps(rides, hours):
    starts = np.cumsum([days * 86_400.0 for days, *_ in rides])
    drives = [
        drive(i, start, minutes, fall, car)
        for i, (start, (_, minutes, fall, car)) in enumerate(zip(starts, rides, strict=True))
    ]
    shifts = strung(drives, hours)
    for car in "ab":
        own = [shift for shift in shifts if shift.drives[0].vehicle_id == car]
        moved = [one for shift in own for one in shift.drives]
        assert [one.ride_id for one in moved] == [one.ride_id for one in drives if one.vehicle_id == car]
        free_from = -np.inf
        for shift in own:
            first = next(one for one in drives if one.ride_id == shift.drives[0].ride_id)
            assert shift.drives[0].start == pytest.approx(max(first.start, free_from), abs=1e-3)
            free_from = shift.end + NIGHT
        for shift in own:
            assert all(b.start == pytest.approx(a.end + PAUSE, abs=1e-3) for a, b in pairwise(shift.drives))
            assert shift.drives[-1].start - shift.drives[0].start < hours * HOUR + PAUSE
            originals = [next(d for d in drives if d.ride_id == one.ride_id) for one in shift.drives]
            assert originals[-1].start - originals[0].start <= SEASON
            assert all(np.array_equal(o.elapsed, m.elapsed) for o, m in zip(originals, shift.drives, strict=True))


@given(rides=RIDES)
def test_the_state_of_charge_goes_on_by_each_rides_own_fall(rides):
    drives = [drive(i, 4 * HOUR * i, minutes, fall) for i, (_, minutes, fall, _) in enumerate(rides)]
    falls = {one.ride_id: 60.0 - one.rows["soc_pct"][-1] for one in drives}
    for shift in strung(drives, 6.0):
        left = FULL
        for one in shift.drives:
            soc = one.rows["soc_pct"]
            assert soc[0] == pytest.approx(left)
            left = soc[-1]
            assert soc[0] - left == pytest.approx(falls[one.ride_id], abs=1e-9)
        assert left >= LEAST - 1e-9


def test_a_shift_lasts_until_its_length_is_reached_and_no_longer():
    shifts = strung([drive(i, 86_400.0 * i, minutes=55.0, fall=1.0) for i in range(9)], 3.0)
    assert [len(shift.drives) for shift in shifts] == [4, 4, 1]
    assert shifts[0].end - shifts[0].drives[0].start == 4 * 55 * 60.0 + 3 * PAUSE


def test_what_is_not_known_of_the_charge_stays_unknown():
    rows = {"speed_kmh": np.full(61, 36.0), "soc_pct": np.full(61, np.nan)}
    unknown = drive(1, 1000.0)._replace(elapsed=np.arange(61.0), rows=rows)
    (shift,) = strung([drive(0, 0.0), unknown, drive(2, 2000.0)], 8.0)
    assert np.isnan(shift.drives[1].rows["soc_pct"]).all()
    assert shift.drives[2].rows["soc_pct"][0] == pytest.approx(FULL - 4.0)


def test_plans_hold_what_is_ahead_and_are_fit_to_be_used():
    (shift,) = strung([drive(i, 3000.0 * i) for i in range(4)], 8.0)
    told = decoded(plans(shift))
    legs = [leg(one) for one in shift.drives]
    assert [plan.legs for plan in told] == [legs[done:] for done in range(5)]
    assert [plan.time_s for plan in told] == [shift.drives[0].start, *(one.end for one in shift.drives)]
    assert {plan.shift_end_s for plan in told} == {shift.end}
    assert [refusal(plan, plan.time_s) for plan in told] == [None] * 5


def test_planned_distances_and_times_err_as_somebody_who_plans():
    drives = [drive(i, 3000.0 * i) for i in range(400)]
    assert distance_km(drives[0]) == pytest.approx(12.0)
    legs = [leg(one) for one in drives]
    assert legs == [leg(one) for one in drives]
    off = np.array([[one.distance_km / 12.0 - 1.0, np.log(one.duration_s / 1200.0)] for one in legs])
    assert off.mean(axis=0) == pytest.approx([0.0, 0.0], abs=0.02)
    assert off.std(axis=0) == pytest.approx([0.04, 0.12], rel=0.15)


@given(st.lists(st.floats(-500.0, 500.0), min_size=1, max_size=50), st.floats(-100.0, 100.0))
def test_climbs_and_descents_add_up_and_do_not_depend_on_the_level(heights, level):
    gained, lost = climbed(np.array(heights))
    assert gained >= 0.0
    assert lost >= 0.0
    assert abs((gained - lost) - (heights[-1] - heights[0])) <= HILL + 0.1
    assert climbed(np.array(heights) + level) == pytest.approx((gained, lost), abs=0.11)
    ups = np.diff(heights)
    assert gained <= ups[ups > 0.0].sum() + 0.1


def test_undulations_of_a_sensor_are_no_hills():
    heights = 200.0 + np.random.default_rng(1).uniform(-0.5, 0.5, 5000) * HILL * 0.99
    gained, lost = climbed(heights)
    assert gained + lost < HILL


@pytest.mark.parametrize("name", ["ved", "bmw-i3", "twizy"])
def test_every_importer_strings_on_request(tmp_path, name):
    path = made(tmp_path, name)
    results = {}
    for hours in (None, 2.0):
        out = tmp_path / f"{hours}.mcap"
        given_hours = [] if hours is None else ["--shift-hours", str(hours)]
        ran = CliRunner().invoke(app, [name, str(path), "--out", str(out), *given_hours])
        assert ran.exit_code == 0, ran.exception
        assert ("strung into 1 shifts" in ran.output) == (hours is not None)
        results[hours] = [message for block in McapSource(out) for message in block]
    kinds = [message.key.rpartition("/")[2] for message in results[2.0]]
    assert kinds.count("plan") == 2
    assert kinds.index("telemetry") < kinds.index("plan")
    assert len(results[2.0]) == len(results[None]) + 2


@pytest.mark.skipif(not DATA.is_dir(), reason=f"the public data sets are not at {DATA}")
def test_the_leaf_of_the_ved_drives_shifts():
    drives = collect([DATA / "ved_ev"], lambda path: ved.read_drives(path, ZoneInfo(ved.TIME_ZONE)))
    shifts = strung(drives, 3.0)
    assert sum(len(shift.drives) for shift in shifts) == len(drives) == 135
    assert len(shifts) >= 10
    assert all(refusal(plan, plan.time_s) is None for shift in shifts for plan in decoded(plans(shift)))
    soc = np.concatenate([one.rows["soc_pct"] for shift in shifts for one in shift.drives])
    assert np.nanmin(soc) >= LEAST - 0.5
    assert np.nanmax(soc) <= 100.0
    used = sum(shift.drives[0].rows["soc_pct"][0] - shift.drives[-1].rows["soc_pct"][-1] for shift in shifts)
    assert used == pytest.approx(sum(one.rows["soc_pct"][0] - one.rows["soc_pct"][-1] for one in drives), rel=0.02)
