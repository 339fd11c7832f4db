"""`socast bridge`: pass telemetry of other ecosystems on as messages of the wire contract."""

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

import typer

from socast.core.errors import SettingsError, read_input, suggest_names
from socast.core.vehicles import load_catalogue
from socast.stream.loop import REPORT_S
from socast.stream.mqtt_source import Broker, MqttSource, check_broker
from socast.stream.structured_log import log_lines
from socast.stream.zenoh_delivery import ZenohDelivery
from socast.stream.zenoh_session import LOOPBACK, Connection, Node, parse_prefix
from socast.stream.zenoh_signals import ZenohSignals
from socast.tools.bridge.bridge_loop import SignalSource, run_bridge
from socast.tools.bridge.ovms import TOPICS, OvmsReader, OvmsSource
from socast.tools.bridge.row_assembler import HOLD_S, PERIOD_S, RowAssembler
from socast.tools.bridge.vss import NEWEST, VssReader, VssSource
from socast.tools.terminal.option_groups import insert_options
from socast.tools.terminal.output import VehicleFiles
from socast.tools.terminal.stop_signals import stop_on_signals

PASSWORD: Final = "SOCAST_MQTT_PASSWORD"  # noqa: S105 - the name of an environment variable
"""Environment variable with the password of the broker."""

app = typer.Typer(help="Bridges from other ecosystems into Zenoh.", no_args_is_help=True)


@dataclass(frozen=True)
class BridgeOptions:
    """Hold the options that all bridges share, and run a bridge.

    Parameters
    ----------
    report_s : float
        Time between two log lines of counters. [s]
    """

    connection: Connection
    prefix: str
    assembler: RowAssembler
    report_s: float
    as_json: bool

    def run(self, open_source: Callable[[ExitStack], SignalSource]) -> None:
        """Join the router, open the source, and pass its signals on until SIGINT or SIGTERM."""
        log_lines(as_json=self.as_json)
        with stop_on_signals() as stop, ExitStack() as stack:
            node = stack.enter_context(Node(self.connection))
            delivery = stack.enter_context(ZenohDelivery(node, self.prefix))
            run_bridge(open_source(stack), self.assembler, delivery, stop, self.report_s)


def make_bridge_options(
    *,
    connect: Annotated[
        list[str] | None,
        typer.Option(metavar="E", help=f"Publish to the router at E; repeatable. [default: {LOOPBACK}]"),
    ] = None,
    config: Annotated[
        Path | None, typer.Option(metavar="F.json5", help="Publish with Zenoh's own configuration, such as TLS.")
    ] = None,
    prefix: Annotated[str, typer.Option(metavar="P", help="Key chunks before `fleet`, such as montreal.")] = "",
    model: Annotated[
        list[str] | None,
        typer.Option(metavar="[CAR=]KEY", help="Vehicle model of a car, or of all others; repeatable."),
    ] = None,
    _: VehicleFiles = None,
    period: Annotated[
        float,
        typer.Option(metavar="S", help="Time that a row covers: a car has at most one row in it.", min=0.1, max=600),
    ] = PERIOD_S,
    hold: Annotated[
        float, typer.Option(metavar="S", help="Time for which a signal without news stays as it is.", min=0, max=86400)
    ] = HOLD_S,
    report: Annotated[
        float, typer.Option(metavar="S", help="Time between two log lines of counters.", min=0.001, max=1e6)
    ] = REPORT_S,
    json_log: Annotated[bool, typer.Option("--json-log", help="Log JSON instead of key=value.")] = False,
) -> BridgeOptions:
    """Return the options that all bridges share."""
    connection = Connection(tuple(connect or ()), mode="client", config=config)
    assembler = RowAssembler(period, hold, parse_models(model or []))
    return BridgeOptions(connection, parse_prefix(prefix), assembler, report, json_log)


insert_bridge_options = insert_options("options", make_bridge_options, "Rows and their router")
"""Decorator that gives a command the options of all bridges in place of its argument `options`."""


