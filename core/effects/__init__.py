"""Physical effects: power as a function of signals, each with one fitted coefficient.

Other packages import the names of this package. Users' files import `effect` and `Parameter` from `socast`.
"""

from core.effects.declaration import Effect, Parameter, effect
from core.effects.registry import CANDIDATES, get, get_library, group_by_topic, list_tabulated, load_file
from core.effects.verification import check_effect

__all__ = [
    "CANDIDATES",
    "Effect",
    "Parameter",
    "check_effect",
    "effect",
    "get",
    "get_library",
    "group_by_topic",
    "list_tabulated",
    "load_file",
]
