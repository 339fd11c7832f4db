"""The library of effects: those of the product, and those loaded from users' files.

An effect is the unit of physics: power = coefficient * function(columns). Every model is a sum over effects, so that a
residual can be attributed to an effect and a coefficient compared with its plausible range. See `effect` for how to
write one.
"""

import ast
import re
import runpy
import subprocess
import sys
import traceback
from collections import Counter
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import Final

import msgspec

from socast.core.effects import air, battery, cabin, electrics, powertrain, road_load, tyres
from socast.core.effects.declaration import VARIANT, Effect
from socast.core.effects.verification import check_effect
from socast.core.errors import EffectError, read_input
from socast.core.files import UNREADABLE

TIME_LIMIT: Final = 60.0
"""Longest time for importing and checking a user's file, which takes about 1 s of processor time. [s]"""
MOST_FUNCTIONS, MOST_ARGUMENTS = 1000, 100
"""Largest numbers of functions in a file, and of arguments of each."""
ALLOWED_IMPORTS: Final = frozenset(
    {"__future__", "collections", "dataclasses", "functools", "itertools", "math", "numpy", "socast", "typing"}
)
"""Modules that a file of effects may import. An effect is a pure function of columns, without files or network."""
FORBIDDEN_CALLS: Final = frozenset({"__import__", "breakpoint", "compile", "eval", "exec", "input", "open"})
"""Functions that a file of effects must not call, for the same reason."""

_USER_MODULE: Final = "user_effects"
_DECLARATION: Final = {
    "effect()": "@effect(coefficient=..., unit=..., low=..., high=..., source=...)",
    "Parameter.__init__()": 'Parameter(value, "unit", low, high, grid=(...))',
}
"""How to write a declaration, by the name with which Python's errors call it."""


def _list_declared(module: ModuleType) -> tuple[Effect, ...]:
    """Return the effects that a module declares, in its order."""
    return tuple(each for each in vars(module).values() if isinstance(each, Effect))


ROAD_LOAD: Final = _list_declared(road_load)
"""Base effects, in the order of the force balance."""
CANDIDATES: Final[Mapping[str, tuple[Effect, ...]]] = MappingProxyType(
    {
        "air": _list_declared(air),
        "tyres and road": _list_declared(tyres),
        "cabin": _list_declared(cabin),
        "powertrain and load": _list_declared(powertrain),
        "battery": _list_declared(battery),
        "electrics": _list_declared(electrics),
    }
)
"""Candidate effects beyond the road load, by topic.

Each effect is what its phenomenon adds to the base effects of `socast.core.effects.road_load`, in the textbook's form.
Diagnosis tests whether the data show it. Where a plausible range begins above zero, physics demands a positive
coefficient.
"""
_SHIPPED: Final[Mapping[str, tuple[Effect, ...]]] = MappingProxyType({"road load": ROAD_LOAD, **CANDIDATES})
_library: dict[str, Effect] = {e.name: e for effects in _SHIPPED.values() for e in effects}
_brought_by: dict[str, Path] = {}


def get_library() -> Mapping[str, Effect]:
    """Return all loaded effects by name: the product's own, then those loaded from files."""
    return MappingProxyType(_library)


def group_by_topic() -> Mapping[str, list[Effect]]:
    """Return all loaded effects by topic: the product's own, then those of each file under the file's name."""
    topics = {topic: list(effects) for topic, effects in _SHIPPED.items()}
    for name, path in _brought_by.items():
        topics.setdefault(path.name, []).append(_library[name])
    return topics


def list_tabulated() -> list[str]:
    """Return the names of the effects in the tables: every loaded effect, followed by its variants.

    Examples
    --------
    >>> [name for name in list_tabulated() if name.startswith("wet_road")]
    ['wet_road', 'wet_road@depth=0.0001', 'wet_road@depth=0.001']
    """
    return [each.name for effect in _library.values() for each in (effect, *effect.variants)]


def list_own() -> list[str]:
    """Return the names of the effects that users' files brought, each followed by its variants."""
    return [each.name for name in _brought_by for each in (_library[name], *_library[name].variants)]


