"""Share the drives of a small fleet between the tests of the benchmark of hidden effects."""

from dataclasses import replace

import pytest

from socast.tools.bench.hidden import cases
from socast.tools.bench.hidden.cases import SeedData
from socast.tools.bench.hidden.drives import FLEET


@pytest.fixture(scope="session")
def source():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cases, "FLEET", replace(FLEET, vehicles=4, days=7, day_step=50))
        patch.setattr(cases, "TURNS", 1)
        whole = SeedData(5)
        whole.recording("none")
        yield whole
