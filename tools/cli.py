"""The command line: `socast COMMAND`.

Each command is a function, or a group of functions, in a file of its own. The file is imported only when its command
is called, because numba, pandas and Zenoh take seconds to import and `socast --help` needs none of them.
"""

import atexit
import errno
import gc
import inspect
import os
import re
import resource
import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Annotated, Any, Final, NamedTuple

import typer
from typer.core import TyperCommand

from socast.core.errors import SocastError


class Command(NamedTuple):
    """Hold the module and the summary of a command.

    Parameters
    ----------
    name : str
        Name of a function, or of a `typer.Typer` that has commands of its own.
    """

    module: str
    name: str
    summary: str


UsageError: Any = typer.BadParameter.__base__
"""What typer raises for a wrong call: an unknown command or option, a missing one, or a wrong value."""

COMMANDS: Final = {
    "demo": Command(
        "socast.tools.commands.demo", "demo", "Show a recorded shift as if it were live, in under a minute."
    ),
    "live": Command("socast.tools.commands.live", "live", "Forecast and record cars that send telemetry over Zenoh."),
    "router": Command("socast.tools.commands.router", "route", "Run a Zenoh router that cars and consumers join."),
    "bridge": Command(
        "socast.tools.commands.bridge", "app", "Pass on telemetry of OVMS modules or VSS signals to Zenoh."
    ),
    "serve": Command("socast.tools.commands.serve", "serve", "Show the fleet and its models in a browser."),
    "ask": Command("socast.tools.commands.ask", "ask_outlook", "Ask a live consumer whether a car can take a ride."),
    "replay": Command("socast.tools.commands.replay", "replay", "Replay recordings through a model or to a router."),
    "check": Command(
        "socast.tools.commands.check", "check", "Show what the logger of each car sends wrong, and its cost."
    ),
    "verify": Command(
        "socast.tools.commands.verify", "verify", "Compare the Kalman filters with filterpy's on recordings."
    ),
    "info": Command("socast.tools.commands.info", "info", "Show what recordings contain and what is lost."),
    "anonymise": Command("socast.tools.commands.anonymise", "anonymise", "Hide names, places and dates of recordings."),
    "spikein": Command(
        "socast.tools.commands.spikein", "spikein", "Put a known effect into recordings, to judge a diagnosis by it."
    ),
    "elevation": Command(
        "socast.tools.commands.elevation", "app", "Learn a map of elevation from the fixes of a fleet."
    ),
    "tables": Command("socast.tools.commands.tables", "tables", "Make ride and window tables from recordings."),
    "fit": Command("socast.tools.commands.fit", "fit", "Fit a model to rides."),
    "evaluate": Command(
        "socast.tools.commands.evaluate", "evaluate_tables", "Evaluate models on held-out rides of tables."
    ),
    "evaluate-soc": Command(
        "socast.tools.commands.evaluate_soc",
        "evaluate_recordings",
        "Evaluate forecasts of the charge at the shift's end.",
    ),
    "compare": Command(
        "socast.tools.commands.compare", "compare_models", "Compare models with the measured energy of rides."
    ),
    "waterfall": Command(
        "socast.tools.commands.waterfall", "show_waterfall", "Show how much energy each term of a model takes."
    ),
    "diagnose": Command(
        "socast.tools.commands.diagnose", "diagnose_rides", "Find where a model fails and which effect it lacks."
    ),
    "add": Command(
        "socast.tools.commands.add", "add_effect", "Add an effect to a model if it helps on held-out rides."
    ),
    "history": Command(
        "socast.tools.commands.history", "show_history", "Show how the error of a model fell, step by step."
    ),
    "condition": Command(
        "socast.tools.commands.condition", "show_condition", "Tell how each car is doing, and since when."
    ),
    "before-after": Command(
        "socast.tools.commands.before_after", "compare", "Estimate whether a repair changed the consumption of cars."
    ),
    "simulate": Command(
        "socast.tools.commands.simulate", "simulate", "Simulate a fleet of electric taxis with faulty loggers."
    ),
    "import": Command(
        "socast.tools.commands.import_drives",
        "import_drives",
        "Convert files of your own, or public data sets, to a recording.",
    ),
    "vehicles": Command("socast.tools.commands.vehicles", "app", "List vehicle models, or describe cars of your own."),
    "secure": Command("socast.tools.commands.secure", "app", "Make certificates and access control for a fleet."),
    "effects": Command(
        "socast.tools.commands.effects", "app", "List the physical effects of models, or check your own."
    ),
}
"""Every command, in the order of `socast --help`."""

