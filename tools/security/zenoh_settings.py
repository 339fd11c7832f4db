"""Complete configurations of Zenoh nodes with mutual TLS, each in one file that holds its own certificate and key."""

from base64 import b64encode
from collections.abc import Sequence
from typing import Any, Final

from socast.stream.zenoh_session import limit_sizes
from socast.tools.security.certificates import Credential

PORT: Final = 7447
"""Default port of a Zenoh router."""
LARGEST_BYTES: Final = 8_000_000
"""Size of a payload above which the router drops it. [B]"""


def make_router_settings(
    credential: Credential, authority: str, port: int, access_control: dict[str, Any]
) -> dict[str, Any]:
    """Return the configuration of the router, for `zenohd` or for `socast live` with its embedded router."""
    settings = _make_settings("router", make_tls("listen", credential, authority))
    settings["listen"] = {"endpoints": [f"tls/0.0.0.0:{port}"]}
    settings["timestamping"] = {"enabled": False}
    settings["adminspace"] = {"enabled": False}
    settings["low_pass_filter"] = [limit_sizes(LARGEST_BYTES)]
    return settings | {"access_control": access_control}


def make_client_settings(credential: Credential, authority: str, hosts: Sequence[str], port: int) -> dict[str, Any]:
    """Return the configuration of a client of the router."""
    settings = _make_settings("client", make_tls("connect", credential, authority))
    ends = [f"tls/[{host}]:{port}" if ":" in host else f"tls/{host}:{port}" for host in hosts]
    return settings | {"connect": {"endpoints": ends}}


def make_tls(side: str, credential: Credential, authority: str) -> dict[str, Any]:
    """Return the setting `transport/link/tls`."""
    return {
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
        "root_ca_certificate_base64": _encode(authority),
        f"{side}_certificate_base64": _encode(credential.certificate),
        f"{side}_private_key_base64": _encode(credential.key),
    }


def _make_settings(mode: str, tls: dict[str, Any]) -> dict[str, Any]:
    """Return what all nodes have in common: only TLS, and no discovery."""
    return {
        "mode": mode,
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {"link": {"protocols": ["tls"], "tls": tls}},
    }


def _encode(text: str) -> str:
    """Return text in base64."""
    return b64encode(text.encode()).decode()
