"""Every name belongs to exactly one shard, and the key expressions of the shards say the same."""

from string import ascii_letters, digits

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from socast.core.errors import SettingsError
from socast.core.pipeline import Pipeline
from socast.core.wire.messages import IDENTITY
from socast.core.wire.shard import MOST_SHARDS, Shard, parse_shard
from tests.support.faulty_shifts import CARS, shift

NAMES = st.from_regex(IDENTITY, fullmatch=True)
COUNTS = st.integers(1, MOST_SHARDS)


def list_shards(count: int) -> list[Shard]:
    return [Shard(index, count) for index in range(1, count + 1)]


@given(name=NAMES, count=COUNTS)
def test_a_name_belongs_to_one_shard_and_only_its_key_expressions_match(name, count):
    key = zenoh.KeyExpr(f"fleet/{name}/telemetry")
    owners = [shard for shard in list_shards(count) if shard.has(name)]
    assert len(owners) == 1
    matching = [end for end in owners[0].list_ends() if zenoh.KeyExpr(f"fleet/{end}/**").includes(key)]
    assert len(matching) == 1
    others = [end for shard in list_shards(count) if shard != owners[0] for end in shard.list_ends()]
    assert not any(zenoh.KeyExpr(f"fleet/{end}/**").intersects(key) for end in others)


@given(name=st.text(), count=COUNTS)
def test_any_text_belongs_to_one_shard(name, count):
    assert sum(shard.has(name) for shard in list_shards(count)) == 1


@pytest.mark.parametrize(("count", "ratio"), [(2, 1.0), (4, 1.2), (7, 1.4), (10, 1.0), (16, 1.12), (100, 1.0)])
def test_numbered_cars_are_divided_as_evenly_as_digits_are(count, ratio):
    names = [f"taxi-{number:05d}" for number in range(10_000)]
    sizes = [sum(shard.has(name) for name in names) for shard in list_shards(count)]
    assert max(sizes) <= ratio * len(names) / count


@pytest.mark.parametrize("count", [1, 2, 10, 11, 100])
def test_all_ends_are_distributed(count):
    ends = [end for shard in list_shards(count) for end in shard.list_ends()]
    assert len(ends) == len(set(ends))
    for last in f"{ascii_letters}{digits}_.-":
        assert any(zenoh.KeyExpr(f"fleet/{end}").includes(zenoh.KeyExpr(f"fleet/{last}")) for end in ends)


@given(seed=st.integers(0, 50), count=st.integers(1, 5))
def test_forecasts_of_the_shards_together_are_those_of_one_consumer(seed, count):
    messages = shift(seed)
    expected = Pipeline().push(messages)
    shards = [Pipeline() for _ in range(count)]
    out = []
    for shard, pipeline in zip(list_shards(count), shards, strict=True):
        mine = [m for m in messages if not m.key.startswith("fleet/") or shard.has(m.key.split("/")[1])]
        out += pipeline.push(mine)
    assert sorted(out) == sorted(expected)
    assert {name for pipeline in shards for name in pipeline.lanes.names} <= set(CARS)


@pytest.mark.parametrize("text", ["", "0/4", "5/4", "1/101", "a/b", "1/2/3", "-1/4", "1", "١/٢"])
def test_what_names_no_shard_is_refused(text):
    with pytest.raises(SettingsError, match="such as 2/4"):
        parse_shard(text)