HELP_WIDTH: Final = 100
"""Largest width of help texts. [columns]"""
EXAMPLE_WIDTH: Final = 80
"""Largest width of an example in a help text, if its options permit. [columns]"""
MANY_OPTIONS: Final = 15
"""Number of options above which a help text divides them."""
COMPLETION: Final = "_SOCAST_COMPLETE"
"""Environment variable with which a shell asks for completions."""
CLOSED_PIPE: Final = 141
"""Exit code after standard output was closed: that of a process that SIGPIPE ended, 128 + 13."""
_FULL: Final = "a disk is full: {reason}; make room, and start again"
_FILES: Final = "{reason}: the limit of open files is too low; raise it with `ulimit -n`, and start again"
SHORTAGES: Final = {
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT, errno.EFBIG), _FULL),
    **dict.fromkeys((errno.EMFILE, errno.ENFILE), _FILES),
}
"""What to say where the operating system gives a process no more of something, by its reason."""
LEAST_SPACE: Final = 4 << 30
"""Address space that commands and their threads need; most of it takes no memory. [B]"""
LONGEST_LINE: Final = 2000
"""Longest error message that is printed whole; of a longer one, which may quote a file, the middle is left out."""

_SETTINGS: Final = "socast.tools.terminal.settings_file"
"""Module of settings files; it is imported only by commands that take one."""
_PIECE: Final = re.compile(r" (?=--?[a-z]|\| )")
"""Space in an example at which a line may end: before an option or a pipe."""
_ARGUMENT: Final = re.compile(r"\{(.+?)(?:\.\.\.)?\}((?:\.\.\.)?)|\[(\[.+\])\]")
"""An argument as typer writes it in a usage line: `{NAME}`, `{NAME}...` or `[[NAME]]`."""
_TYPE: Final = re.compile(r"<int[a-z ]*>")
"""A whole number as typer writes it beside the name of an option."""
_RANGE: Final = re.compile(r"(-?[\d.e+]+)<=x<=(-?[\d.]+(?:e\+\d+)?)|x>=(-?\d+(?:\.\d+)?)")
"""A range as typer writes it."""


class PlainCommand(TyperCommand):
    """Write arguments by their names alone, without the braces and types that typer adds, and ranges in words."""

    def invoke(self, ctx: Any) -> Any:
        """Run the command; an error about a value of a settings file names the file and the line."""
        try:
            return super().invoke(ctx)
        except SocastError as error:
            reader = sys.modules.get(_SETTINGS)
            if reader and (place := reader.find_place(ctx, str(error))):
                raise SocastError(f"{place}{error}") from error
            raise

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Return the words of the usage line after the name of the command."""
        return [_ARGUMENT.sub(r"\1\2\3", piece) for piece in super().collect_usage_pieces(ctx)]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the arguments and the options, each with its description; many options stand under several titles."""
        rows: dict[str, list[tuple[str, str]]] = {"Arguments": [], "Options": []}
        parameters = self.get_params(ctx)
        are_many = sum(each.param_type_name == "option" for each in parameters) > MANY_OPTIONS
        for parameter in parameters:
            if (record := parameter.get_help_record(ctx)) is None:
                continue
            is_argument = parameter.param_type_name == "argument"
            name = record[0].partition(" <")[0] if is_argument else _TYPE.sub("N", record[0])
            title = (
                "Arguments" if is_argument else (are_many and getattr(parameter, "rich_help_panel", None)) or "Options"
            )
            rows.setdefault(title, []).append((name, word_ranges(record[1])))
        for title, of_title in rows.items():
            if of_title:
                with formatter.section(title):
                    formatter.write_dl(of_title)


