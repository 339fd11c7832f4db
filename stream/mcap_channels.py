"""The channels of an MCAP recording: which key the messages of each have, and which have none.

A file may hold several recordings, one after another. Each has numbers of channels of its own, and all share the keys.
"""

from collections import Counter
from typing import Final

import numpy as np

from socast.core.batch import Ints, grown
from socast.stream.mcap_format import (
    CHANNEL,
    FOR_VIEWERS,
    SCHEMA,
    OversizedError,
    decode_channel,
    explain_foreign_channel,
    iterate_strings,
)
from socast.stream.mcap_losses import Losses

LARGEST_DESCRIPTION: Final = 1 << 20
"""Largest schema or channel. [B]"""
MOST_DESCRIPTIONS: Final = 1 << 18
"""Largest number of descriptions that differ from the one before of the same number."""
DESCRIPTION_BYTES: Final = 64 << 20
"""Largest size of all schemas and channels together. [B]"""
_UNKNOWN: Final = -1


class Topics:
    """Hold what the recordings of a file share.

    Attributes
    ----------
    keys : list of str
        Topics of the channels that follow the wire contract.
    schemas : dict of str to str
        Name of the schema by topic, for the topics read so far; an empty name for a topic without a schema.
    changes, size : int
        Number and size of the descriptions so far. [1], [B]
    """

    def __init__(self) -> None:
        self.keys: list[str] = []
        self.schemas: dict[str, str] = {}
        self.changes = self.size = 0
        self._numbers: dict[str, int] = {}

    def number(self, topic: str) -> int:
        """Return the number of a key."""
        number = self._numbers.setdefault(topic, len(self.keys))
        if number == len(self.keys):
            self.keys.append(topic)
        return number


class Channels:
    """Hold the channels of one recording.

    Attributes
    ----------
    foreign : dict of int to (str, str)
        Topic of each channel whose messages are left out, and the reason.
    """

    def __init__(self, topics: Topics) -> None:
        self._topics = topics
        self.foreign: dict[int, tuple[str, str]] = {}
        self._schemas: dict[int, tuple[str, str, bytes]] = {}
        self._keys = np.zeros(0, np.int64)
        self._for_viewers: set[int] = set()
        self._learnt: dict[tuple[int, bytes], bytes] = {}

    def know(self, opcode: int, body: bytes) -> bool:
        """Return whether a record is the last description of its number."""
        return self._learnt.get((opcode, body[:2])) == body

    def learn(self, opcode: int, body: bytes) -> None:
        """Store a schema or a channel; ignore other records."""
        if opcode not in {SCHEMA, CHANNEL} or self.know(opcode, body):
            return
        topics = self._topics
        before = len(self._learnt.get((opcode, body[:2]), b""))
        if (
            len(body) > LARGEST_DESCRIPTION
            or topics.changes >= MOST_DESCRIPTIONS
            or topics.size + len(body) - before > DESCRIPTION_BYTES
        ):
            raise OversizedError(f"a description of {len(body):,} bytes, number {topics.changes + 1:,}")
        topics.changes += 1
        topics.size += len(body) - before
        number = int.from_bytes(body[:2], "little")
        if opcode == SCHEMA:
            name, form, data = iterate_strings(body, 2, 3)
            self._schemas[number] = (name.decode(), form.decode(), data)
        else:
            self._learn_channel(number, body)
        self._learnt[opcode, body[:2]] = body

    def _learn_channel(self, number: int, body: bytes) -> None:
        """Store a channel."""
        topic, encoding, marks = decode_channel(body)
        wire = self._schemas.get(int.from_bytes(body[2:4], "little"), ("", "", b""))
        self._topics.schemas[topic] = wire[0]
        is_for_viewers = marks == FOR_VIEWERS
        (self._for_viewers.add if is_for_viewers else self._for_viewers.discard)(number)
        reason = f"topic {topic} is for viewers" if is_for_viewers else ""
        reason = reason or explain_foreign_channel(topic, encoding, *wire)
        self._keys = grown(self._keys, max(number + 1, len(self._keys)), _UNKNOWN)
        self._keys[number] = _UNKNOWN if reason else self._topics.number(topic)
        if reason:
            self.foreign[number] = (topic, reason)

    def find_keys(self, channel: Ints, key: Ints, losses: Losses, for_viewers: Counter[str]) -> None:
        """Write the number of the key of each message, -1 where it has none; count those that are left out."""
        known = channel < len(self._keys)
        key[known], key[~known] = self._keys[channel[known]], _UNKNOWN
        if (key >= 0).all():
            return
        for number, count in zip(*np.unique(channel[key < 0], return_counts=True), strict=True):
            if number in self.foreign:
                left_out = for_viewers if number in self._for_viewers else losses.foreign
                left_out[self.foreign[number][0]] += int(count)
            else:
                losses.undescribed += int(count)
