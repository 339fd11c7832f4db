"""The monitor of the live service: the web server and systemd, begun before the state is loaded and ended last."""

from collections.abc import Callable
from contextlib import ExitStack
from threading import Event

from socast.stream.closeable import Closeable
from socast.stream.health import HealthServer, parse_http_address
from socast.stream.loop import Tally
from socast.stream.metrics import make_registry
from socast.stream.service_snapshot import SnapshotTaker
from socast.stream.service_status import ServiceStatus, ServiceWatch
from socast.stream.systemd_notify import SystemdNotifier


class ServiceMonitor(Closeable):
    """Serve the metrics of the service, and tell systemd of it.

    Parameters
    ----------
    address : str, optional
        Where to serve metrics, as `socast.stream.health.parse_http_address` reads it; None serves none.
    shard : str
        Shard of the service, such as `2/4`; empty without shards.
    """

    def __init__(self, address: str | None = None, shard: str = "") -> None:
        self._status, self._notifier = ServiceStatus(), SystemdNotifier.from_environment()
        self._watch: ServiceWatch | None = None
        self.server: HealthServer | None = None
        with ExitStack() as closing:
            closing.callback(self._notifier.close)
            if address is not None:
                status = self._status
                registry = make_registry(
                    lambda: status.snapshot, lambda: not status.find_obstacle(), status.get_loop_age, shard=shard
                )
                self.server = closing.enter_context(HealthServer(parse_http_address(address), status, registry))
            self._closing = closing.pop_all()

    def begin(self, step: str) -> None:
        """Tell what the service does on its way to readiness, such as `loading the state`."""
        self._status.step = step
        self._notifier.set_status(f"starting: {step}")

    def make_watches(self, take_snapshot: SnapshotTaker, stop: Event) -> list[Callable[[Tally], None]]:
        """Return the watch of the loop, or none where nobody is told."""
        if self.server is None and not self._notifier.is_connected:
            return []
        self._watch = ServiceWatch(self._status, take_snapshot, self._notifier, stop)
        return [self._watch]

    def announce_stop(self) -> None:
        """Tell that the loop has ended."""
        if self._watch is not None:
            self._watch.end()

    def close(self) -> None:
        """Stop the server and leave systemd."""
        self._closing.close()
