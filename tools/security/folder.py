"""The folder of a secured fleet: its authority, the certificates in force, and a configuration for each identity.

A certificate in `certificates/` is in force: the access control of `router.json5` lists it. Files that another replaces
go to `former/`, so nothing is ever overwritten.
"""

import json
import os
import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Any, Final

from socast.core.errors import SettingsError, suggest_names
from socast.core.files import replacing
from socast.stream.zenoh_session import parse_prefix
from socast.tools.security.access import (
    CONSUMER,
    DISPATCH,
    GATEWAY,
    SERVICES,
    WEATHER,
    make_access_control,
    make_client_settings,
    make_router_settings,
    make_tls,
)
from socast.tools.security.certificates import Authority, Credential, Issued, now_utc, read_certificate

ROUTER: Final = "socast router"
"""Name of the identity of the router."""
SHORT_NAMES: Final = {"router": ROUTER, "consumer": CONSUMER, "dispatch": DISPATCH, "weather": WEATHER}
"""Name on the command line and of files -> name in certificates, for what is not a car."""
LONGEST_CAR: Final = 58
"""Longest name of a car, so that name and issue fit into a common name. [characters]"""
RENEW_DAYS: Final = 30.0
"""Time before its expiry at which a certificate is due for renewal. [d]"""
_SETTINGS: Final = "fleet.json"
_ACCESS: Final = "access_control"
_CAR: Final = re.compile(rf"[A-Za-z0-9_.-]{{1,{LONGEST_CAR}}}")
_HOST: Final = re.compile(r"[A-Za-z0-9.:-]+")


