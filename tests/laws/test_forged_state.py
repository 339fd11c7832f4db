"""Test that a state with a valid checksum and any content is refused in one line, or leads to plausible forecasts."""

from hashlib import sha256
from typing import Final

import pytest

from socast.core.errors import SocastError
from socast.core.pipeline import Pipeline
from socast.core.snapshot import SCHEMAS
from tests.support.forged_states import COMPONENTS, forge, make_content, make_pipeline, nest, run

pytestmark = pytest.mark.long
MUTATIONS = 12
"""Number of mutations of each part, chosen by a fixed seed."""
FEWER: Final = {"engine": 5}
"""The same of a component with hundreds of parts."""


@pytest.mark.parametrize("name", ["shift.mcap", "autumn.mcap"])
def test_state_that_was_not_forged_is_accepted(name):
    assert not run(make_content(name), name)


def test_every_component_has_a_schema():
    deferred = Pipeline(keep_forecasts=False, two_sided=True)
    for pipeline in (make_pipeline(), deferred):
        assert SCHEMAS.keys() >= pipeline._get_components().keys()
    assert SCHEMAS.keys() == deferred._get_components().keys() | make_pipeline()._get_components().keys()


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("component", COMPONENTS)
def test_forged_part_of_a_state_is_refused_or_harmless(component):
    refused, tried = forge(component, places=1, mutations=FEWER.get(component, MUTATIONS))
    assert refused > 0.3 * tried


@pytest.mark.parametrize("state", [None, [], "x", {}, {"lanes": []}, nest(200), dict.fromkeys(COMPONENTS)], ids=repr)
def test_state_without_its_components_is_refused(state):
    assert run(make_content("shift.mcap") | {"state": state}, "shift.mcap")


def test_unknown_and_missing_components_are_refused():
    content = make_content("shift.mcap")
    assert run(content | {"state": content["state"] | {"intake": []}}, "shift.mcap")
    for component in COMPONENTS:
        rest = {name: value for name, value in content["state"].items() if name != component}
        assert run(content | {"state": rest}, "shift.mcap")


@pytest.mark.parametrize(
    "packed", [b"", b"\xc1", b"\x91" * 5000, b"\x80", b"\x93\x01\x02\x03", b"\xdf\xff\xff\xff\xff"]
)
def test_checksum_over_anything_else_is_refused(packed):
    with pytest.raises(SocastError):
        make_pipeline().restore(sha256(packed).digest() + packed)


@pytest.mark.parametrize("key", ["version", "fields", "effects", "model"])
@pytest.mark.parametrize("value", [None, 5, [], {}, "x" * 10_000, nest(100)], ids=lambda value: str(value)[:20])
def test_forged_head_is_refused_or_harmless(key, value):
    run(make_content("shift.mcap") | {key: value}, "shift.mcap")
