"""A car whose clock alternates teaches the fleet nothing, and moves no forecast of another car."""

import json
import re

import pytest

from socast.core.models import EXTENDED_PHYSICAL
from socast.core.pipeline import Pipeline
from socast.stream.mcap_reader import McapSource
from tests.support.paths import RECORDINGS

MOST_POINTS = 1.0
HOUR, DAY = 3600.0, 86_400.0
MIDNIGHT_S = 1_516_233_600.0
NEAR_S = 300.0
"""Time around midnight within which the daily update may come a moment earlier or later. [s]"""


def forecast(car=None, offset_s=0.0, every=1, *, is_absent=False):
    """Return mean and bounds of the SOC that others expect at the shift's end; the clock of a car alternates."""
    pipeline, out, count = Pipeline(EXTENDED_PHYSICAL), {}, 0

    def shift(match):
        return b'"time_s":%.3f' % (float(match[1]) + (offset_s if count // every % 2 else 0.0))

    for block in McapSource(RECORDINGS / "evening.mcap"):
        messages = []
        for each in block:
            if each.key == f"fleet/{car}/telemetry":
                count += 1
                if is_absent:
                    continue
                each = each._replace(payload=re.sub(rb'"time_s":([0-9.]+)', shift, bytes(each.payload)))  # noqa: PLW2901
            messages.append(each)
        pipeline.take(messages)
        for made in map(json.loads, (each.payload for each in pipeline.forecasts())):
            if (
                made["vehicle_id"] != car
                and "soc_end_of_shift_pct" in made
                and abs(made["time_s"] - MIDNIGHT_S) > NEAR_S
            ):
                for name, value in made["soc_end_of_shift_pct"].items():
                    out[made["vehicle_id"], made["time_s"], name] = value
    return out


@pytest.fixture(scope="module")
def healthy():
    return forecast()


@pytest.mark.parametrize(
    ("car", "offset_s", "every"),
    [("taxi-007", HOUR, 10), ("taxi-001", -HOUR, 10), ("taxi-007", DAY, 60), ("taxi-001", -DAY, 10)],
)
def test_forecasts_of_others_are_as_without_the_car_or_as_with_a_healthy_one(healthy, car, offset_s, every):
    absent, found = forecast(car, is_absent=True), forecast(car, offset_s, every)
    others = {key: value for key, value in healthy.items() if key[0] != car}
    assert found.keys() == others.keys()
    for key, value in found.items():
        low, high = sorted((absent[key], others[key]))
        assert low - MOST_POINTS <= value <= high + MOST_POINTS, key
