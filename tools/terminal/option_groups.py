"""The decorator that gives several commands the same group of options, declared once."""

from collections.abc import Callable
from functools import wraps
from inspect import Parameter, signature
from typing import Any

Function = Callable[..., Any]


def insert_options(name: str, build: Function) -> Callable[[Function], Function]:
    """Return a decorator that replaces one argument of a command by the options from which a function builds it.

    Parameters
    ----------
    name : str
        Name of the command's argument.
    build : callable
        Function that takes the options as its parameters and returns the value of the argument.

    Returns
    -------
    callable
        Decorator. The decorated command takes only keyword arguments.

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
            inserted = options.values() if each.name == name else [each]
            shown += [parameter.replace(kind=Parameter.KEYWORD_ONLY) for parameter in inserted]
        called.__signature__ = original.replace(parameters=shown)  # type: ignore[attr-defined]
        return called

    return decorate
