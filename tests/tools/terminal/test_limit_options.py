"""Test the options of the limits, and the warning when one is first reached."""

import logging

from socast.core.pipeline import Pipeline
from socast.core.settings import LIVE_KEY_RATE, Limits
from socast.tools.terminal.live_options import LimitLog, make_limits
from tests.support.telemetry import leaf, make_message, observed


def test_options_define_the_limits_and_their_defaults_limit_the_rate():
    assert make_limits() == Limits(key_rate=LIVE_KEY_RATE)
    assert make_limits(max_vehicles=5, key_burst=7) == Limits(vehicles=5, key_rate=LIVE_KEY_RATE, key_burst=7)


def test_each_limit_that_is_reached_is_warned_of_once(caplog):
    pipeline = Pipeline(limits=Limits(stations=1, vehicle_models=1))
    watch = LimitLog(pipeline)
    with caplog.at_level(logging.WARNING):
        watch(None)
        pipeline.push([observed("a"), observed("b"), leaf(), make_message("vehicle", model="horse")])
        watch(None)
        pipeline.push([observed("c")])
        watch(None)
    assert [record.fields["cause"] for record in caplog.records] == ["too_many_stations", "too_many_models"]
    assert caplog.records[0].fields["option"] == "--max-stations"
