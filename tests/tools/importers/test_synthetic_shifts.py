"""Synthetic shifts keep every ride, continue its time and state of charge, and plan the remaining rides."""

from itertools import pairwise

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.wire.messages import Plan
from socast.core.wire.plan_checks import find_refusal
from socast.stream.mcap_reader import McapSource
from socast.tools.commands.import_drives import collect_drives
from socast.tools.importers.data_sets import DATA_SETS
from socast.tools.importers.drive import Drive
from socast.tools.importers.synthetic_shifts import (
    ELEVATION_PLAY,
    LONGEST_SPAN,
    LOWEST_SOC,
    PAUSE,
    SHIFT_BREAK,
    START_SOC,
    compute_climb,
    concatenate_drives,
    integrate_distance,
    make_plans,
    plan_leg,
)
from tests.support.paths import ROOT
from tests.support.published_files import run_import, write_good_file

DATA = ROOT.parent / "shared" / "data"
START = 1_514_764_800.0
HOUR = 3600.0


def make_drive(number, start, minutes=20.0, fall=4.0, car="taxi", speed=36.0):
    """Return a ride at constant speed whose state of charge falls linearly from 60 %."""
    elapsed = np.arange(0.0, 60.0 * minutes + 0.5, 1.0)
    rows = {"speed_kmh": np.full(len(elapsed), speed), "soc_pct": 60.0 - fall * elapsed / elapsed[-1]}
    return Drive(car, "nissan-leaf-2013", f"ride-{number}", START + start, elapsed, rows, "file.csv")


def decode_plans(messages):
    """Return the plans of messages."""
    return [msgspec.json.decode(message.payload, type=Plan) for message in messages]


RIDES = st.lists(
    st.tuples(st.floats(0.1, 40.0), st.floats(1.0, 90.0), st.floats(-1.0, 30.0), st.sampled_from("ab")), max_size=30
)


@given(rides=RIDES, hours=st.floats(0.5, 10.0))
def test_every_ride_appears_once_in_order_without_overlap(rides, hours):
    starts = np.cumsum([days * 86_400.0 for days, *_ in rides])
    drives = [
        make_drive(i, start, minutes, fall, car)
        for i, (start, (_, minutes, fall, car)) in enumerate(zip(starts, rides, strict=True))
    ]
    shifts = concatenate_drives(drives, hours)
    for car in "ab":
        shifts_of_car = [shift for shift in shifts if shift.drives[0].vehicle_id == car]
        moved = [one for shift in shifts_of_car for one in shift.drives]
        assert [one.ride_id for one in moved] == [one.ride_id for one in drives if one.vehicle_id == car]
        free_from = -np.inf
        for shift in shifts_of_car:
            first = next(one for one in drives if one.ride_id == shift.drives[0].ride_id)
            assert shift.drives[0].start == pytest.approx(max(first.start, free_from), abs=1e-3)
            free_from = shift.end + SHIFT_BREAK
        for shift in shifts_of_car:
            assert all(b.start == pytest.approx(a.end + PAUSE, abs=1e-3) for a, b in pairwise(shift.drives))
            assert shift.drives[-1].start - shift.drives[0].start < hours * HOUR + PAUSE
            originals = [next(d for d in drives if d.ride_id == one.ride_id) for one in shift.drives]
            assert originals[-1].start - originals[0].start <= LONGEST_SPAN
            assert all(np.array_equal(o.elapsed, m.elapsed) for o, m in zip(originals, shift.drives, strict=True))


@given(rides=RIDES)
def test_state_of_charge_continues_by_the_decrease_of_each_ride(rides):
    drives = [make_drive(i, 4 * HOUR * i, minutes, fall) for i, (_, minutes, fall, _) in enumerate(rides)]
    falls = {one.ride_id: 60.0 - one.rows["soc_pct"][-1] for one in drives}
    for shift in concatenate_drives(drives, 6.0):
        left = START_SOC
        for one in shift.drives:
            soc = one.rows["soc_pct"]
            assert soc[0] == pytest.approx(left)
            left = soc[-1]
            assert soc[0] - left == pytest.approx(falls[one.ride_id], abs=1e-9)
        assert left >= LOWEST_SOC - 1e-9


def test_shift_ends_with_the_ride_that_reaches_its_length():
    shifts = concatenate_drives([make_drive(i, 86_400.0 * i, minutes=55.0, fall=1.0) for i in range(9)], 3.0)
    assert [len(shift.drives) for shift in shifts] == [4, 4, 1]
    assert shifts[0].end - shifts[0].drives[0].start == 4 * 55 * 60.0 + 3 * PAUSE


def test_unknown_state_of_charge_stays_unknown():
    rows = {"speed_kmh": np.full(61, 36.0), "soc_pct": np.full(61, np.nan)}
    unknown = make_drive(1, 1000.0)._replace(elapsed=np.arange(61.0), rows=rows)
    (shift,) = concatenate_drives([make_drive(0, 0.0), unknown, make_drive(2, 2000.0)], 8.0)
    assert np.isnan(shift.drives[1].rows["soc_pct"]).all()
    assert shift.drives[2].rows["soc_pct"][0] == pytest.approx(START_SOC - 4.0)


