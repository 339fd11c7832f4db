"""The library of effects: those of the product, and those that a user's own file brings.

An effect is the unit of physics: power = coefficient * function(columns). Every model is a sum over effects, so that a
residual can be attributed and a coefficient judged. See `effect` for how to write one.
"""

import ast
import runpy
import subprocess
import sys
import traceback
from collections import Counter
from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import Path
from types import MappingProxyType
from typing import Final

from core.effects.air import AIR
from core.effects.battery import BATTERY
from core.effects.cabin import CABIN
from core.effects.declaration import VARIANT, Effect
from core.effects.electrics import ELECTRICS
from core.effects.powertrain import POWERTRAIN
from core.effects.road_load import ROAD_LOAD
from core.effects.tyres import TYRES
from core.effects.verification import check_effect
from core.errors import EffectError

TIME_LIMIT: Final = 20.0
"""How long a user's file may take to be imported and checked. [s]"""
ALLOWED_IMPORTS: Final = frozenset(
    {"__future__", "collections", "core", "dataclasses", "functools", "itertools", "math", "numpy", "typing"}
)
"""What a file of effects may import: an effect is a pure function of columns, and needs neither files nor a network."""

FORBIDDEN_CALLS: Final = frozenset({"__import__", "breakpoint", "compile", "eval", "exec", "input", "open"})
"""What it may not call, for the same reason."""

_USER_MODULE: Final = "user_effects"
CANDIDATES: Final[Mapping[str, tuple[Effect, ...]]] = MappingProxyType(
    {
        "air": AIR,
        "tyres and road": TYRES,
        "cabin": CABIN,
        "powertrain and load": POWERTRAIN,
        "battery": BATTERY,
        "electrics": ELECTRICS,
    }
)
"""Topic -> the candidate effects beyond the road load.

Each effect is what its phenomenon adds to the base effects of `core.effects.road_load`, in the textbook's form. Diagnosis tests
whether the data show it. A plausible range that begins above zero says that physics demands the sign.
"""
_SHIPPED: Final[Mapping[str, tuple[Effect, ...]]] = MappingProxyType({"road load": ROAD_LOAD, **CANDIDATES})
_library: dict[str, Effect] = {e.name: e for effects in _SHIPPED.values() for e in effects}
_brought_by: dict[str, Path] = {}


def get_library() -> Mapping[str, Effect]:
    """Return all effects known now, by name: the product's own, then those loaded from files."""
    return MappingProxyType(_library)


def group_by_topic() -> Mapping[str, list[Effect]]:
    """Return all effects known now by topic: the product's own, then those of each file by its name."""
    found = {topic: list(effects) for topic, effects in _SHIPPED.items()}
    for name, path in _brought_by.items():
        found.setdefault(path.name, []).append(_library[name])
    return found


def list_tabulated() -> list[str]:
    """Return the names of what tables hold: every effect known now, and after it its variants.

    Examples
    --------
    >>> [name for name in tabulated() if name.startswith("wet_road")]
    ['wet_road', 'wet_road@depth=0.0001', 'wet_road@depth=0.001']
    """
    return [each.name for found in _library.values() for each in (found, *found.variants)]


def get(name: str) -> Effect:
    """Return the effect of that name.

    Parameters
    ----------
    name : str
        Of an effect, or of its variant: `cold_rolling@reference=283.15`, several parameters parted by commas.

    Raises
    ------
    EffectError
        Where there is none, with the names that come close; for a variant that the effect cannot have, or that is not
        named as it is in the tables.

    Examples
    --------
    >>> get("rolling").unit
    '1'
    >>> dict(get("cold_rolling@reference=283.15").constants)
    {'reference': 283.15}
    """
    if (found := _library.get(name)) is not None:
        return found
    base, at, moved = name.partition(VARIANT)
    if at and base in _library:
        return _variant(_library[base], name, moved)
    close = get_close_matches(base, _library, n=3)
    hint = f"did you mean {' or '.join(close)}?" if close else f"known are {', '.join(_library)}."
    raise EffectError(f"effect {name!r} is unknown: {hint} A file of your own is loaded with --effects FILE")


def _variant(effect: Effect, name: str, moved: str) -> Effect:
    """Return the variant that a name means, where it is that variant's own."""
    parameters: dict[str, float] = {}
    for part in moved.split(","):
        parameter, _, value = part.partition("=")
        try:
            parameters[parameter] = float(value)
        except ValueError as error:
            raise EffectError(
                f"effect {name!r}: {value!r} is no number: write {effect.name}@parameter=value"
            ) from error
    found = effect.variant(parameters)
    if found.name != name:
        raise EffectError(f"effect {name!r} is known as {found.name!r}: write that")
    return found


