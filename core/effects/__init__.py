"""Physical effects: power as a function of signals, each with one coefficient.

This package's own names are what other packages and users' files import.
"""

from core.effects.declaration import Effect, Parameter, effect
from core.effects.registry import CANDIDATES, get, library, load_file, tabulated, topics
from core.effects.verification import check

__all__ = ["CANDIDATES", "Effect", "Parameter", "check", "effect", "get", "library", "load_file", "tabulated", "topics"]