def test_plans_hold_the_remaining_rides_and_are_valid():
    (shift,) = concatenate_drives([make_drive(i, 3000.0 * i) for i in range(4)], 8.0)
    plans = decode_plans(make_plans(shift))
    legs = [plan_leg(one) for one in shift.drives]
    assert [plan.legs for plan in plans] == [legs[done:] for done in range(5)]
    assert [plan.time_s for plan in plans] == [shift.drives[0].start, *(one.end for one in shift.drives)]
    assert {plan.shift_end_s for plan in plans} == {shift.end}
    assert [find_refusal(plan, plan.time_s) for plan in plans] == [None] * 5


def test_planned_distances_and_times_have_the_errors_of_a_plan():
    drives = [make_drive(i, 3000.0 * i) for i in range(400)]
    assert integrate_distance(drives[0]) == pytest.approx(12.0)
    legs = [plan_leg(one) for one in drives]
    assert legs == [plan_leg(one) for one in drives]
    off = np.array([[one.distance_km / 12.0 - 1.0, np.log(one.duration_s / 1200.0)] for one in legs])
    assert off.mean(axis=0) == pytest.approx([0.0, 0.0], abs=0.02)
    assert off.std(axis=0) == pytest.approx([0.04, 0.12], rel=0.15)


@given(st.lists(st.floats(-500.0, 500.0), min_size=1, max_size=50), st.floats(-100.0, 100.0))
def test_climbs_and_descents_add_up_and_are_independent_of_the_level(heights, level):
    gained, lost = compute_climb(np.array(heights))
    assert gained >= 0.0
    assert lost >= 0.0
    assert abs((gained - lost) - (heights[-1] - heights[0])) <= ELEVATION_PLAY + 0.1
    assert compute_climb(np.array(heights) + level) == pytest.approx((gained, lost), abs=0.11)
    ups = np.diff(heights)
    assert gained <= ups[ups > 0.0].sum() + 0.1


def test_undulations_of_the_sensor_are_not_counted_as_climbs():
    heights = 200.0 + np.random.default_rng(1).uniform(-0.5, 0.5, 5000) * ELEVATION_PLAY * 0.99
    gained, lost = compute_climb(heights)
    assert gained + lost < ELEVATION_PLAY


@pytest.mark.parametrize("name", ["ved", "bmw-i3", "twizy"])
def test_every_importer_makes_synthetic_shifts_on_request(tmp_path, name):
    path = write_good_file(tmp_path, name)
    results = {}
    for hours in (None, 2.0):
        out = tmp_path / f"{hours}.mcap"
        option = [] if hours is None else ["--shift-hours", hours]
        ran = run_import(name, path, "--out", out, *option)
        assert ran.exit_code == 0, ran.exception
        assert ("concatenated into 1 synthetic shifts" in ran.output) == (hours is not None)
        results[hours] = [message for block in McapSource(out) for message in block]
    kinds = [message.key.rpartition("/")[2] for message in results[2.0]]
    assert kinds.count("plan") == 2
    assert kinds[0] == "plan"  # and so is the first forecast by plan
    assert len(results[2.0]) == len(results[None]) + 2


@pytest.mark.skipif(not DATA.is_dir(), reason=f"the public data sets are not at {DATA}")
def test_rides_of_the_leaf_become_valid_shifts():
    drives = collect_drives([DATA / "ved_ev"], DATA_SETS["ved"])
    shifts = concatenate_drives(drives, 3.0)
    assert sum(len(shift.drives) for shift in shifts) == len(drives) == 135
    assert len(shifts) >= 10
    assert all(find_refusal(plan, plan.time_s) is None for shift in shifts for plan in decode_plans(make_plans(shift)))
    soc = np.concatenate([one.rows["soc_pct"] for shift in shifts for one in shift.drives])
    assert np.nanmin(soc) >= LOWEST_SOC - 0.5
    assert np.nanmax(soc) <= 100.0
    used = sum(shift.drives[0].rows["soc_pct"][0] - shift.drives[-1].rows["soc_pct"][-1] for shift in shifts)
    assert used == pytest.approx(sum(one.rows["soc_pct"][0] - one.rows["soc_pct"][-1] for one in drives), rel=0.02)


def test_shift_has_one_weather():
    """Rides in other weather wait for another shift, and none is lost."""
    drives = []
    for number, celsius in enumerate([5.0, -8.0, 8.0, -6.0, 3.0, 25.0, np.nan]):
        drive = make_drive(number, 86_400.0 * number, minutes=20.0)
        drives.append(drive._replace(rows={**drive.rows, "ambient_c": np.full(len(drive.elapsed), celsius)}))
    shifts = [[drive.ride_id for drive in shift.drives] for shift in concatenate_drives(drives, 4.0)]
    assert shifts == [["ride-0", "ride-2", "ride-4", "ride-6"], ["ride-1", "ride-3"], ["ride-5"]]