def application(chosen: str | None = None) -> typer.Typer:
    """Return the command line with one command imported and the others known by name only."""
    app = typer.Typer(
        name="socast",
        no_args_is_help=True,
        rich_markup_mode=None,  # boxes cut options off at 80 columns, and rich takes longer to import than the rest
        pretty_exceptions_enable=False,
        context_settings={"max_content_width": HELP_WIDTH},
        help="Forecast the consumption of electric cars from live telemetry, and explain it.",
        epilog="`socast COMMAND --help` shows the options and examples of a command.",
    )
    app.callback()(_options)
    for name, command in COMMANDS.items():
        if name != chosen:
            app.command(name, help=command.summary, short_help=command.summary)(_unloaded)
            continue
        loaded = getattr(import_module(command.module), command.name)
        if isinstance(loaded, typer.Typer):
            for each in loaded.registered_commands:
                each.help, each.cls = help_text(each.callback), PlainCommand
            app.add_typer(loaded, name=name, short_help=command.summary)
        else:
            app.command(name, cls=PlainCommand, help=help_text(loaded), short_help=command.summary)(loaded)
    return app


def word_ranges(text: str) -> str:
    """Return a text in which ranges of numbers, as typer writes them, are in words.

    Examples
    --------
    >>> word_ranges("[default: 3.0; 0.1<=x<=60.0]"), word_ranges("1 is not in the range x>=5.")
    ('[default: 3.0; 0.1 to 60]', '1 is not in the range 5 or more.')
    """
    return _RANGE.sub(
        lambda match: (
            " to ".join(end.removesuffix(".0") for end in match.groups()[:2])
            if match[1]
            else f"{match[3].removesuffix('.0')} or more"
        ),
        text,
    )


def help_text(command: Callable[..., Any] | None) -> str:
    r"""Return the help text of a command: the prose of its docstring, then its examples, one command a line.

    Parameters
    ----------
    command : callable
        Its docstring has an `Examples` section in numpydoc's form, whose lines stay as they are; other sections are for
        readers of the code and are left out. An example that is wider than `EXAMPLE_WIDTH` continues on further lines.

    Examples
    --------
    >>> def look() -> None:
    ...     '''Look at a file.
    ...
    ...     Examples
    ...     --------
    ...     socast look a.mcap
    ...     '''
    >>> help_text(look)
    'Look at a file.\n\n\x08\nExamples:\n  socast look a.mcap'
    """
    lines = (inspect.getdoc(command) or "").splitlines()
    rules = [i for i, line in enumerate(lines) if line and not line.strip("-")]
    ends = [*(rule - 1 for rule in rules), len(lines)]
    parts = ["\n".join(lines[: ends[0]]).strip()]
    for rule, end in zip(rules, ends[1:], strict=True):
        if lines[rule - 1] == "Examples":
            parts.append(
                "\n".join(["\b", "Examples:", *(_wrap_example(line) for line in lines[rule + 1 : end] if line)])
            )
    return "\n\n".join(parts)


