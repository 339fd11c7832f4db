"""Declare physical effects, load them from files and look them up."""

from pathlib import Path

from socast.core import effects as _effects
from socast.core.effects import Effect, Parameter, check_effect, effect
from socast.core.effects import get as get_effect

__all__ = ["Effect", "Parameter", "check_effect", "effect", "get_effect", "list_effects", "load_effects"]


def list_effects() -> list[Effect]:
    """Return every effect that is known: the product's own, then those loaded from files.

    Returns
    -------
    list of Effect
        In the order of the library.

    Examples
    --------
    >>> [effect.name for effect in list_effects()][:3]
    ['rolling', 'climbing', 'climbing_up']
    """
    return list(_effects.get_library().values())


def load_effects(path: str | Path) -> list[Effect]:
    """Check a Python file of effects and add its effects to the library.

    The file is run as its author's own code: first in a separate process under a time limit, where every effect is
    checked, then in this process. The separate process guards against mistakes; it is not a sandbox.

    Parameters
    ----------
    path : str or Path
        A `.py` file with functions under `@effect`. Loading it again replaces the effects that it defined before.

    Returns
    -------
    list of Effect
        In the order of the file.

    Raises
    ------
    EffectError
        Where the file cannot be read or run, or an effect fails its check. The message begins with the path.
    """
    return _effects.load_file(path)
