"""The decorator that gives several commands the same group of options, declared once."""

from collections.abc import Callable
from copy import copy
from functools import wraps
from inspect import Parameter, signature
from typing import Annotated, Any, get_args

from typer.models import OptionInfo

Function = Callable[..., Any]


def insert_options(name: str, build: Function, title: str = "") -> Callable[[Function], Function]:
    """Return a decorator that replaces one argument of a command by the options from which a function builds it.

    Parameters
    ----------
    build : callable
        Function that takes the options as its parameters and returns the value of the argument.
    title : str
        Title of these options in a long help text, for those that have none of their own.

    Examples
    --------
    >>> def area(width: int = 2, height: int = 3) -> int:
    ...     return width * height
    >>> @insert_options("size", area)
    ... def look(*, title: str, size: int) -> None:
    ...     print(title, size)
    >>> look(title="m2", height=5)
    m2 10
    >>> list(signature(look).parameters)
    ['title', 'width', 'height']
    """
    options = signature(build).parameters

    def decorate(command: Function) -> Function:
        original = signature(command)

        @wraps(command)
        def called(**given: Any) -> Any:
            value = build(**{option: given.pop(option) for option in options if option in given})
            return command(**given, **{name: value})

        shown: list[Parameter] = []
        for each in original.parameters.values():
            inserted = [_entitle(option, title) for option in options.values()] if each.name == name else [each]
            shown += [parameter.replace(kind=Parameter.KEYWORD_ONLY) for parameter in inserted]
        called.__signature__ = original.replace(parameters=shown)  # type: ignore[attr-defined]
        return called

    return decorate


def _entitle(parameter: Parameter, title: str) -> Parameter:
    """Return an option whose part of the help text has a title, if it had none."""
    kind, *about = get_args(parameter.annotation) or (None,)
    if not title or not any(isinstance(each, OptionInfo) and not each.rich_help_panel for each in about):
        return parameter
    entitled = [copy(each) for each in about]
    for each in entitled:
        each.rich_help_panel = title
    return parameter.replace(annotation=Annotated[kind, *entitled])
