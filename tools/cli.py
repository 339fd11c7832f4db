"""The command line: `socast COMMAND`.

Each command is a function, or a family of them, in its own file, and is loaded only when it is called: what reads
recordings, compiles and plots takes seconds to import, and `socast --help` should not.
"""

import os
import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.metadata import version
from typing import Annotated, Any, Final, NamedTuple

import typer

from core.errors import SocastError


class Command(NamedTuple):
    """Where a command is, and what it is for.

    Parameters
    ----------
    module : str
    name : str
        Of a function, or of a `typer.Typer` that has commands of its own.
    summary : str
    """

    module: str
    name: str
    summary: str


UsageError: Any = typer.BadParameter.__base__
"""What typer raises where a call is wrong: an unknown command or option, a missing one, or a wrong value."""

COMMANDS: Final = {
    "demo": Command("tools.commands.demo", "demo", "Watch a recorded shift as if it were live, in under a minute."),
    "live": Command("tools.commands.live", "live", "Listen to cars over Zenoh, forecast and record."),
    "ask": Command(
        "tools.commands.ask", "ask_outlook", "Ask a live consumer whether a car can take a ride and finish."
    ),
    "replay": Command("tools.commands.replay", "replay", "Replay recordings, through the model or to a router."),
    "info": Command("tools.commands.info", "info", "Tell what recordings hold, and what is lost."),
    "tables": Command("tools.commands.tables", "tables", "Turn recordings into ride and window tables."),
    "fit": Command(
        "tools.commands.fit", "fit", "Fit a model to ride tables, by one of the paper's recipes or past them."
    ),
    "evaluate": Command("tools.commands.evaluate", "evaluate_tables", "Judge models as the paper does, and past it."),
    "evaluate-soc": Command(
        "tools.commands.evaluate_soc",
        "evaluate_recordings",
        "Judge forecasts of the state of charge at the shift's end.",
    ),
    "compare": Command(
        "tools.commands.compare", "compare_models", "Show models against what rides measured, and where they part."
    ),
    "diagnose": Command(
        "tools.commands.diagnose", "diagnose_rides", "Find where a model fails, and which effect it lacks."
    ),
    "add": Command("tools.commands.add", "add_effect", "Add an effect to a model, if it helps on held-out rides."),
    "history": Command(
        "tools.commands.history", "show_history", "Tell a model's history: its error falling step by step."
    ),
    "simulate": Command(
        "tools.commands.simulate", "simulate", "Simulate a fleet of electric taxis, with faulty loggers."
    ),
    "import": Command("tools.commands.import_drives", "app", "Turn public data sets of real drives into recordings."),
    "effects": Command("tools.commands.effects", "app", "List the physical effects of models, or check your own."),
}
"""Every command, in the order of `socast --help`."""


def application(chosen: str | None = None) -> typer.Typer:
    """Return the command line, with one command loaded and the others by name only.

    Parameters
    ----------
    chosen : str, optional
        The command that is called; none where only help is wanted.
    """
    app = typer.Typer(
        name="socast",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        help="Live consumption predictions from electric-car telemetry: clean, explain, forecast.",
        epilog="`socast COMMAND --help` tells more.",
    )
    app.callback()(_options)
    for name, command in COMMANDS.items():
        if name != chosen:
            app.command(name, help=command.summary)(_unloaded)
            continue
        loaded = getattr(import_module(command.module), command.name)
        if isinstance(loaded, typer.Typer):
            app.add_typer(loaded, name=name)
        else:
            app.command(name)(loaded)
    return app


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line; an error that a person can mend is one line on standard error, with exit code 2."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    chosen = next((word for word in given if not word.startswith("-")), None)
    try:
        raise SystemExit(application(chosen)(given, prog_name="socast", standalone_mode=False) or 0)
    except (SocastError, UsageError) as error:
        if told := _usage(error, chosen) if isinstance(error, UsageError) else str(error):
            print(f"socast: {' '.join(told.split())}", file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # so that the interpreter's last flush is quiet
        raise SystemExit(1) from None


def _usage(error: UsageError, chosen: str | None) -> str:
    """Return what is wrong with a call: value, limit and where to read on; nothing where help was shown instead."""
    words = error.format_message().rstrip(".")
    wrong: list[dict[str, Any]] = getattr(error.__cause__, "errors", list)()
    if wrong:  # typer leaves the value out
        name, wanted = error.param.get_error_hint().strip("'"), wrong[0]["msg"].partition(",")[0]
        words = f"{name} is '{wrong[0]['input']}', {wanted.replace('Input should', 'must')}"
    command = error.ctx.command_path if error.ctx else f"socast {chosen}" if chosen in COMMANDS else "socast"
    return words and f"{words[0].lower()}{words[1:]}{'' if words.endswith('?') else ';'} `{command} --help` tells more"


def _show_version(wanted: bool) -> None:
    """Print the version and end."""
    if wanted:
        print(f"socast {version('socast')}")
        raise typer.Exit


def _options(
    *,
    _: Annotated[
        bool,
        typer.Option("--version", help="Show the version and exit.", is_eager=True, callback=_show_version),
    ] = False,
) -> None:
    """Take the options that stand before the command."""


def _unloaded() -> None:
    """Stand for a command that was not called."""


if __name__ == "__main__":
    main()
