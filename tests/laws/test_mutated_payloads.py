"""Test that mutated payloads raise nothing, and that nothing implausible is published for them.

`python -m tests.support.mutated_payloads --count 1000000` runs the same check on a million payloads.
"""

import pytest

from tests.support.mutated_payloads import Check


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("seed", [0, 1])
def test_mutated_payloads_raise_nothing_and_lead_to_no_implausible_forecast(seed):
    check = Check(seed)
    check.run(30_000)
    assert check.faults == {}
    assert check.forecasts > 3000
    assert check.answers > 50
    rejected = check.pipeline.quality()["undecodable"]
    assert min(rejected[cause] for cause in ("not_json", "wrong_type", "key_mismatch", "plan_in_the_past")) > 10