def load_file(path: str | Path, time_limit: float = TIME_LIMIT) -> list[Effect]:
    """Check a user's own file of effects and add them to the library.

    The file is Python and importing it runs it, as its author's own code: once in a process apart, under a time limit,
    where every effect is checked, and, if all is well, once here. That process guards against mistakes; it is no
    sandbox.

    Parameters
    ----------
    path : str or Path
        A `.py` file with functions under `@effect`, from `core.effects`. Loading it again replaces what it brought
        before.
    time_limit : float
        For import and checks together. [s]

    Returns
    -------
    list of Effect
        In the order of the file.

    Raises
    ------
    EffectError
        One line that begins with the path: the file is absent or a folder, is not Python, imports what an effect does
        not need, does not come to an end, holds no effect, defines a name twice or one that is taken, holds an effect
        that fails `check`, or one said to be confused with an effect that is unknown.
    """
    path = Path(path).absolute()
    source = _read(path)
    _check_source(path, source)
    _check_apart(path, time_limit)
    effects = _run(path)
    for found in effects:
        if found.name in _library and _brought_by.get(found.name) != path:
            raise EffectError(f"{path}: effect {found.name!r} is in the library already: give yours another name")
    _check_confusions(path, effects)
    for name in [name for name, file in _brought_by.items() if file == path]:
        del _library[name], _brought_by[name]
    for found in effects:
        _library[found.name], _brought_by[found.name] = found, path
    return effects


def _check_confusions(path: Path, effects: list[Effect]) -> None:
    """Refuse a confusion with an effect that is neither in the library nor in the file."""
    known = {*_library, *(found.name for found in effects)}
    for found in effects:
        if unknown := [name for name in found.confused_with if name not in known]:
            close = get_close_matches(unknown[0], known, n=3)
            hint = f": did you mean {' or '.join(close)}?" if close else ""
            raise EffectError(f"{path}: effect {found.name}: confused with {unknown[0]!r}, which is unknown{hint}")


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not UTF-8 text"
        raise EffectError(f"{path}: cannot read effects: {reason}; name a Python file") from error


def _check_source(path: Path, source: str) -> None:
    """Look at the file without running it: its syntax, what it imports, and names defined twice."""
    try:
        tree = ast.parse(source, filename=str(path))
    except (SyntaxError, ValueError) as error:  # ValueError: null bytes
        line = getattr(error, "lineno", None) or 1
        raise EffectError(f"{path}:{line}: not Python: {getattr(error, 'msg', error)}") from error
    for node in ast.walk(tree):
        modules = [a.name for a in node.names] if isinstance(node, ast.Import) else []
        if isinstance(node, ast.ImportFrom):
            modules = ["." * node.level + (node.module or "")]
        for module in modules:
            if module.partition(".")[0] not in ALLOWED_IMPORTS:
                allowed = ", ".join(sorted(ALLOWED_IMPORTS))
                raise EffectError(f"{path}:{node.lineno}: imports {module}; an effect needs no more than {allowed}")  # type: ignore[attr-defined]
        called = node.func.id if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) else ""
        if called in FORBIDDEN_CALLS:
            raise EffectError(f"{path}:{node.lineno}: calls {called}; an effect is a function of its columns alone")  # type: ignore[attr-defined]
    names = Counter(node.name for node in tree.body if isinstance(node, ast.FunctionDef))
    if twice := [name for name, times in names.items() if times > 1]:
        raise EffectError(f"{path}: {twice[0]!r} is defined twice, and the second hides the first: rename one")


def _check_apart(path: Path, time_limit: float) -> None:
    """Run and check the file in a process of its own, which can be ended where the file does not come to an end."""
    command = [
        sys.executable,
        "-c",
        "import sys; from core.effects.registry import _inspect; _inspect(sys.argv[1])",
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
            f"{path}: not done after {time_limit:g} s: look for a loop without end, or work done at import"
        ) from error
    if done.returncode:
        said = done.stderr.strip().splitlines() or [f"the interpreter stopped with code {done.returncode}"]
        raise EffectError(said[-1] if said[-1].startswith(str(path)) else f"{path}: {said[-1]}")


def _inspect(name: str) -> None:
    """Run and check a file, in the process apart; what is wrong goes to stderr as its last line."""
    path = Path(name)
    try:
        for found in _run(path):
            try:
                check_effect(found)
            except EffectError as error:
                raise EffectError(f"{path}: {error}") from error
    except EffectError as error:
        sys.exit(f"\n{error}")


def _run(path: Path) -> list[Effect]:
    """Run a file and return the effects that it defines, in its order."""
    try:
        names = runpy.run_path(str(path), run_name=_USER_MODULE)
    except EffectError as error:
        raise EffectError(f"{path}: {error}") from error
    except (Exception, SystemExit) as error:  # whatever a user's file raises
        lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
        said = " ".join(str(error).split())
        where = f"{path}:{lines[-1]}" if lines else f"{path}"
        raise EffectError(f"{where}: raises {type(error).__name__} when imported: {said}") from error
    found = {id(e): e for e in names.values() if isinstance(e, Effect) and e.function.__module__ == _USER_MODULE}
    if not found:
        raise EffectError(f"{path}: holds no effect: put @effect(...), from core.effects, over a function of columns")
    return list(found.values())