class SecureFolder:
    """Make and change the files of a secured fleet.

    Parameters
    ----------
    authority_key : Path, optional
        Private key of the authority, where it is not in the folder.
    """

    def __init__(self, path: Path, authority_key: Path | None = None, clock: Callable[[], datetime] = now_utc) -> None:
        self.path = path
        self._clock = clock
        self._key = authority_key or path / "authority" / "authority.key"
        settings = _read_json(
            path / _SETTINGS, f"{path} is no folder of a secured fleet; make one with: socast secure init {path}"
        )
        self.hosts: list[str] = settings["hosts"]
        self.port: int = settings["port"]
        self.prefix: str = settings["prefix"]
        self.days: float = settings["days"]

    @classmethod
    def create(
        cls,
        path: Path,
        hosts: Sequence[str],
        cars: Sequence[str],
        *,
        port: int,
        prefix: str = "",
        days: float,
        gateways: Sequence[str] = (),
        clock: Callable[[], datetime] = now_utc,
    ) -> "SecureFolder":
        """Make a folder with a new authority, and the certificates and configurations of all identities.

        Units: days [d].
        """
        for host in hosts:
            if not _HOST.fullmatch(host):
                raise SettingsError(f"--router is {host!r}; give a host name or an address without scheme and port")
        names = _check_names(cars, gateways)
        prefix = parse_prefix(prefix)
        try:
            path.mkdir(mode=0o700, parents=True, exist_ok=True)
            path.chmod(0o700)
            if any(path.iterdir()):
                raise SettingsError(f"{path} is not empty, and nothing in it is overwritten; name a new folder")
        except OSError as error:
            raise SettingsError(f"{path} cannot be made: {error.strerror}; name another folder") from error
        _, credential = Authority.create(clock())
        _write_new(path / "authority" / "authority.key", credential.key)
        _write_new(path / "authority" / "authority.crt", credential.certificate)
        settings = {"hosts": list(hosts), "port": port, "prefix": prefix, "days": days}
        _write_new(path / _SETTINGS, _format(settings))
        folder = cls(path, clock=clock)
        authority = folder._open_authority()
        for name in (CONSUMER, DISPATCH, WEATHER, *names):
            folder._issue_client(authority, name)
        router = folder._issue(authority, ROUTER)
        access = folder._make_access_control()
        made = make_router_settings(router, authority.certificate, port, access)
        _write_new(folder.locate(ROUTER), _format(made))
        return folder

    def list_certificates(self) -> list[Issued]:
        """Return the certificates in force: those of the services, then those of the cars, by name and issue."""
        order = {name: number for number, name in enumerate((ROUTER, *SERVICES))}
        found = [read_certificate(file) for file in (self.path / "certificates").glob("**/*.crt")]
        return sorted(found, key=lambda each: (order.get(each.name, len(order)), each.name, each.issue))

    def locate(self, name: str) -> Path:
        """Return the configuration of an identity."""
        return self.path / f"{_find_stem(name)}.json5"

    def add(self, cars: Sequence[str], gateways: Sequence[str] = ()) -> None:
        """Make certificates and configurations of more cars and gateways, and let the router accept them."""
        names = _check_names(cars, gateways)
        known = {each.name for each in self.list_certificates()}
        if taken := [name for name in names if name in known]:
            raise SettingsError(
                f"{taken[0]} has a certificate; give it another with: socast secure renew {self.path} {taken[0]}"
            )
        authority = self._open_authority()
        router = self._read_router()
        for name in names:
            self._issue_client(authority, name)
        self._replace(ROUTER, router | {_ACCESS: self._make_access_control()})

    def renew(self, names: Sequence[str] = (), *, revoke: bool = False) -> list[str]:
        """Issue further certificates with new keys; those that they replace stay in force until they expire.

        Parameters
        ----------
        names : sequence of str
            Names as on the command line. Without any, those whose newest certificate expires within `RENEW_DAYS`.
        """
        newest = {each.name: each for each in self.list_certificates()}
        chosen = [self._find_name(name, newest) for name in names] or [
            name for name, each in newest.items() if each.days_left(self._clock()) < RENEW_DAYS
        ]
        if not chosen:
            return []
        if revoke and ROUTER in chosen:
            raise SettingsError(
                "the router's certificate cannot be revoked, because clients have no list of those in force; "
                "make a new authority with: socast secure init"
            )
        authority = self._open_authority()
        router = self._read_router()
        for name in chosen:
            issued = self._issue(authority, name)
            if name == ROUTER:
                router["transport"]["link"]["tls"] = make_tls("listen", issued, authority.certificate)
                continue
            settings = _read_json(self.locate(name), "")
            settings["transport"]["link"]["tls"] = make_tls("connect", issued, authority.certificate)
            self._replace(name, settings)
        self._retire(lambda each: each.days_left(self._clock()) <= 0.0)
        if revoke:
            self._retire(lambda each: each.name in chosen and each.issue <= newest[each.name].issue)
        self._replace(ROUTER, router | {_ACCESS: self._make_access_control()})
        return chosen

    def revoke(self, names: Sequence[str]) -> None:
        """Let the router accept nothing more from identities."""
        known = {each.name: each for each in self.list_certificates()}
        chosen = [self._find_name(name, known) for name in names]
        if ROUTER in chosen:
            raise SettingsError("the router cannot be revoked; stop it, and make a new authority: socast secure init")
        router = self._read_router()
        self._retire(lambda each: each.name in chosen)
        for name in chosen:
            self._move(self.locate(name))
        self._replace(ROUTER, router | {_ACCESS: self._make_access_control()})

    def _find_name(self, name: str, known: dict[str, Issued]) -> str:
        """Return the name in certificates of a name on the command line."""
        full = SHORT_NAMES.get(name, name)
        if full not in known:
            remedy = suggest_names(name, map(shorten_name, known))
            raise SettingsError(f"{name!r} has no certificate in {self.path}; {remedy}")
        return full

    def _open_authority(self) -> Authority:
        """Return the authority, whose key may be kept elsewhere."""
        certificate = self.path / "authority" / "authority.crt"
        try:
            return Authority(Credential(certificate.read_text(), self._key.read_text()))
        except OSError as error:
            raise SettingsError(
                f"the key of the authority cannot be read at {self._key}: {error.strerror}; "
                "name the file where you keep it with --authority-key"
            ) from error
        except (ValueError, TypeError) as error:
            raise SettingsError(
                f"{self._key} is not the key of {certificate}; name the right file with --authority-key"
            ) from error

    def _issue(self, authority: Authority, name: str) -> Credential:
        """Return the next certificate of an identity and keep its public part."""
        stem = _find_stem(name)
        folders = ("certificates", "former")
        taken = [int(file.stem.rpartition(".")[2]) for each in folders for file in self._list_issues(each, stem)]
        number = max(taken, default=0) + 1
        hosts = self.hosts if name == ROUTER else ()
        credential = authority.issue(name, number, self._clock(), self.days, hosts)
        _write_new(self.path / "certificates" / f"{stem}.{number}.crt", credential.certificate, 0o644)
        return credential

    def _list_issues(self, folder: str, stem: str) -> list[Path]:
        """Return the certificates of an identity in a folder."""
        file = self.path / folder / stem
        return [each for each in file.parent.glob("*.crt") if re.fullmatch(rf"{re.escape(file.name)}\.\d+", each.stem)]

    def _issue_client(self, authority: Authority, name: str) -> None:
        """Make the certificate and the configuration of a client of the router."""
        made = make_client_settings(self._issue(authority, name), authority.certificate, self.hosts, self.port)
        _write_new(self.locate(name), _format(made))

    def _make_access_control(self) -> dict[str, Any]:
        """Return the access control for the certificates in force."""
        identities: dict[str, list[str]] = {}
        for each in self.list_certificates():
            if each.name != ROUTER:
                identities.setdefault(each.name, []).append(each.common_name)
        return make_access_control(identities.items(), self.prefix)

    def _read_router(self) -> dict[str, Any]:
        """Return the configuration of the router."""
        return _read_json(self.locate(ROUTER), "")

    def _replace(self, name: str, settings: dict[str, Any]) -> None:
        """Replace the configuration of an identity atomically, and keep the former one."""
        file = self.locate(name)
        fresh = file.with_name(f".{file.name}.new")
        fresh.unlink(missing_ok=True)
        _write_new(fresh, _format(settings))
        former = self._name_former(file)
        os.link(file, former)
        fresh.replace(file)

    def _retire(self, condition: Callable[[Issued], bool]) -> None:
        """Take certificates out of force."""
        for each in self.list_certificates():
            if condition(each):
                stem = f"{_find_stem(each.name)}.{each.issue}.crt"
                former = self.path / "former" / stem
                former.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
                (self.path / "certificates" / stem).rename(former)

    def _move(self, file: Path) -> None:
        """Move a configuration to the former ones."""
        with suppress(FileNotFoundError):
            file.rename(self._name_former(file))

    def _name_former(self, file: Path) -> Path:
        """Return a new name for a configuration among the former ones."""
        at = self.path / "former" / file.relative_to(self.path)
        at.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        stamp = f"{self._clock():%Y%m%dT%H%M%SZ}"
        numbered = (at.with_name(f"{at.stem}.{stamp}-{number}.json5") for number in range(1, 10_000))
        return next(each for each in numbered if not each.exists())


def shorten_name(name: str) -> str:
    """Return the name on the command line of an identity.

    Examples
    --------
    >>> shorten_name("socast router"), shorten_name("taxi-012")
    ('router', 'taxi-012')
    """
    return next((short for short, full in SHORT_NAMES.items() if full == name), name)


def _check_names(cars: Sequence[str], gateways: Sequence[str]) -> list[str]:
    """Return the names of cars and gateways, each once; raise `SettingsError` if one is invalid."""
    longest = LONGEST_CAR - len(GATEWAY)
    for option, most, names in (("--car", LONGEST_CAR, cars), ("--gateway", longest, gateways)):
        for name in names:
            if not _CAR.fullmatch(name) or len(name) > most or name in SHORT_NAMES or name in {".", ".."}:
                raise SettingsError(
                    f"{option} is {name!r}; give 1 to {most} letters, digits, `_`, `.` and `-`, and none of "
                    f"{', '.join(SHORT_NAMES)}"
                )
    return list(dict.fromkeys([*cars, *(GATEWAY + gateway for gateway in gateways)]))


def _find_stem(name: str) -> str:
    """Return the path of the files of an identity in the folder, without its ending."""
    if name.startswith(GATEWAY):
        return f"gateways/{name.removeprefix(GATEWAY)}"
    short = shorten_name(name)
    return short if short != name else f"cars/{name}"


def _format(settings: dict[str, Any]) -> str:
    """Return a configuration as JSON, with a line for each rule of access."""
    text = json.dumps({name: value for name, value in settings.items() if name != _ACCESS}, indent=2)
    if _ACCESS not in settings:
        return f"{text}\n"
    parts = ",\n".join(f"    {json.dumps(name)}: {_format_part(part)}" for name, part in settings[_ACCESS].items())
    return f'{text[:-2]},\n  "{_ACCESS}": {{\n{parts}\n  }}\n}}\n'


def _format_part(part: Any) -> str:
    """Return a part of the rules of access as JSON, with a line for each entry of a list."""
    if not isinstance(part, list):
        return json.dumps(part)
    entries = ",\n".join(f"      {json.dumps(entry)}" for entry in part)
    return f"[\n{entries}\n    ]"


def _read_json(file: Path, missing: str) -> dict[str, Any]:
    """Return the content of a JSON file."""
    try:
        content = json.loads(file.read_bytes())
    except FileNotFoundError as error:
        raise SettingsError(missing or f"{file} is missing; bring it back") from error
    except OSError as error:
        raise SettingsError(f"{file} cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise SettingsError(f"{file} is not plain JSON ({error}); take comments out of it") from error
    if not isinstance(content, dict):
        raise SettingsError(f"{file} is not a JSON object; bring back the file that `socast secure` wrote")
    return content


def _write_new(file: Path, text: str, mode: int = 0o600) -> None:
    """Write a file that does not exist, for its owner only by default."""
    if file.exists():
        raise SettingsError(f"{file} is there already and is not overwritten; move it away")
    try:
        file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with replacing(file) as fresh:
            descriptor = os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
            with os.fdopen(descriptor, "w", encoding="utf-8") as out:
                out.write(text)
    except OSError as error:
        raise SettingsError(f"{file} cannot be written: {error.strerror}; choose another folder") from error