@app.command("ovms")
@insert_bridge_options
def bridge_ovms(
    *,
    broker: Annotated[
        str, typer.Option(metavar="URL", help="MQTT broker: mqtt://HOST:PORT, or mqtts://HOST with TLS.")
    ],
    topics: Annotated[str, typer.Option(metavar="T", help="First levels of all topics, before user and car.")] = TOPICS,
    user: Annotated[str | None, typer.Option(metavar="NAME", help="User at the broker.")] = None,
    password_file: Annotated[
        Path | None, typer.Option(metavar="FILE", help=f"File with the password. [default: variable {PASSWORD}]")
    ] = None,
    authority: Annotated[
        Path | None, typer.Option(metavar="FILE.pem", help="Certificate authority of the broker.")
    ] = None,
    certificate: Annotated[Path | None, typer.Option(metavar="FILE.pem", help="Certificate of this client.")] = None,
    key: Annotated[Path | None, typer.Option(metavar="FILE.pem", help="Private key of the certificate.")] = None,
    client_id: Annotated[
        str, typer.Option(metavar="NAME", help="Name of the session that the broker keeps for this bridge.")
    ] = "socast-bridge",
    options: BridgeOptions,
) -> None:
    """Pass on metrics of OVMS modules (Open Vehicle Monitoring System) from an MQTT broker.

    The broker keeps what modules send with QoS 1 until a Zenoh router has read it, also while the bridge is away. The
    modules themselves send with QoS 0; a broker may be set to keep these too.

    SIGINT or SIGTERM ends the bridge after open rows were sent. The log goes to standard error. Nothing listens.

    Examples
    --------
    socast bridge ovms --broker mqtt://127.0.0.1:1883 --model nissan-leaf-2016
    socast bridge ovms --broker mqtts://broker.example --user fleet --password-file broker.secret --prefix montreal
    """
    known = Broker(broker, client_id, user, read_password(password_file, os.environ), authority, certificate, key)
    check_broker(known)  # before the router is joined, so that mistakes come first
    reader = OvmsReader(options.assembler, topics)
    options.run(lambda stack: OvmsSource(stack.enter_context(MqttSource(known, reader.list_topics())), reader))


@app.command("vss")
@insert_bridge_options
def bridge_vss(
    *,
    source: Annotated[
        list[str] | None,
        typer.Option("--from", metavar="E", help="Router of the cars, if it is not that of --connect."),
    ] = None,
    source_config: Annotated[
        Path | None, typer.Option("--from-config", metavar="F.json5", help="Zenoh configuration for --from.")
    ] = None,
    source_prefix: Annotated[
        str, typer.Option("--from-prefix", metavar="P", help="Key chunks before the car in the cars' keys.")
    ] = "",
    vehicle: Annotated[
        str | None, typer.Option(metavar="CAR", help="Name of the only car, whose keys begin with `Vehicle/`.")
    ] = None,
    vss_version: Annotated[int, typer.Option(metavar="N", help="Major version of VSS, which decides units.")] = NEWEST,
    options: BridgeOptions,
) -> None:
    """Pass on signals of the COVESA Vehicle Signal Specification over Zenoh.

    A signal is published under CAR/Vehicle/..., such as taxi-7/Vehicle/Speed, as a number or as a JSON object with a
    value and a timestamp.

    SIGINT or SIGTERM ends the bridge after open rows were sent. The log goes to standard error. Nothing listens.

    Examples
    --------
    socast bridge vss --from tcp/cars.example:7447 --connect tcp/router.example:7447
    socast bridge vss --vehicle taxi-7 --model taxi-7=nissan-leaf-2016
    """
    reader = VssReader(options.assembler, parse_prefix(source_prefix), vehicle, vss_version)
    given = source or source_config
    origin = Connection(tuple(source or ()), mode="client", config=source_config) if given else options.connection

    def open_source(stack: ExitStack) -> SignalSource:
        node = stack.enter_context(Node(origin))  # a session of its own, see `socast.stream.zenoh_sink`
        return VssSource(stack.enter_context(ZenohSignals(node, reader.name_keys())), reader)

    options.run(open_source)


def parse_models(texts: Sequence[str]) -> dict[str, str]:
    """Return the vehicle model by car, `*` for all others."""
    models: dict[str, str] = {}
    known = load_catalogue()
    for text in texts:
        car, _, key = text.rpartition("=")
        if key not in known:
            raise SettingsError(f"--model names {key}, which the catalogue lacks; {suggest_names(key, known)}")
        if models.setdefault(car or "*", key) != key:
            raise SettingsError(f"--model gives {car or 'all cars'} two models; leave one of them out")
    return models


def read_password(file: Path | None, environment: Mapping[str, str]) -> str | None:
    """Return the password of a file, else of the environment; None if there is none."""
    if file is None:
        return environment.get(PASSWORD)
    try:
        lines = read_input(file, 1 << 16).decode().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        words = getattr(error, "strerror", None) or "it is not UTF-8 text"
        raise SettingsError(f"--password-file {file} cannot be read: {words.lower()}; give a text file") from error
    if not lines or not lines[0]:
        raise SettingsError(f"--password-file {file} is empty; write the password into its first line")
    return lines[0]
