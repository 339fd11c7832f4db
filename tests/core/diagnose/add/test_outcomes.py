"""Test which trials add an effect, which refuse it, and which leave it undecided."""

import pytest

from socast.core.diagnose.add.add import _judge
from socast.core.diagnose.add.records import ADDED, REFUSED, UNDECIDED, EffectTrial, ErrorFall
from socast.core.evaluate.records import EstimatedValue

LEAST = 0.002


def make_results(gain, p, change, *, on_days=(-0.01, 0.005), on_vehicles=None):
    """Return the results of a trial; changes are (kWh, half of the 95 % interval)."""

    def estimate(pair):
        return EstimatedValue(value=pair[0], ci95=pair[1])

    def compared(pair):
        return pair and ErrorFall(clusters=100, change_kwh=estimate(pair))

    return EffectTrial(
        gain=estimate(gain),
        p=p,
        change_kwh=estimate(change),
        of_effect=compared(change),
        on_days=compared(on_days),
        on_vehicles=compared(on_vehicles),
    )


@pytest.mark.parametrize(
    ("results", "outcome", "words"),
    [
        pytest.param(make_results((0.2, 0.05), 1e-6, (-0.02, 0.01)), ADDED, "explains 20.0 %", id="falls"),
        pytest.param(make_results((0.2, 0.4), 1e-6, (-0.02, 0.04)), UNDECIDED, "400 vehicle-days", id="may fall"),
        pytest.param(make_results((0.2, 0.05), 1e-6, (0.01, 0.02)), UNDECIDED, "grows: by 10 ± 20 Wh", id="may grow"),
        pytest.param(make_results((0.2, 0.05), 1e-6, (0.03, 0.02)), REFUSED, "grows by at least 0.01", id="grows"),
        pytest.param(make_results((0.0, 0.001), 0.7, (0.0, 0.01)), REFUSED, "not worth a term", id="explains nothing"),
        pytest.param(
            make_results((0.001, 0.01), 0.3, (0.0, 0.01)), UNDECIDED, "about 10,000 vehicle-days", id="may explain"
        ),
        pytest.param(make_results((0.05, 0.1), 0.3, (-0.02, 0.01)), UNDECIDED, "p = 0.3; about 400", id="by chance"),
        pytest.param(make_results((0.2, None), 1e-6, (-0.02, None)), UNDECIDED, "give more days", id="one day"),
        pytest.param(
            make_results((0.2, 0.05), 1e-6, (-0.02, 0.01), on_days=(0.05, 0.02)),
            *(REFUSED, "with all terms refitted, grows by at least 0.03"),
            id="grows when refitted",
        ),
        pytest.param(
            make_results((0.2, 0.05), 1e-6, (-0.02, 0.01), on_vehicles=(0.05, 0.02)),
            *(REFUSED, "held-out vehicles"),
            id="grows on other vehicles",
        ),
    ],
)
def test_outcome_follows_the_interval_of_the_error_on_held_out_rides(results, outcome, words):
    found, reason = _judge(results, LEAST)
    assert (found, words in reason) == (outcome, True), reason
