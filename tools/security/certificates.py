"""X.509 certificates of a fleet: a private certificate authority and what it issues.

Keys are elliptic-curve keys on P-256. Zenoh compares the common name of a certificate with the subjects of its access
control, and has no revocation lists. Every certificate therefore has a common name of its own, `{name}/{issue}`, and
the router accepts only the issues that it lists.
"""

import ipaddress
import os
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final, NamedTuple, Self

from socast.core.errors import SettingsError

try:
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
except ImportError as error:
    raise SettingsError(
        "`socast secure` needs the package cryptography; install it with: pip install 'socast[service]'"
    ) from error

AUTHORITY_DAYS: Final = 3650
"""Validity of the certificate of the authority. [d]"""
BACKDATED: Final = timedelta(hours=1)
"""Time by which a certificate is valid before it was issued, for clocks that are behind."""


class Credential(NamedTuple):
    """Hold a certificate and its private key, both as PEM.

    Parameters
    ----------
    certificate, key : str
        PEM text. The key is PKCS 8 without a passphrase.
    """

    certificate: str
    key: str


class Issued(NamedTuple):
    """Describe a certificate.

    Parameters
    ----------
    issue : int
        Number of the certificate among those of the identity, from 1.
    hosts : tuple of str
        Host names and addresses that it is valid for; only the router has any.
    """

    name: str
    issue: int
    begins: datetime
    ends: datetime
    hosts: tuple[str, ...] = ()

    @property
    def common_name(self) -> str:
        """Return the common name, which the router's access control lists."""
        return make_common_name(self.name, self.issue)

    def days_left(self, now: datetime) -> float:
        """Return the time until the certificate expires, negative once it has. [d]"""
        return (self.ends - now) / timedelta(days=1)


class Authority:
    """Issue certificates with the key of a certificate authority."""

    def __init__(self, credential: Credential) -> None:
        self.certificate = credential.certificate
        self._certificate = x509.load_pem_x509_certificate(credential.certificate.encode())
        key = serialization.load_pem_private_key(credential.key.encode(), None)
        if not isinstance(key, ec.EllipticCurvePrivateKey) or key.public_key() != self._certificate.public_key():
            raise ValueError("the key is not that of the certificate")
        self._key = key

    @classmethod
    def create(cls, now: datetime) -> tuple[Self, Credential]:
        """Return a new authority, and its certificate and key."""
        key = ec.generate_private_key(ec.SECP256R1())
        name = _make_name(f"socast authority {os.urandom(4).hex()}")
        builder = _begin(name, name, key.public_key(), now, timedelta(days=AUTHORITY_DAYS))
        certificate = (
            builder.add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(_make_key_usage(signs_certificates=True), critical=True)
            .sign(key, hashes.SHA256())
        )
        credential = _write(certificate, key)
        return cls(credential), credential

    def issue(self, name: str, issue: int, now: datetime, days: float, hosts: Sequence[str] = ()) -> Credential:
        """Return a new key with its certificate.

        A certificate with hosts is valid for a server with one of these names. One without hosts is valid for clients
        only, so that a client cannot pass for the router.

        Parameters
        ----------
        days : float
            Time for which the certificate is valid. It never outlives that of the authority. [d]
        """
        key = ec.generate_private_key(ec.SECP256R1())
        lasts = min(timedelta(days=days), self._certificate.not_valid_after_utc - now)
        usage = [ExtendedKeyUsageOID.SERVER_AUTH] if hosts else [ExtendedKeyUsageOID.CLIENT_AUTH]
        builder = (
            _begin(_make_name(make_common_name(name, issue)), self._certificate.subject, key.public_key(), now, lasts)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_make_key_usage(signs_certificates=False), critical=True)
            .add_extension(x509.ExtendedKeyUsage(usage), critical=False)
            .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(self._key.public_key()), critical=False)
        )
        if hosts:
            names = x509.SubjectAlternativeName([_make_alternative_name(host) for host in hosts])
            builder = builder.add_extension(names, critical=False)
        return _write(builder.sign(self._key, hashes.SHA256()), key)


def read_certificate(file: Path) -> Issued:
    """Return what a certificate that an `Authority` issued says."""
    try:
        certificate = x509.load_pem_x509_certificate(file.read_bytes())
        name, _, issue = str(certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value).rpartition("/")
        number = int(issue)
    except OSError as error:
        raise SettingsError(f"{file} cannot be read: {error.strerror}") from error
    except (ValueError, IndexError) as error:
        raise SettingsError(f"{file} is no certificate of `socast secure`; move it to another folder") from error
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        hosts: tuple[str, ...] = ()
    else:
        addresses = map(str, names.get_values_for_type(x509.IPAddress))
        hosts = (*names.get_values_for_type(x509.DNSName), *addresses)
    return Issued(name, number, certificate.not_valid_before_utc, certificate.not_valid_after_utc, hosts)


def make_common_name(name: str, issue: int) -> str:
    """Return the common name of a certificate.

    Examples
    --------
    >>> make_common_name("taxi-012", 2)
    'taxi-012/2'
    """
    return f"{name}/{issue}"


def now_utc() -> datetime:
    """Return the current time in UTC."""
    return datetime.now(UTC)


def _begin(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey, now: datetime, lasts: timedelta
) -> x509.CertificateBuilder:
    """Return a certificate with what all certificates have."""
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(min(now, now + lasts) - BACKDATED)
        .not_valid_after(now + lasts)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
    )


def _write(certificate: x509.Certificate, key: ec.EllipticCurvePrivateKey) -> Credential:
    """Return a certificate and its key as PEM."""
    return Credential(
        certificate.public_bytes(serialization.Encoding.PEM).decode(),
        key.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        ).decode(),
    )


def _make_name(common_name: str) -> x509.Name:
    """Return a distinguished name that has only a common name."""
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _make_alternative_name(host: str) -> x509.GeneralName:
    """Return the alternative name of a host: its address where it is one, otherwise a DNS name."""
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _make_key_usage(*, signs_certificates: bool) -> x509.KeyUsage:
    """Return the uses of the key of an authority, or of one in a TLS handshake."""
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )
