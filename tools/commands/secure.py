"""`socast secure`: certificates and access control, so that each node of a fleet says only what it may say."""

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.text import Text

from socast.core.errors import SettingsError, read_input
from socast.tools.security.access import CONSUMER, GATEWAY, PORT
from socast.tools.security.certificates import Issued, now_utc
from socast.tools.security.folder import RENEW_DAYS, ROUTER, SecureFolder, shorten_name
from socast.tools.terminal.output import JsonFile, check_outputs, make_console, print_plain, refuse, write_json
from socast.tools.terminal.rich_table import Column, make_table

DAYS = 365.0
"""Default validity of certificates. [d]"""

app = typer.Typer(help="Certificates and access control of a fleet.", no_args_is_help=True)

Folder = Annotated[Path, typer.Argument(metavar="DIR", help="The folder that `socast secure init` made.")]
Names = Annotated[
    list[str] | None, typer.Argument(metavar="NAME...", help="Cars, or router, consumer, dispatch or weather.")
]
Cars = Annotated[list[str] | None, typer.Option("--car", metavar="ID", help="Identifier of a car; repeatable.")]
CarFile = Annotated[
    Path | None, typer.Option("--cars", metavar="FILE", help="File with one identifier of a car a line.")
]
Gateways = Annotated[
    list[str] | None, typer.Option("--gateway", metavar="ID", help="Identifier of a gateway; repeatable.")
]
AuthorityKey = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Private key of the authority. [default: DIR/authority/authority.key]"),
]


@app.command("init")
def initialise(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A new folder.")],
    router: Annotated[
        list[str] | None,
        typer.Option(metavar="HOST", help="Name or address by which clients reach the router; repeatable."),
    ] = None,
    port: Annotated[int, typer.Option(min=1, max=65535, metavar="N", help="TCP port of the router.")] = PORT,
    car: Cars = None,
    car_file: CarFile = None,
    gateway: Gateways = None,
    prefix: Annotated[str, typer.Option(metavar="P", help="Key chunks before `fleet`, such as montreal.")] = "",
    days: Annotated[float, typer.Option(min=1.0, max=3650.0, metavar="N", help="Validity of certificates.")] = DAYS,
) -> None:
    """Make a certificate authority, and a configuration with mutual TLS for each node of a fleet.

    The router then accepts nobody without a certificate of this authority. A car publishes under its own key only, a
    gateway publishes batches, which may hold samples of any cars, the consumer alone publishes forecasts, and dispatch
    alone publishes rides and plans and asks for outlooks.

    Each configuration is one file that holds its certificate and its private key. Copy it to its machine over a safe
    channel, and keep it secret there. Without --router, the router is reached on this machine only.

    Examples
    --------
    socast secure init fleet-keys --router router.example --car taxi-001 --car taxi-002
    socast secure init fleet-keys --router router.example --router 10.0.0.5 --cars cars.txt --prefix montreal
    """
    hosts = router or ["localhost", "127.0.0.1"]
    cars, gateways = read_cars(car, car_file), gateway or []
    made = SecureFolder.create(folder, hosts, cars, gateways=gateways, port=port, prefix=prefix, days=days)
    console = make_console()
    number = len(made.list_certificates())
    option = f" --prefix {made.prefix.rstrip('/')}" if made.prefix else ""
    lines = (
        f"{folder} holds an authority, {number} certificates and a configuration for each, valid for {days:g} days.",
        f"Start the router:    zenohd --config {made.locate(ROUTER)}",
        f"and the consumer:    socast live --config {made.locate(CONSUMER)}{option}",
        f"or both in one:      socast live --config {made.locate(ROUTER)}{option}",
        f"Then move {folder / 'authority' / 'authority.key'} to a place that is offline.",
    )
    print_plain(console, "\n".join(lines))


@app.command("add")
def add_cars(
    folder: Folder,
    car: Cars = None,
    car_file: CarFile = None,
    gateway: Gateways = None,
    authority_key: AuthorityKey = None,
) -> None:
    """Make certificates and configurations of more cars and gateways; the router accepts them once it starts again.

    Examples
    --------
    socast secure add fleet-keys --car taxi-003
    socast secure add fleet-keys --gateway depot-3
    socast secure add fleet-keys --cars new.txt --authority-key /media/vault/authority.key
    """
    cars = read_cars(car, car_file)
    gateways = gateway or []
    words = "no car is given; name one with --car ID, a file of names with --cars FILE, or a gateway with --gateway ID"
    refuse((not cars and not gateways, words))
    made = SecureFolder(folder, authority_key)
    made.add(cars, gateways)
    _advise(made, "added", [*cars, *(GATEWAY + each for each in gateways)])


@app.command("list")
def list_certificates(folder: Folder, json_file: JsonFile = None) -> None:
    """List the certificates in force and when they expire.

    Examples
    --------
    socast secure list fleet-keys
    socast secure list fleet-keys --json - | jq '.certificates[] | select(.days_left < 30)'
    """
    check_outputs([], json_file)
    now = now_utc()
    found = SecureFolder(folder).list_certificates()
    records = make_records(found, now)
    write_json(json_file, "secure", {"certificates": records})
    columns = [Column("name"), Column("issue", number=True), Column("valid until"), Column("days left", number=True)]
    rows: list[Sequence[str | Text]] = []
    for record, each in zip(records, found, strict=True):
        left = record["days_left"]
        state, style = ("expired", "bold red") if left <= 0 else ("renew it", "yellow") if record["due"] else ("", "")
        rows.append((record["name"], str(each.issue), f"{each.ends:%Y-%m-%d}", f"{left:.0f}", Text(state, style)))
    console = make_console(json_file)
    console.print(make_table([*columns, Column("")], f"Certificates in {folder}", rows=rows))
    if any(record["due"] for record in records):
        print_plain(console, f"renew with: socast secure renew {folder}")


@app.command("renew")
def renew_certificates(
    folder: Folder,
    names: Names = None,
    revoke: Annotated[
        bool, typer.Option("--revoke", help="Refuse the former certificates from now on, because a key was stolen.")
    ] = False,
    authority_key: AuthorityKey = None,
) -> None:
    """Issue new keys and certificates: for names, or for all that expire within 30 days.

    The former certificate stays in force until it expires, so that the nodes change one after another. A replaced file
    goes to DIR/former.

    Examples
    --------
    socast secure renew fleet-keys
    socast secure renew fleet-keys taxi-002 --revoke
    """
    words = "--revoke needs the names whose keys were stolen: socast secure renew DIR NAME... --revoke"
    refuse((revoke and not names, words))
    made = SecureFolder(folder, authority_key)
    renewed = made.renew(names or [], revoke=revoke)
    if renewed:
        _advise(made, "renewed", renewed)
    else:
        make_console().print(f"nothing expires within {RENEW_DAYS:g} days", highlight=False)


@app.command("revoke")
def revoke_certificates(folder: Folder, names: Names = None) -> None:
    """Let the router accept nothing more from nodes, such as a car that left the fleet.

    Examples
    --------
    socast secure revoke fleet-keys taxi-002
    """
    if not names:
        raise SettingsError("no name is given; `socast secure list DIR` shows them")
    made = SecureFolder(folder)
    made.revoke(names)
    _advise(made, "revoked", names, moved=True)


def read_cars(cars: Sequence[str] | None, file: Path | None) -> list[str]:
    """Return the identifiers of cars from options and from a file.

    Parameters
    ----------
    file : Path, optional
        File with one identifier a line; blank lines and text after `#` do not count.
    """
    lines: list[str] = []
    if file is not None:
        try:
            lines = read_input(file).decode().splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise SettingsError(f"{file} cannot be read: {error}; give a text file with one car a line") from error
    return [*(cars or []), *filter(None, (line.partition("#")[0].strip() for line in lines))]


def make_records(certificates: Sequence[Issued], now: datetime) -> list[dict[str, Any]]:
    """Return certificates as records for JSON.

    Returns
    -------
    list of dict
        `due` is true for the newest certificate of a name if it is to be renewed.
    """
    newest = {each.name: each.issue for each in certificates}
    return [
        {
            "name": shorten_name(each.name),
            "issue": each.issue,
            "common_name": each.common_name,
            "valid_from": each.begins.isoformat(),
            "valid_until": each.ends.isoformat(),
            "days_left": round(each.days_left(now), 2),
            "due": each.issue == newest[each.name] and each.days_left(now) < RENEW_DAYS,
            "hosts": list(each.hosts),
        }
        for each in certificates
    ]


def _advise(folder: SecureFolder, done: str, names: Sequence[str], *, moved: bool = False) -> None:
    """Print what was done, and what is to be done next."""
    console = make_console()
    shown = ", ".join(map(shorten_name, names))
    print_plain(console, f"{done}: {shown}")
    copies = "" if moved else "copy the new configurations to their machines, and "
    print_plain(
        console,
        f"Now {copies}start the router again with the changed {folder.locate(ROUTER)}.",
    )
