"""Test that a malformed prediction interval is refused."""

import pytest

from socast.core.models.interval import ANY, PredictionInterval


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scales": {}}, "without a scale"),
        ({"levels": (0.9, 0.1)}, "do not ascend"),
        ({"quantiles": ((1.0, -1.0),)}, "do not ascend"),
        ({"quantiles": ((1.0,),)}, "without 2 quantiles"),
        ({"distances_km": (1.0,)}, "classes of rides"),
        ({"quantiles": ((-1.0, float("inf")),)}, "not finite"),
    ],
)
def test_malformed_interval_is_refused(change, message):
    good = {
        "scales": {ANY: (0.1, 0.0, 0.0)},
        "distances_km": (0.0,),
        "levels": (0.1, 0.9),
        "quantiles": ((-1.0, 1.0),),
    }
    assert PredictionInterval(**good).rides == 0
    with pytest.raises(ValueError, match=message):
        PredictionInterval(**(good | change))