def get(name: str) -> Effect:
    """Return the effect of a name.

    Parameters
    ----------
    name : str
        Name of an effect, or of a variant: `cold_rolling@reference=283.15`, several parameters separated by commas.

    Raises
    ------
    EffectError
        Where no effect has the name, with similar names; for a variant that the effect cannot have, or whose name is
        not spelled as in the tables.

    Examples
    --------
    >>> get("rolling").unit
    '1'
    >>> dict(get("cold_rolling@reference=283.15").constants)
    {'reference': 283.15}
    """
    if (known := _library.get(name)) is not None:
        return known
    base, at, moved = name.partition(VARIANT)
    if at and base in _library:
        return _variant(_library[base], name, moved)
    close = get_close_matches(base, _library, n=3)
    hint = f"did you mean {' or '.join(close)}?" if close else f"known are {', '.join(_library)}."
    raise EffectError(f"effect {name!r} is unknown: {hint} Load a file of your own with --effects FILE")


def _variant(effect: Effect, name: str, moved: str) -> Effect:
    """Return the variant of a name, provided that the name is spelled as the variant's own."""
    parameters: dict[str, float] = {}
    for part in moved.split(","):
        parameter, _, value = part.partition("=")
        try:
            parameters[parameter] = float(value)
        except ValueError as error:
            raise EffectError(
                f"effect {name!r}: {value!r} is not a number: write {effect.name}@parameter=value"
            ) from error
    variant = effect.variant(parameters)
    if variant.name != name:
        raise EffectError(f"effect {name!r} is known as {variant.name!r}: write that")
    return variant


def load_file(path: str | Path, time_limit: float = TIME_LIMIT) -> list[Effect]:
    """Check a user's file of effects and add its effects to the library.

    The file is Python, and importing it runs it. It runs first in a separate process under a time limit, where every
    effect is checked, and then here. The separate process protects against mistakes; it is not a sandbox.

    Parameters
    ----------
    path : str or Path
        A `.py` file with functions under `@effect`, from `socast`. Loading it again replaces the effects that it
        brought before.
    time_limit : float
        Longest time for import and checks together. [s]
    """
    path = Path(path).absolute()
    source = _read(path)
    _check_source(path, source)
    _check_apart(path, time_limit)
    effects = _run(path)
    for effect in effects:
        if effect.name in _library and _brought_by.get(effect.name) != path:
            raise EffectError(f"{path}: effect {effect.name!r} is in the library already: give yours another name")
    _check_confusions(path, effects)
    for name in [name for name, file in _brought_by.items() if file == path]:
        del _library[name], _brought_by[name]
    for effect in effects:
        _library[effect.name], _brought_by[effect.name] = effect, path
    return effects


def _check_confusions(path: Path, effects: list[Effect]) -> None:
    """Refuse a confusion with an effect that is neither in the library nor in the file."""
    known = {*_library, *(effect.name for effect in effects)}
    for effect in effects:
        if unknown := [name for name in effect.confused_with if name not in known]:
            close = get_close_matches(unknown[0], known, n=3)
            hint = f": did you mean {' or '.join(close)}?" if close else ""
            raise EffectError(f"{path}: effect {effect.name}: confused with {unknown[0]!r}, which is unknown{hint}")


def _read(path: Path) -> str:
    """Return the text of a file."""
    try:
        return read_input(path).decode()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not UTF-8 text"
        raise EffectError(f"{path}: cannot read effects: {reason}; name a Python file") from error


def _is_json(source: str) -> bool:
    """Return whether a text is a JSON object or list, as model files and reports are."""
    try:
        return isinstance(msgspec.json.decode(source), dict | list)
    except UNREADABLE:
        return False


def _check_source(path: Path, source: str) -> None:
    """Check a file without running it: its syntax, its imports, its calls, and names defined twice."""
    if _is_json(source):
        raise EffectError(
            f"{path}: holds JSON, and effects are written in Python: name a .py file; a model file goes to --model"
        )
    try:
        tree = ast.parse(source, filename=str(path))
    except (SyntaxError, ValueError) as error:  # ValueError: null bytes
        line = getattr(error, "lineno", None) or 1
        raise EffectError(f"{path}:{line}: not Python: {getattr(error, 'msg', error)}") from error
    except (RecursionError, MemoryError) as error:
        raise EffectError(f"{path}: not Python: an expression is nested too deeply; split it") from error
    for node in ast.walk(tree):
        modules = [a.name for a in node.names] if isinstance(node, ast.Import) else []
        if isinstance(node, ast.ImportFrom):
            modules = ["." * node.level + (node.module or "")]
        for module in modules:
            if module.partition(".")[0] not in ALLOWED_IMPORTS:
                allowed = ", ".join(sorted(ALLOWED_IMPORTS))
                raise EffectError(f"{path}:{node.lineno}: imports {module}; an effect may import only {allowed}")  # type: ignore[attr-defined]
        called = node.func.id if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) else ""
        if called in FORBIDDEN_CALLS:
            raise EffectError(f"{path}:{node.lineno}: calls {called}; compute an effect from its columns alone")  # type: ignore[attr-defined]
    _check_functions(path, [node for node in tree.body if isinstance(node, ast.FunctionDef)])


