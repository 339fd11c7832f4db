"""`socast check` says what the logger of each car sends wrong, what that costs, and what to do."""

import json

import numpy as np
import pandas as pd
import pytest

from socast.core.cleaning.faults import FAULTS
from socast.core.cleaning.quality import CAUSES, Quality
from socast.core.totals.run_counters import CarCounters
from socast.stream.mcap_writer import McapSink
from socast.tools.terminal.fault_report import choose_next_step, report_cars, show_cars
from socast.tools.terminal.output import make_console
from tests.support.commands import called
from tests.support.telemetry import drive, leaf, telemetry

RIDES = pd.DataFrame(
    {
        "vehicle_id": ["a", "a", "b", "b"],
        "duration_s": [1800.0, 3600.0, 1800.0, 20.0],
        "distance_km": [10.0, 30.0, 12.0, 0.1],
        "fit_for_training": [True, False, True, False],
        "unfit_reason": [None, "speed_missing", None, "too_short"],
    }
)


def count(**samples):
    """Return the counts of a car by quality bit."""
    return [samples.get(cause, 0) for cause in CAUSES]


def make_report(facts=None, rides=RIDES, **of_b):
    faults = np.array([count(speed_missing=600, gap=3), count(**of_b)])
    return report_cars(["a", "b"], np.array([1000, 1000]), faults, rides, facts)


def print_report(cars, capsys):
    show_cars(cars, make_console())
    return capsys.readouterr().out


def test_each_quality_bit_has_words_of_its_own():
    assert set(FAULTS) == set(Quality)
    assert len({fault.title for fault in FAULTS.values()}) == len(Quality)
    assert all(fault.title and fault.cost and fault.remedy for fault in FAULTS.values())


def test_samples_are_counted_for_each_car():
    counters = CarCounters()
    counters.count_samples(np.array([0, 1, 3]), np.array([2, 0, 2]))
    counters.count_samples(np.array([2]), np.array([0]))
    counters.count_samples(np.zeros(0, np.int64), np.zeros(0, np.int64))
    samples, faults = counters.list_cars(4)
    assert samples.tolist() == [2, 0, 2, 0]
    assert faults[:, :2].tolist() == [[1, 1], [0, 0], [1, 1], [0, 0]]
    assert counters.samples[:2].tolist() == [2, 2]


def test_page_shows_faults_costs_and_remedies_of_a_car_and_clean_cars_in_one_line(capsys):
    out = print_report(make_report(late=1, ambient_filled=1000), capsys)
    lines = [" ".join(line.split()) for line in out.splitlines()]
    assert "speed missing 600 60.0 kinetic energy and drag are less exact; the ride where it lasts" in lines
    assert "1 of 2 rides is unfit for training: 1.00 of 1.50 h, 30.0 of 40.0 km." in lines
    assert "speed missing send the speed in each sample" in lines
    assert [line for line in lines if line.startswith("Clean") and line.endswith(": b.")]
    assert "b: 1,000 samples" not in out


def test_rides_of_clean_cars_that_are_left_out_by_their_length_are_told_with_the_option(capsys):
    out = print_report(make_report(rides=RIDES.replace("too_short", "too_long")), capsys)
    assert "Unfit for training: 1 of 2 rides, 0.1 of 12.1 km, too long; --longest-ride-min sets the limit." in out


def test_rare_faults_of_a_car_are_named_in_one_line(capsys):
    out = print_report(make_report(gap=500, late=1), capsys)
    assert "In at most 0.1 % of the samples: sample out of order." in out


def test_car_that_loses_most_comes_first_and_its_reason_is_the_next_step():
    cars = make_report(gap=500)
    assert [car.vehicle_id for car in cars] == ["a", "b"]
    assert (cars[0].lost_km, cars[0].lost_hours) == (30.0, 1.0)
    assert "speed missing, 30.0 km" in choose_next_step(cars)


@pytest.mark.parametrize(
    ("bits", "expected"),
    [({"gap": 500}, "Remedy: store samples"), ({"ambient_filled": 1000}, "Nothing is to be mended")],
)
def test_next_step_is_the_remedy_of_the_most_frequent_fault_where_no_ride_is_lost(bits, expected):
    cars = report_cars(["b"], np.array([1000]), np.array([count(**bits)]), RIDES)
    assert expected in choose_next_step(cars)


def test_fact_about_a_whole_logger_comes_first(capsys):
    cars = make_report({"b": ["current has the wrong sign"]})
    assert (cars[0].vehicle_id, cars[0].is_clean) == ("b", False)
    assert choose_next_step(cars) == "First mend the logger of b: current has the wrong sign"
    assert "current has the wrong sign" in print_report(cars, capsys)


def test_command_counts_the_faults_of_a_recording(tmp_path):
    wrong = drive(300, soc_pct=60.0)
    wrong["speed_kmh"] = np.where(np.arange(300) % 3, wrong["speed_kmh"], np.nan)
    with McapSink(tmp_path / "r.mcap") as sink:
        sink.put(
            [leaf("good"), leaf("wrong"), *telemetry(drive(300, soc_pct=60.0), "good"), *telemetry(wrong, "wrong")]
        )
    out, _, code = called("check", tmp_path / "r.mcap", "--json", tmp_path / "check.json")
    report = json.loads((tmp_path / "check.json").read_text())
    cars = {car["vehicle_id"]: car for car in report["cars"]}
    assert code == 0
    assert cars["wrong"]["faults"]["speed_missing"]["samples"] == 99  # not known to be sent before the second one
    assert cars["wrong"]["faults"]["speed_missing"]["remedy"] == "send the speed in each sample"
    assert "speed_missing" not in cars["good"]["faults"]
    assert cars["good"]["samples"] == cars["wrong"]["samples"] == 300
    assert report["next_step"] in " ".join(out.split())
