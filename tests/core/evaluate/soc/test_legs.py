"""Test that single legs are matched to their rides, and that no match crosses a charge or a shift."""

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from socast.core.errors import AskError
from socast.core.evaluate.soc.recorders import LEAST_INTERVAL, LegRecorder, match_legs_to_rides
from socast.core.evaluate.soc.report import evaluate_soc
from socast.core.wire.messages import Interval, LegOutlook, Outlook
from tests.support.soc_frames import CAPACITY, make_frames

BEGIN = 1_516_017_600.0
HOUR = 3600.0
CAR = "taxi-1"


def outlook(time, socs=(60.0, 50.0)):
    """Return an outlook with legs of 10 km that end at the given states of charge."""
    legs = [LegOutlook(10.0, HOUR, None, None if soc is None else Interval(soc, soc - 2.0, soc + 2.0)) for soc in socs]
    return Outlook(CAR, time, "m/1", 70.0, 0.5, None, None, None, None, legs, None, None, 10.0, None, None)


def make_legs(time=BEGIN, legs=3):
    """Return the recorded legs of one query."""
    place = np.arange(legs)
    soc = 70.0 - 10.0 * (place + 1)
    return pd.DataFrame(
        {
            "vehicle_id": CAR, "time_s": time, "leg": place, "ahead_km": 10.0 * (place + 1),
            "soc_pct": 70.0, "soc_mean_pct": soc, "soc_p05_pct": soc - 2.0, "soc_p95_pct": soc + 2.0,
        }
    )  # fmt: skip


def rides(*ends, km=10.0, since_charge=np.nan):
    """Return rides that end the given hours after the beginning, each with a different final state of charge."""
    hours = np.array(ends, dtype=float)
    return pd.DataFrame(
        {
            "vehicle_id": CAR, "end_s": BEGIN + HOUR * hours, "distance_km": km, "soc_end_pct": 70.0 - 10.0 * hours,
            "time_since_charge_s": since_charge,
        }
    )  # fmt: skip


def shifts(hours=8.0, charged=np.nan):
    return pd.DataFrame(
        {
            "vehicle_id": [CAR], "shift": [0], "vehicle_model": ["nissan-leaf-2016"], "begin_s": [BEGIN],
            "end_s": [BEGIN + HOUR * hours], "charged_s": [BEGIN + HOUR * charged], "capacity_kwh": [CAPACITY],
        }
    )  # fmt: skip


def test_each_leg_is_matched_to_its_ride():
    matched = match_legs_to_rides(make_legs(), rides(-1.0, 1.0, 2.0, 3.5, 4.0), shifts())
    assert matched["leg"].tolist() == [0, 1, 2]
    assert matched["minutes"].tolist() == [60.0, 120.0, 210.0]
    assert matched["soc_end_pct"].tolist() == [60.0, 50.0, 35.0]
    assert not matched["charges"].any()


def test_ride_that_ended_at_query_time_is_not_matched():
    assert match_legs_to_rides(make_legs(legs=1), rides(0.0, 1.0), shifts())["minutes"].tolist() == [60.0]


def test_very_short_ride_is_not_matched():
    both = pd.concat([rides(0.5, km=0.1), rides(1.0)])
    assert match_legs_to_rides(make_legs(legs=1), both, shifts())["minutes"].tolist() == [60.0]


def test_undriven_legs_and_rides_of_next_shift_or_other_car_are_left_out():
    assert len(match_legs_to_rides(make_legs(legs=3), rides(1.0), shifts())) == 1
    assert len(match_legs_to_rides(make_legs(legs=3), rides(1.0, 20.0, 21.0), shifts())) == 1
    other = rides(1.0).assign(vehicle_id="taxi-2")
    assert match_legs_to_rides(make_legs(legs=3), other, shifts()).empty


@given(hour=st.integers(0, 5), past=st.floats(0.05, 0.95))
@settings(max_examples=30, deadline=None)
def test_legs_are_matched_up_to_next_charge_only(hour, past):
    charged = hour + past
    ends = np.arange(1.0, 7.0)
    since = np.where(ends > charged, HOUR * (ends - charged), np.nan)
    matched = match_legs_to_rides(make_legs(legs=6), rides(*ends, since_charge=since), shifts(charged=charged))
    assert matched["minutes"].tolist() == (60.0 * ends[ends <= charged]).tolist()
    assert matched["charges"].all()
    later = match_legs_to_rides(
        make_legs(BEGIN + HOUR * charged + 1.0, legs=6), rides(*ends, since_charge=since), shifts()
    )
    assert len(later) == np.sum(ends > charged)