def _check_functions(path: Path, functions: Sequence[ast.FunctionDef]) -> None:
    """Refuse functions that are too many, have too many arguments, or hide one another."""
    arguments = max((len(node.args.args) + len(node.args.kwonlyargs) for node in functions), default=0)
    for count, most, words in (
        (len(functions), MOST_FUNCTIONS, "functions in a file: divide it"),
        (arguments, MOST_ARGUMENTS, "arguments of a function: an effect is a function of a few columns"),
    ):
        if count > most:
            raise EffectError(f"{path}: {count:,} is more than {most:,} {words}")
    names = Counter(node.name for node in functions)
    if twice := [name for name, times in names.items() if times > 1]:
        raise EffectError(f"{path}: {twice[0]!r} is defined twice, and the second hides the first: rename one")


def _check_apart(path: Path, time_limit: float) -> None:
    """Run and check a file in a separate process, which can be ended where the file does not terminate."""
    command = [
        sys.executable,
        "-c",
        "import sys; from socast.core.effects.registry import _inspect; _inspect(sys.argv[1])",
        str(path),
    ]
    try:
        done = subprocess.run(  # noqa: S603 - the user's own file, named by the user
            command,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=time_limit,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise EffectError(
            f"{path}: not done after {time_limit:g} s: look for an endless loop, or for work done at import"
        ) from error
    if done.returncode:
        lines = done.stderr.strip().splitlines() or [f"the interpreter stopped with code {done.returncode}"]
        raise EffectError(_with_path(path, lines[-1]))


def _with_path(path: Path, message: str) -> str:
    """Return a message that begins with the path."""
    return message if message.startswith(str(path)) else f"{path}: {message}"


def _inspect(name: str) -> None:
    """Run and check a file in the separate process; write an error to stderr as the last line."""
    try:
        _check_here(Path(name))
    except EffectError as error:
        sys.exit(f"\n{error}")


def _check_here(path: Path) -> None:
    """Run and check a file in this process."""
    try:
        for effect in _run(path):
            check_effect(effect)
    except EffectError as error:
        raise EffectError(_with_path(path, str(error))) from error


def _run(path: Path) -> list[Effect]:
    """Run a file and return the effects that it defines, in its order."""
    try:
        names = runpy.run_path(str(path), run_name=_USER_MODULE)
    except EffectError as error:
        raise EffectError(f"{path}: {error}") from error
    except (Exception, SystemExit) as error:  # whatever a user's file raises
        lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
        reason = " ".join(str(error).split())
        where = f"{path}:{lines[-1]}" if lines else f"{path}"
        if isinstance(error, TypeError) and (wrong := _explain_declaration(reason)):
            raise EffectError(f"{where}: {wrong}") from error
        raise EffectError(f"{where}: raises {type(error).__name__} when imported: {reason}") from error
    effects = {id(e): e for e in names.values() if isinstance(e, Effect) and e.function.__module__ == _USER_MODULE}
    if not effects:
        raise EffectError(
            f"{path}: holds no effect: write `from socast import effect`, and @effect(...) over a function of columns"
        )
    return list(effects.values())


def _explain_declaration(reason: str) -> str:
    """Return the message for a declaration with wrong arguments, empty for any other `TypeError`.

    Examples
    --------
    >>> _explain_declaration("effect() missing 1 required keyword-only argument: 'source'")
    '@effect lacks source: write @effect(coefficient=..., unit=..., low=..., high=..., source=...)'
    """
    call, _, what = reason.partition(" ")
    if call not in _DECLARATION:
        return ""
    name = "@effect" if call == "effect()" else "Parameter"
    arguments = re.findall(r"'(\w+)'", what)
    if what.startswith("missing"):
        wrong = f"lacks {' and '.join(arguments)}"
    elif arguments:
        wrong = f"has no argument {arguments[0]}"
    else:
        wrong = "has too many arguments without a name"
    return f"{name} {wrong}: write {_DECLARATION[call]}"
