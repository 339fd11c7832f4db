"""A plain Zenoh subscriber for signals of other ecosystems, which are no messages of the wire contract."""

import time
from typing import Any, NamedTuple

import zenoh
from zenoh import handlers

from socast.core.errors import SettingsError
from socast.stream.closeable import Closeable
from socast.stream.zenoh_session import Node, format_zenoh_error

CHANNEL = 1 << 14
"""Capacity of the channel, in samples; a full channel blocks publishers."""
MOST_TAKEN = 1 << 12
"""Largest number of samples that are taken at once."""


class SignalSample(NamedTuple):
    """Hold a sample of a signal.

    Parameters
    ----------
    stamp_s : float or None
        Time that the sample's publisher or router gave it. [Unix s]
    received_s : float
        Time of receipt. [Unix s]
    """

    key: str
    payload: bytes
    attachment: bytes
    stamp_s: float | None
    received_s: float


class ZenohSignals(Closeable):
    """Subscribe to keys.

    Parameters
    ----------
    node : Node
        Session, which stays open. Publish through another session: see `socast.stream.zenoh_sink`.
    """

    def __init__(self, node: Node, keys: str) -> None:
        channel: Any = handlers.FifoChannel(CHANNEL)
        try:
            self._subscriber: Any = node.session.declare_subscriber(keys, channel)
        except zenoh.ZError as error:
            raise SettingsError(f"cannot subscribe to {keys}: {format_zenoh_error(error)}") from error

    def take(self, wait_s: float) -> list[SignalSample]:
        """Return the samples that have come, after a wait for the first one."""
        deadline = time.monotonic() + wait_s
        receive = self._subscriber.handler.try_recv
        while (sample := receive()) is None:
            if time.monotonic() >= deadline:
                return []
            time.sleep(0.005)
        taken = [_read(sample)]
        while len(taken) < MOST_TAKEN and (sample := receive()) is not None:
            taken.append(_read(sample))
        return taken

    def close(self) -> None:
        """Receive nothing more."""
        self._subscriber.undeclare()


def _read(sample: Any) -> SignalSample:
    """Return the parts of a sample."""
    attachment = sample.attachment.to_bytes() if sample.attachment is not None else b""
    stamp_s = sample.timestamp.get_time().timestamp() if sample.timestamp is not None else None
    return SignalSample(str(sample.key_expr), sample.payload.to_bytes(), attachment, stamp_s, time.time())
