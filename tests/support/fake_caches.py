"""Samples of Zenoh, and a session whose router, tokens and caches a test controls."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import zenoh


class Payload(bytes):
    """The payload of a sample."""

    def to_bytes(self) -> bytes:
        return bytes(self)


@dataclass(frozen=True)
class Source:
    """The identity of a publisher."""

    zid: str
    eid: int = 0


def sample(payload: bytes, *, key="fleet/a/telemetry", session="1", number: int | None = None, ntp: int | None = None):
    """Return what stands for a Zenoh sample, with a number of its publisher and a time stamp of its session."""
    source = SimpleNamespace(source_id=Source(session), source_sn=number) if number is not None else None
    stamp = f"{ntp}/{session}" if ntp is not None else None
    return SimpleNamespace(key_expr=key, source_info=source, timestamp=stamp, payload=Payload(payload))


class Channel(list):
    """A channel of a fake session, which a test fills."""

    ended = False

    @property
    def handler(self) -> "Channel":
        return self

    def try_recv(self) -> Any:
        if self:
            return self.pop(0)
        if self.ended:
            raise zenoh.ZError("closed")
        return None

    def undeclare(self) -> None:
        self.ended = True


class FakeNode:
    """A node whose router, tokens and caches a test controls; `asked` holds the selectors of its open queries."""

    def __init__(self, *, is_client: bool = True) -> None:
        self.session = self.info = self
        self.routers, self.tokens, self.asked = ["router"] if is_client else [], Channel(), dict[str, Channel]()

    def routers_zid(self) -> list[str]:
        return self.routers

    def liveliness(self) -> "FakeNode":
        return self

    def declare_subscriber(self, keys: str, _: Any, **__: Any) -> Channel:
        return self.tokens if keys.startswith("fleet") else Channel()

    def get(self, selector: str, _: Any, **__: Any) -> Channel:
        return self.asked.setdefault(selector, Channel())

    def tell(self, key: str, kind: zenoh.SampleKind) -> None:
        """Let the token of a publisher come or go."""
        self.tokens.append(SimpleNamespace(key_expr=key, kind=kind))

    def answer(self, *samples: Any) -> None:
        """Answer all open queries with samples."""
        for query in self.asked.values():
            query += [SimpleNamespace(ok=each) for each in samples]
            query.ended = True
            samples = ()
        self.asked.clear()
