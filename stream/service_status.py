"""The status of the live service, which its loop writes, and which the web server and systemd are told.

Each attribute is replaced as a whole by the thread of the loop. Other threads only read it, so no lock is needed.
"""

import time
from collections.abc import Callable
from threading import Event
from typing import Final, Literal

from socast.core.formatting import format_count
from socast.stream.loop import Tally
from socast.stream.service_snapshot import LagMeter, ServiceSnapshot
from socast.stream.systemd_notify import SystemdNotifier

LIVE_S: Final = 30.0
"""Time without a turn of the loop after which the service counts as hung. [s]"""
SNAPSHOT_S: Final = 1.0
"""Shortest time between two snapshots. [s]"""
SNAPSHOT_SHARE: Final = 0.02
"""Largest share of the loop's time that snapshots take; those of a large fleet are further apart."""
STATUS_S: Final = 10.0
"""Time between two status lines to systemd. [s]"""


class ServiceStatus:
    """Hold whether the service is live and ready, and its newest snapshot.

    Parameters
    ----------
    limit_s : float
        Time without a turn of the loop after which the service is not live. [s]
    clock : callable
        Function that returns monotonic time. [s]

    Attributes
    ----------
    phase : str
        `starting` until the service has subscribed, loaded its state and caught up; then `ready`; then `stopping`.
    step : str
        What a service that starts is doing.
    snapshot : ServiceSnapshot or None
        Newest snapshot; None before the first turn of the loop.
    """

    def __init__(self, limit_s: float = LIVE_S, clock: Callable[[], float] = time.monotonic) -> None:
        self.phase: Literal["starting", "ready", "stopping"] = "starting"
        self.step = ""
        self.snapshot: ServiceSnapshot | None = None
        self._limit_s, self._clock = limit_s, clock
        self._moved_s = clock()

    def note_turn(self, now: float) -> None:
        """Note that the loop has made a turn, at a monotonic time. [s]"""
        self._moved_s = now

    def get_loop_age(self) -> float:
        """Return the time since the loop has made a turn, or since the start before the first turn. [s]"""
        return max(0.0, self._clock() - self._moved_s)

    def find_hang(self) -> str:
        """Return why the service is not live; an empty text where it is. A service that starts or stops is live."""
        age = self.get_loop_age()
        if self.phase != "ready" or age <= self._limit_s:
            return ""
        return f"the loop has not moved for {age:.0f} s, limit {self._limit_s:g} s"

    def find_obstacle(self) -> str:
        """Return why the service is not ready; an empty text where it is."""
        if self.phase == "ready":
            return self.find_hang() or (self.snapshot.obstacle if self.snapshot else "")
        return f"starting: {self.step}" if self.phase == "starting" and self.step else self.phase


class ServiceWatch:
    """Keep the status up to date and tell systemd, as a watch of the loop.

    The loop begins after the state has been loaded, the recording has been read, and the subscription has been made.
    The service is ready at the first snapshot after the caches of publishers have been asked.

    Parameters
    ----------
    stop : Event, optional
        Event that requests the stop of the service.
    clock : callable
        Function that returns monotonic time. [s]
    """

    def __init__(
        self,
        status: ServiceStatus,
        take_snapshot: Callable[[Tally, LagMeter], ServiceSnapshot],
        notifier: SystemdNotifier | None = None,
        stop: Event | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._status, self._take_snapshot = status, take_snapshot
        self._notifier, self._stop, self._clock = notifier or SystemdNotifier(), stop or Event(), clock
        self._lag = LagMeter()
        self._snapshot_due_s = self._status_due_s = clock()

    def __call__(self, tally: Tally) -> None:
        """Note the turn of the loop, and renew the snapshot and the status line when they are due."""
        now = self._clock()
        self._status.note_turn(now)
        self._notifier.feed_watchdog(now)
        if tally.newest is not None:
            self._lag.observe(tally.newest)
            tally.newest = None
        if self._stop.is_set():
            self.end()
        if now >= self._snapshot_due_s:
            self._status.snapshot = snapshot = self._take_snapshot(tally, self._lag)
            self._snapshot_due_s = now + max(SNAPSHOT_S, (self._clock() - now) / SNAPSHOT_SHARE)
            if self._status.phase == "starting" and snapshot.is_catching_up:
                self._status.step = "asking the caches of publishers"
            elif self._status.phase == "starting":
                self._status.phase = "ready"
                self._notifier.announce_ready()
            if now >= self._status_due_s:
                self._status_due_s = now + STATUS_S
                self._notifier.set_status(describe_snapshot(snapshot))

    def end(self) -> None:
        """Tell that the service stops; a second call has no effect."""
        if self._status.phase != "stopping":
            self._status.phase = "stopping"
            self._notifier.announce_stop()


def describe_snapshot(snapshot: ServiceSnapshot) -> str:
    """Return a line on a snapshot, for `systemctl status`.

    Examples
    --------
    >>> describe_snapshot(ServiceSnapshot(messages=12_000, forecasts=340, vehicles=20, active_vehicles=18, rides=7))
    '12,000 messages, 340 forecasts, 18 of 20 vehicles active, 7 rides'
    """
    role = describe_role(snapshot)
    return (
        f"{format_count(snapshot.messages, 'message')}, {format_count(snapshot.forecasts, 'forecast')}, "
        f"{snapshot.active_vehicles:,} of {format_count(snapshot.vehicles, 'vehicle')} active, "
        f"{format_count(snapshot.rides, 'ride')}"
        f"{role and f', {role}'}"
    )


def describe_role(snapshot: ServiceSnapshot) -> str:
    """Return whether a service publishes, where one of several does, and its shard; an empty text where it is alone.

    Examples
    --------
    >>> describe_role(ServiceSnapshot(publishes=False)), describe_role(ServiceSnapshot())
    ('on standby', '')
    >>> describe_role(ServiceSnapshot(shard="2/4", overlapping=("shard 3/3",)))
    'shard 2/4, overlaps with shard 3/3'
    """
    words = [{None: "", True: "publishes", False: "on standby"}[snapshot.publishes]]
    words.append(f"shard {snapshot.shard}" if snapshot.shard else "")
    if snapshot.overlapping:
        words.append(f"overlaps with {' and '.join(snapshot.overlapping)}")
    return ", ".join(filter(None, words))