def test_recorder_keeps_legs_of_known_charge_and_one_answer_of_two_soon_after_each_other():
    answers = iter([outlook(BEGIN + offset, (60.0, None)) for offset in (0.0, 5.0, LEAST_INTERVAL, -HOUR)])
    questions = LegRecorder(lambda _: next(answers))
    for _ in range(4):
        questions.query(CAR)
    table = questions.table()
    assert table["time_s"].tolist() == [BEGIN, BEGIN + LEAST_INTERVAL]
    assert table["leg"].tolist() == [0, 0]
    assert table["soc_mean_pct"].tolist() == [60.0, 60.0]


def test_vehicle_without_usable_sample_gives_no_legs():
    def refuse(_vehicle):
        raise AskError("vehicle 'taxi-1' has sent nothing so far: give one that has", "unknown_vehicle")

    questions = LegRecorder(refuse)
    questions.query(CAR)
    assert questions.table().empty


def test_leg_belongs_to_shift_in_which_it_was_queried():
    both = pd.concat([shifts(8.0), shifts(8.0).assign(shift=1, begin_s=BEGIN + 12 * HOUR, end_s=BEGIN + 20 * HOUR)])
    asked = pd.concat([make_legs(legs=1), make_legs(BEGIN + 13 * HOUR, legs=1), make_legs(BEGIN - HOUR, legs=1)])
    matched = match_legs_to_rides(asked, rides(1.0, 14.0), both)
    assert matched["shift"].tolist() == [0, 1]
    assert matched["minutes"].tolist() == [60.0, 60.0]


def test_no_queries_or_no_rides_give_no_legs():
    none = LegRecorder(lambda _: outlook(BEGIN)).table()
    assert match_legs_to_rides(none, rides(1.0), shifts()).empty
    assert match_legs_to_rides(make_legs(), rides(), shifts()).empty


def test_leg_figures_match_planted_errors():
    frames = make_frames(cars=2, days=20)
    days = frames.shifts["shift"].to_numpy()
    rng = np.random.default_rng(2)
    of_shifts = frames.shifts.rename(columns={"soc_end_pct": "shift_end_pct"})
    of_shifts = of_shifts.assign(
        leg=0, ahead_km=10.0, soc_pct=60.0, time_s=of_shifts["begin_s"], ride_end_s=of_shifts["begin_s"] + HOUR
    )
    of_shifts = of_shifts.assign(minutes=np.where(days % 2, 20.0, 90.0), charges=days % 4 == 0, soc_mean_pct=50.0)
    error = rng.normal(0.0, 1.0, len(of_shifts))
    legs = of_shifts.assign(
        soc_p05_pct=48.0, soc_p95_pct=52.0, soc_end_pct=50.0 + error, cluster=np.arange(len(of_shifts))
    )
    matched = evaluate_soc(*frames, legs).legs
    assert [each.bin for each in matched["without a charge"]] == ["below 30", "60 to 120", "all"]
    assert [each.bin for each in matched["charged later"]] == ["60 to 120", "all"]
    for name, mine in (("without a charge", days % 4 != 0), ("charged later", days % 4 == 0)):
        whole = matched[name][-1]
        assert whole.n == mine.sum()
        assert whole.mae_pct.value == pytest.approx(np.abs(error[mine]).mean())
        assert whole.coverage.value == np.mean(np.abs(error[mine]) <= 2.0)
        assert whole.baselines["linear"].n == 0
        assert whole.baselines["rating"].n == mine.sum()
    assert evaluate_soc(*frames).legs == {}


def test_only_legs_before_the_next_planned_charge_are_recorded():
    answer = outlook(BEGIN)
    charge = LegOutlook(0.0, HOUR, None, Interval(80.0, 70.0, 90.0), 80.0)
    answer.legs.insert(1, charge)
    recorder = LegRecorder(lambda _: answer)
    recorder.query(CAR)
    assert recorder.table()["soc_mean_pct"].tolist() == [60.0]
