"""Gaps in the numbers of publishers are found, asked for, or counted, and nothing else is."""

from types import SimpleNamespace
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from socast.stream import zenoh_gaps
from socast.stream.zenoh_gaps import SampleGaps


def sample(number: int | None, publisher: str = "a") -> Any:
    source = None if number is None else SimpleNamespace(source_id=publisher, source_sn=number)
    return SimpleNamespace(source_info=source)


def find(gaps: SampleGaps, *numbers: int | None, key: int = 0, may_ask: bool = False) -> list[tuple[int, int]]:
    """Look at samples of one publisher; return from which number up to which sample was asked for."""
    asked: list[tuple[int, int]] = []

    def ask(each: Any, first: int) -> bool:
        asked.append((first, each.source_info.source_sn))
        return may_ask

    waits = gaps.find([key] * len(numbers), [sample(each) for each in numbers], ask)
    assert waits == (may_ask and bool(asked))
    return asked


def test_a_publisher_may_begin_with_any_number():
    gaps = SampleGaps()
    assert find(gaps, 7, 8) == find(gaps, 9) == find(gaps, 3, key=1) == []
    assert gaps.missed == 0


def test_a_gap_that_is_not_asked_for_is_counted_once():
    gaps = SampleGaps()
    assert find(gaps, 1, 4, 5, 9) == [(2, 4), (6, 9)]
    assert find(gaps, 10) == []
    assert gaps.missed == 2 + 3


def test_samples_after_a_gap_that_was_asked_for_are_looked_at_again():
    gaps = SampleGaps()
    assert find(gaps, 1, 4, 5, may_ask=True) == [(2, 4)]
    assert gaps.missed == 0
    assert find(gaps, 2, 3, 4, 5) == []
    assert find(gaps, 6) == []
    assert gaps.missed == 0


def test_what_was_asked_for_and_did_not_come_is_counted_and_not_asked_for_again():
    gaps = SampleGaps()
    assert find(gaps, 1, 4, 5, may_ask=True) == [(2, 4)]
    assert find(gaps, 3, 4, 5, may_ask=True) == []
    assert gaps.missed == 1
    assert find(gaps, 6, 9, 12, may_ask=True) == [(7, 9)]
    assert find(gaps, 7, 8, 9, 12, may_ask=True) == [(10, 12)]


def test_repeated_and_late_samples_are_no_gaps():
    gaps = SampleGaps()
    assert find(gaps, 1, 2, 3) == find(gaps, 2, 2) == find(gaps, 1) == find(gaps, 4) == []
    assert gaps.missed == 0


def test_samples_without_numbers_are_left_alone():
    gaps = SampleGaps()
    assert find(gaps, None, None) == []
    assert gaps.missed == 0


def test_many_publishers_are_forgotten(monkeypatch):
    monkeypatch.setattr(zenoh_gaps, "MOST_PUBLISHERS", 3)
    gaps = SampleGaps()
    for key in range(10):
        find(gaps, 1, key=key)
        assert len(gaps._newest) <= 3


@given(st.data())
def test_what_never_came_is_counted_whatever_the_blocks_and_the_publishers_of_a_key(data):
    publishers = st.tuples(st.integers(0, 2), st.sampled_from("ab"))
    sent: dict[tuple[int, str], int] = {}
    came: list[tuple[int, str, int]] = []
    for key, publisher in data.draw(st.lists(publishers, max_size=60)):
        number = sent[key, publisher] = sent.get((key, publisher), -1) + 1
        if number == 0 or data.draw(st.booleans()):
            came.append((key, publisher, number))
    gaps, at = SampleGaps(), 0
    while at < len(came):
        block = came[at : at + data.draw(st.integers(1, 9))]
        gaps.find([key for key, _, _ in block], [sample(n, who) for _, who, n in block], lambda *_: False)
        at += len(block)
    newest = {(key, who): number for key, who, number in came}
    assert gaps.missed == sum(number + 1 for number in newest.values()) - len(came)
