"""The reference of commands, read from the command line itself."""  # noqa: INP001

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, get_args, get_origin

import typer
from markdown_text import code, paragraphs, plain, table

from socast.tools.cli import COMMANDS, application

DOCS: Final = Path(__file__).parents[1]
GUIDES: Final = (DOCS / "missing-effect.md", *sorted((DOCS / "guide").glob("*.md")))
"""Pages from which examples are taken."""
TYPES: Final = {Path: "path", str: "text", int: "whole number", float: "number"}
ROOT_FOLDER: Final = str(DOCS.parent)


class CommandHelp(NamedTuple):
    """One command as a person types it, and the object of the command line that runs it."""

    path: str
    command: Any


def commands() -> str:
    """Return the reference of every command, in the order of `socast --help`."""
    return "\n".join(_section(help_of) for name in COMMANDS for help_of in all_commands(name))


def all_commands(name: str) -> Iterator[CommandHelp]:
    """Yield a command, and after it the commands that it contains."""
    top = typer.main.get_command(application(name)).commands[name]
    yield CommandHelp(f"socast {name}", top)
    for inner, command in getattr(top, "commands", {}).items():
        yield CommandHelp(f"socast {name} {inner}", command)


def parameters(command: Any) -> list[Any]:
    """Return the arguments and options of a command, without `--help`."""
    return [parameter for parameter in command.params if parameter.name != "help"]


def _section(each: CommandHelp) -> str:
    """Return the section of one command."""
    level = "##" if each.path.count(" ") == 1 else "###"
    parts = [f"{level} {each.path}", _prose(each.command.help)]
    if inner := getattr(each.command, "commands", None):
        parts.append(f"It has {len(inner)} commands: {', '.join(code(name) for name in inner)}.")
    described = parameters(each.command)
    arguments = [one for one in described if one.param_type_name == "argument"]
    options = [one for one in described if one.param_type_name == "option"]
    if arguments:
        rows = [[code(one.metavar or one.name.upper()), _takes(one), _text(one)] for one in arguments]
        parts.append(table(["argument", "takes", "meaning"], rows))
    if options:
        parts.append(table(["option", "takes", "default", "meaning"], map(_option, options)))
    if examples := _examples(each.path):
        parts.append("```text\n" + "\n".join(examples) + "\n```")
    return "\n\n".join(parts) + "\n"


def _prose(text: str | None) -> str:
    """Return a help text in Markdown; its examples are code."""
    parts = (text or "").replace("\b", "").split("\n\n")
    return "\n\n".join(_example(part.strip()) or paragraphs(plain(part)) for part in parts if part.strip())


def _example(part: str) -> str | None:
    """Return a paragraph of example calls as a code block; None for other paragraphs."""
    head, colon, calls = part.partition(":")
    if not colon or head not in {"Example", "Examples"}:
        return None
    lines = " ".join(calls.split()).replace(" socast ", "\nsocast ")
    return f"{head}:\n\n```text\n{lines}\n```"


def _option(option: Any) -> list[str]:
    """Return the row of an option."""
    names = ", ".join(map(code, [*option.opts, *option.secondary_opts]))
    if option.metavar:
        names += f" {code(option.metavar)}"
    return [names, _takes(option), _default(option), _text(option)]


def _takes(parameter: Any) -> str:
    """Return the type and range of a value, in words."""
    if getattr(parameter, "is_flag", False):
        return "switch"
    kind = parameter.type_descriptor.annotation
    if get_origin(kind) is Literal:
        return " or ".join(map(code, get_args(kind)))
    several = get_origin(kind) is list
    words = TYPES[get_args(kind)[0] if several else kind]
    low, high = getattr(parameter, "min", None), getattr(parameter, "max", None)
    if low is not None:
        words += f", {low:g} to {high:g}" if high is not None else f", at least {low:g}"
    return f"{words}; repeatable" if several else words


def _default(option: Any) -> str:
    """Return the default of an option; its own words where the help text gives them."""
    if option.required:
        return "required"
    if written := re.search(r"\[default: (.*?)\]", option.help or ""):
        return plain(written[1])
    value = option.default
    if value is None or value == () or callable(value):
        return ""
    if isinstance(value, bool):
        return "on" if value else "off"
    if isinstance(value, list | tuple):
        value = " ".join(map(str, value))
    return code(str(value).removeprefix(f"{ROOT_FOLDER}/")) if str(value) else ""


def _text(parameter: Any) -> str:
    """Return the help text of a parameter, without its default."""
    words = re.sub(r"\s*\[default(:.*?)?\]", "", parameter.help or "")
    return plain(words)


def _examples(path: str) -> list[str]:
    """Return the calls of a command that guides show, each once, at most four."""
    commands = dict.fromkeys(
        line.removeprefix("$ ")
        for page in GUIDES
        for line in page.read_text(encoding="utf-8").splitlines()
        if line.removeprefix("$ ").split("#")[0].strip().startswith(f"{path} ") or line.removeprefix("$ ") == path
    )
    return list(commands)[:4]
