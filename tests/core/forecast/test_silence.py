"""Test the outlook of cars that fell silent: their shift is over, and no charge is published."""

import pytest

from socast.core.pipeline import Pipeline
from socast.core.wire.messages import Leg
from socast.tools.commands.ask import verdict
from tests.support.fleet_days import DAYS, LEG, RIDE, columns, shift, trained_pipeline
from tests.support.telemetry import make_message

CAR = "c"
BEGIN = float(columns(CAR, DAYS)["time_s"][0])
QUERIED_RIDE = Leg(8.0, 700.0)


@pytest.mark.parametrize("leg", [None, QUERIED_RIDE])
def test_silent_car_gets_no_forecast_while_others_continue(leg):
    pipeline = trained_pipeline()
    pipeline.push([m for time, m in shift(CAR, DAYS) if time <= BEGIN + LEG + RIDE + 100.0])
    before = pipeline.ask(CAR, leg)
    later = [make_message("telemetry", "f", BEGIN + 15.0 * i, soc_pct=80.0) for i in range(8 * 240)]  # eight hours
    for some in (later[:400], later[400:900]):
        pipeline.push(some)
        assert pipeline.ask(CAR, leg) == before
    pipeline.push(later[900:])
    kept = Pipeline(settings=pipeline.settings)
    kept.restore(pipeline.snapshot())
    answer = kept.ask(CAR, leg)
    assert answer == pipeline.ask(CAR, leg)
    assert "has been silent for 7.5 h" in answer.why_not
    assert answer.soc_end_of_shift_pct is answer.reserve_risk is answer.shift_end_s is None
    assert {each.soc_pct for each in (answer.asked, *answer.legs) if each} <= {None}
    assert (answer.time_s, answer.soc_pct) == (before.time_s, before.soc_pct)
    assert (answer.asked and answer.asked.energy_kwh) == (before.asked and before.asked.energy_kwh)
    assert verdict(answer)[0] == "NOT KNOWN"


def test_car_with_clock_hours_behind_is_not_silent():
    pipeline = trained_pipeline()
    ahead = 9.0 * 3600.0
    for time, message in shift(CAR, DAYS)[:300]:
        others = [make_message("telemetry", car, time + ahead, soc_pct=80.0) for car in ("d", "e", "f")]
        pipeline.push([message, *others])
    assert pipeline.ask(CAR).why_not is None
