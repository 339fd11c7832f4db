"""What each identity of a fleet may say and read, and the access control of the router that enforces it.

Notes
-----
The module allows for this observed behaviour of zenoh 1.10:

- A rule permits a message only if one of its key expressions includes that of the message. `**` includes no chunk that
  begins with `@`. Advanced publishers and subscribers use keys under `{key}/@adv`, which need rules of their own.
- The router filters what it receives (ingress) and what it sends (egress). It does so for every transport, and not for
  the session of its own process.
- A declaration that reaches another node shows the key of its sender. The key of a publisher's cache contains the
  sender's Zenoh identifier. The router therefore shows caches only to those who may read them.
"""

from base64 import b64encode
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from socast.stream.zenoh_session import limit_sizes
from socast.tools.security.certificates import Credential

CONSUMER: Final = "socast consumer"
"""Name of the identity that forecasts; the blank keeps it apart from any car."""
DISPATCH: Final = "socast dispatch"
"""Name of the identity that plans."""
WEATHER: Final = "socast weather"
"""Name of the identity that observes the weather."""
GATEWAY: Final = "gateway "
"""Begin of the name of a gateway's identity; the blank keeps it apart from any car."""
PORT: Final = 7447
"""Default port of a Zenoh router."""
LARGEST_BYTES: Final = 8_000_000
"""Size of a payload above which the router drops it. [B]"""


@dataclass(frozen=True)
class Access:
    """State what an identity may say and read, as key expressions without the prefix of the fleet.

    Parameters
    ----------
    puts : tuple of str
        Keys that it publishes, with the cache and the token of an advanced publisher.
    reads : tuple of str
        Keys that it subscribes to, with the history and the recovery of an advanced subscriber.
    claims : tuple of str
        Keys of liveliness tokens that it holds, and watches.
    """

    puts: tuple[str, ...] = ()
    reads: tuple[str, ...] = ()
    answers: tuple[str, ...] = ()
    asks: tuple[str, ...] = ()
    claims: tuple[str, ...] = ()


SERVICES: Final[Mapping[str, Access]] = {
    CONSUMER: Access(
        puts=("fleet/*/forecast", "models/**", "findings/**", "socast/**"),
        reads=("fleet/**", "weather/**", "socast/**"),
        answers=("fleet/*/outlook",),
        claims=("socast/**",),
    ),
    DISPATCH: Access(
        puts=("fleet/*/ride", "fleet/*/plan"),
        reads=("fleet/*/forecast", "models/**", "findings/**"),
        asks=("fleet/*/outlook",),
    ),
    WEATHER: Access(puts=("weather/*",)),
}
"""Name -> access of every identity that is not a car.

Several consumers agree under `socast/**` which one of them publishes.
"""


def make_car_access(car: str) -> Access:
    """Return what a car may say and read: its own telemetry, and what others say of it."""
    return Access(
        puts=(f"fleet/{car}/telemetry", f"fleet/{car}/vehicle"),
        reads=(f"fleet/{car}/forecast", f"fleet/{car}/plan", f"fleet/{car}/ride"),
    )


def make_gateway_access(gateway: str) -> Access:
    """Return what a gateway may say: batches under its own name, which may hold samples of any cars."""
    return Access(puts=(f"fleet/{gateway}/batch",))


def make_access_control(identities: Iterable[tuple[str, Sequence[str]]], prefix: str = "") -> dict[str, Any]:
    """Return the setting `access_control` of the router, which denies whatever no rule allows.

    Parameters
    ----------
    identities : iterable of tuple of (str, sequence of str)
        Name of each identity, and the common names of its certificates. Any other name than those of `SERVICES` is a
        gateway, if it begins with `GATEWAY`, or else a car.
    """
    rules: list[dict[str, Any]] = []
    subjects: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []
    for name, common_names in identities:
        is_gateway = name.startswith(GATEWAY)
        access = make_gateway_access(name.removeprefix(GATEWAY)) if is_gateway else make_car_access(name)
        access = SERVICES.get(name, access)
        made = list(_make_rules(name, access, prefix))
        rules += made
        subjects.append({"id": name, "cert_common_names": list(common_names)})
        policies.append({"rules": [rule["id"] for rule in made], "subjects": [name]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def _make_rules(name: str, access: Access, prefix: str) -> Iterable[dict[str, Any]]:
    """Yield the rules of an identity: what the router takes from it, and what the router sends to it."""
    puts, reads, answers, asks, claims = (
        [prefix + key for key in keys]
        for keys in (access.puts, access.reads, access.answers, access.asks, access.claims)
    )
    puts_advanced, reads_advanced = ([f"{key}/@adv/**" for key in keys] for keys in (puts, reads))
    subscriptions = ["**", "**/@adv/**"] if puts else []
    keys_of = {
        "ingress": {
            "put": puts + puts_advanced,
            "liveliness_token": puts_advanced + claims,
            "declare_queryable": puts_advanced + answers,
            "reply": puts + puts_advanced + answers,
            "declare_subscriber": reads + reads_advanced,
            "declare_liveliness_subscriber": reads_advanced + claims,
            "liveliness_query": reads_advanced + claims,
            "query": reads_advanced + asks,
        },
        "egress": {
            "put": reads + reads_advanced,
            "liveliness_token": reads_advanced + claims,
            "declare_queryable": reads_advanced + asks,
            "reply": reads + reads_advanced + asks,
            "declare_subscriber": subscriptions,
            "declare_liveliness_subscriber": subscriptions,
            "liveliness_query": subscriptions,
            "query": [f"{prefix}**/@adv/**"] * bool(puts) + answers,
        },
    }
    for flow, keys_of_message in keys_of.items():
        messages_of: dict[tuple[str, ...], list[str]] = {}
        for message, keys in keys_of_message.items():
            messages_of.setdefault(tuple(keys), []).append(message)
        for of_messages, messages in messages_of.items():
            if of_messages:
                yield {
                    "id": f"{name}: {flow} {', '.join(messages)}",
                    "messages": messages,
                    "flows": [flow],
                    "permission": "allow",
                    "key_exprs": list(of_messages),
                }


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