def _wrap_example(line: str) -> str:
    """Return an indented example; each line that a shell continues ends with a backslash."""
    made = ""
    for piece in _PIECE.split(f"  {line}"):
        is_full = len(made.rpartition("\n")[2]) + len(piece) + len("  \\") > EXAMPLE_WIDTH
        made += piece if not made else f" \\\n      {piece}" if is_full else f" {piece}"
    return made


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line; an error that a person can correct is one line on standard error, with exit code 2."""
    atexit.register(gc.freeze)  # the interpreter would search what numba and pandas hold for cycles: a quarter second
    given = list(sys.argv[1:] if arguments is None else arguments)
    chosen = next((word for word in _completed(os.environ) or given if not word.startswith("-")), None)
    try:
        code = application(chosen)(given, prog_name="socast", standalone_mode=False) or 0
        sys.stdout.flush()
        output = sys.modules.get("socast.tools.terminal.output")  # imported only by commands that print tables
        if output is not None and output.has_lost_reader():
            code = CLOSED_PIPE
    except (SocastError, UsageError) as error:
        print(_usage(error, chosen) if isinstance(error, UsageError) else _one_line(str(error)), file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # the interpreter's last flush stays silent
        raise SystemExit(CLOSED_PIPE) from None
    except Exception as error:
        if (words := _explain_shortage(error)) is None:
            raise
        print(_one_line(words), file=sys.stderr)
        raise SystemExit(2) from None
    raise SystemExit(code)


def _explain_shortage(error: Exception) -> str | None:
    """Return what the operating system gives too little of, None where an error has another cause."""
    if words := SHORTAGES.get(getattr(error, "errno", None) or 0):
        return words.format(reason=getattr(error, "strerror", ""))
    most = resource.getrlimit(resource.RLIMIT_AS)[0]
    if 0 <= most < LEAST_SPACE:  # negative for no limit; libraries then fail in many ways
        return (
            f"the address space is limited to {most >> 20} MiB ({error}): raise it with `ulimit -v {LEAST_SPACE >> 10}`"
        )
    if "no locator available" in str(error):  # numba's
        return "no folder for compiled code can be written: set NUMBA_CACHE_DIR or TMPDIR to one that can"
    if isinstance(error, MemoryError):
        return f"memory is used up ({str(error) or 'no more is given'}): free some, or read fewer recordings"
    return None


def _completed(environment: Mapping[str, str]) -> list[str]:
    """Return the words after `socast` that a shell asks to complete; none where it does not ask."""
    if COMPLETION not in environment:
        return []
    line = environment.get("COMP_WORDS") or environment.get("_TYPER_COMPLETE_ARGS", "")
    return line.split()[1:]


def _usage(error: UsageError, chosen: str | None) -> str:
    """Return what is wrong with a call: value, limit and where to read on; the help text where no command is given."""
    if error.ctx and error.message == error.ctx.get_help():
        return str(error.message)
    words = word_ranges(error.format_message().rstrip("."))
    wrong: list[dict[str, Any]] = getattr(error.__cause__, "errors", list)()
    if wrong:  # typer leaves the value out
        name, message = error.param.get_error_hint().strip("'"), wrong[0]["msg"]
        choices = message.partition("Value error, ")[2].rstrip(".")
        wanted = message.partition(",")[0].replace("Input should", "must")
        words = f"{name} is wrong: {choices}" if choices else f"{name} is '{wrong[0]['input']}', {wanted}"
    command = error.ctx.command_path if error.ctx else f"socast {chosen}" if chosen in COMMANDS else "socast"
    mark = "" if words.endswith("?") else ";"
    reader = sys.modules.get(_SETTINGS)
    place = reader.name_place(error.ctx, error.param) if reader and isinstance(error, typer.BadParameter) else ""
    return _one_line(f"{place}{words[0].lower()}{words[1:]}{mark} `{command} --help` lists the options")


def _one_line(message: str) -> str:
    """Return an error message as the one line that a person reads; the middle of a very long one is left out."""
    line = " ".join(message.split())
    half = LONGEST_LINE // 2
    return f"socast: {line if len(line) <= LONGEST_LINE else f'{line[:half]} ... {line[-half:]}'}"


def _show_version(wanted: bool) -> None:
    """Print the version and end."""
    if wanted:
        from importlib.metadata import version  # noqa: PLC0415 - takes 40 ms to import

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
