"""A secured fleet with real Zenoh sessions on loopback, for tests."""

import json
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from socast.stream.zenoh_session import Connection, Node, find_free_port
from socast.tools.security.folder import SecureFolder

CARS = ("taxi-1", "taxi-7")
EXPIRED, REVOKED = "taxi-8", "taxi-9"


def make_fleet(path: Path, *, prefix: str = "", port: int | None = None) -> SecureFolder:
    """Make a secured fleet on loopback, with a car whose certificate has expired and one that is revoked."""
    made = SecureFolder.create(
        path, ["127.0.0.1"], [*CARS, REVOKED], port=port or find_free_port(), prefix=prefix, days=30
    )
    SecureFolder(path, clock=lambda: datetime.now(UTC) - timedelta(days=31)).add([EXPIRED])
    stolen = made.locate(REVOKED).read_text()
    made.revoke([REVOKED])
    made.locate(REVOKED).write_text(stolen)
    return made


def open_router(fleet: SecureFolder) -> Node:
    """Open the router of a fleet on loopback only."""
    listen = (f"tls/127.0.0.1:{fleet.port}",)
    return Node(Connection(config=fleet.path / "router.json5", listen=listen, prefix=fleet.prefix))


def join(fleet: SecureFolder, name: str) -> Node:
    """Join the router of a fleet with the configuration of an identity."""
    return Node(Connection(config=fleet.path / f"{name}.json5", prefix=fleet.prefix))


def change_tls(file: Path, to: Path, change: Callable[[dict[str, Any]], None]) -> Path:
    """Write a copy of a configuration with another TLS setting."""
    settings = json.loads(file.read_text())
    change(settings["transport"]["link"]["tls"])
    to.write_text(json.dumps(settings))
    return to
