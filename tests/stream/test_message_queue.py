"""The queue between the receiving thread and the loop is limited by number and by size, and keeps the order."""

from threading import Thread

import pytest

from socast.core.wire.messages import Message
from socast.stream.message_queue import MessageQueue
from tests.support.zenoh_sessions import eventually


def make_list(count: int, number: int = 0) -> list[Message]:
    return [Message(f"fleet/{number}/telemetry", b"x" * 10, each) for each in range(count)]


def test_lists_are_taken_in_order_and_joined_up_to_a_number():
    queue = MessageQueue(1e6)
    for number in range(4):
        assert queue.put(make_list(3, number), 30, patience_s=0.0)
    assert (queue.messages, queue.size) == (12, 120)
    assert queue.take(5, 1000) == (make_list(3, 0) + make_list(3, 1), False)
    assert queue.take(5, 1000) == (make_list(3, 2) + make_list(3, 3), False)
    assert (queue.messages, queue.size) == (0, 0)
    assert queue.take(5, 1000) == ([], False)


def test_lists_are_joined_up_to_a_size():
    queue = MessageQueue(1e6)
    for number in range(3):
        queue.put(make_list(3, number), 30, patience_s=0.0)
    assert len(queue.take(100, 31)[0]) == 6
    assert len(queue.take(100, 1)[0]) == 3


def test_recovered_messages_are_taken_apart_from_others():
    queue = MessageQueue(1e6)
    queue.put(make_list(1), 10, patience_s=0.0)
    queue.put(make_list(1), 10, recovered=True, patience_s=0.0)
    queue.put(make_list(1), 10, recovered=True, patience_s=0.0)
    queue.put(make_list(1), 10, patience_s=0.0)
    assert queue.take(9, 1000) == (make_list(1), False)
    assert queue.take(9, 1000) == (make_list(1) * 2, True)
    assert queue.take(9, 1000) == (make_list(1), False)


@pytest.mark.parametrize(("most_bytes", "most_messages"), [(30, 100), (1e6, 3)])
def test_a_full_queue_accepts_nothing_until_something_is_taken(most_bytes, most_messages):
    queue = MessageQueue(most_bytes, most_messages)
    assert queue.put(make_list(3), 30, patience_s=0.0)
    assert not queue.put(make_list(1), 10, patience_s=0.0)
    assert queue.messages == 3
    accepted: list[bool] = []
    thread = Thread(target=lambda: accepted.append(queue.put(make_list(1), 10, patience_s=60.0)))
    thread.start()
    queue.take(10, 1000)
    assert eventually(lambda: accepted == [True])
    thread.join()
    assert queue.messages == 1


def test_an_ended_queue_releases_who_waits_and_gives_what_it_holds():
    queue = MessageQueue(30)
    queue.put(make_list(3), 30, patience_s=0.0)
    accepted: list[bool] = []
    thread = Thread(target=lambda: accepted.append(queue.put(make_list(1), 10, patience_s=60.0)))
    thread.start()
    queue.end()
    assert eventually(lambda: accepted == [False])
    thread.join()
    assert queue.has_ended
    assert queue.wait(0.0)
    assert len(queue.take(10, 1000)[0]) == 3
    assert not queue.wait(60.0)


def test_a_dropped_queue_tells_how_many_messages_it_held_and_accepts_no_more():
    queue = MessageQueue(1e6)
    for number in range(2):
        queue.put(make_list(3, number), 30, patience_s=0.0)
    assert queue.drop() == 6
    assert (queue.messages, queue.size, queue.has_ended) == (0, 0, True)
    assert not queue.put(make_list(1), 10, patience_s=60.0)
    assert queue.drop() == 0
    assert queue.take(10, 1000) == ([], False)
