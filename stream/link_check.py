"""Find out why a router cannot be joined, because Zenoh says only that no endpoint could be connected.

The check opens a connection of its own to the endpoint, with the certificates of the configuration, and sends nothing
over it.
"""

import os
import re
import socket
import ssl
from base64 import b64decode
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

CHECK_S: Final = 3.0
"""Longest wait for an answer of the router. [s]"""
ALERT_S: Final = 1.0
"""Time within which a router refuses a certificate after the handshake; TLS 1.3 does so then. [s]"""
_RENEW: Final = "make another one with `socast secure renew`, and give it with --config"


def explain_failure(endpoint: str, tls: Mapping[str, Any]) -> str:
    """Return why no connection to an endpoint can be made, with the remedy; an empty text if nothing is found."""
    protocol, _, address = endpoint.partition("/")
    host, _, port = re.split(r"[?#]", address)[0].rpartition(":")
    if protocol not in {"tcp", "tls"} or not port.isdecimal():
        return ""
    where = (host.strip("[]"), int(port))
    try:
        with socket.create_connection(where, CHECK_S) as link:
            return _check_tls(link, endpoint, where[0], tls) if protocol == "tls" else _explain_silence(endpoint)
    except OSError as error:
        return f"{endpoint}: {error.strerror or error}; is a router running there, and does a firewall let it through?"


def _explain_silence(endpoint: str) -> str:
    """Return what may be wrong with a TCP endpoint that accepts connections."""
    secure = endpoint.replace("tcp/", "tls/", 1)
    return (
        f"{endpoint} accepts connections and does not speak Zenoh over plain TCP; "
        f"for a router with TLS give {secure} and --config"
    )


def _check_tls(link: socket.socket, endpoint: str, host: str, tls: Mapping[str, Any]) -> str:
    """Return why the handshake with a TLS endpoint fails; an empty text if it succeeds."""
    try:
        context = _make_context(tls)
    except (OSError, ValueError) as error:
        return f"the certificate or the key of --config cannot be used: {_name_reason(error)}; {_RENEW}"
    words = ""
    try:
        with context.wrap_socket(link, server_hostname=host) as channel:
            channel.settimeout(ALERT_S)
            channel.recv(1)
    except TimeoutError:
        pass  # the router waits for a message
    except ssl.SSLCertVerificationError as error:
        words = (
            f"the certificate of the router at {endpoint} is not valid for this node: {error.verify_message}; "
            "use files of the same `socast secure init` on both sides, and a host name that it was given"
        )
    except ssl.SSLError as error:
        reason = _name_reason(error)
        words = f"the router at {endpoint} refuses the certificate of this node: {reason}; {_RENEW}"
        if "alert" not in reason:
            words = f"{endpoint} does not speak TLS: {reason}; for a router without TLS give {_to_plain(endpoint)}"
    except OSError as error:
        words = f"{endpoint} closes the connection: {error.strerror or error}; read the log of the router"
    return words


def _make_context(tls: Mapping[str, Any]) -> ssl.SSLContext:
    """Return a context with the authority and the certificate of a configuration."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = tls.get("verify_name_on_connect") is not False
    if authority := _read_pem(tls, "root_ca_certificate"):
        context.load_verify_locations(cadata=authority.decode())
    else:
        context.load_default_certs()
    certificate, key = _read_pem(tls, "connect_certificate"), _read_pem(tls, "connect_private_key")
    if certificate and key:
        with _hold_in_memory(certificate + b"\n" + key) as path:
            context.load_cert_chain(path)
    return context


def _read_pem(tls: Mapping[str, Any], name: str) -> bytes:
    """Return a certificate or a key that a configuration holds or names; empty without it."""
    if text := tls.get(f"{name}_base64"):
        return b64decode(text)
    path = tls.get(name)
    return Path(path).read_bytes() if path else b""


@contextmanager
def _hold_in_memory(content: bytes) -> Iterator[str]:
    """Give the path of a file that exists in memory only, so that no key is written to a disk."""
    number = os.memfd_create("certificate", os.MFD_CLOEXEC)
    try:
        os.write(number, content)
        yield f"/proc/self/fd/{number}"
    finally:
        os.close(number)


def _to_plain(endpoint: str) -> str:
    """Return an endpoint without TLS."""
    return endpoint.replace("tls/", "tcp/", 1)


def _name_reason(error: Exception) -> str:
    """Return the reason of an error of OpenSSL, such as `alert certificate expired`."""
    reason = getattr(error, "reason", None) or getattr(error, "strerror", None) or str(error)
    return re.sub(r"^(sslv3|tlsv1|tlsv13) ", "", str(reason).replace("_", " ").lower())
