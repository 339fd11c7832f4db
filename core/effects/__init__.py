"""Physical effects: power as a function of signals, each with one fitted coefficient.

Other packages import the names of this package. Users' files import `effect` and `Parameter` from `socast`.
"""

from socast.core.effects.declaration import Effect, Parameter, effect
from socast.core.effects.registry import (
    CANDIDATES,
    ROAD_LOAD,
    get,
    get_library,
    group_by_topic,
    list_own,
    list_tabulated,
    load_file,
)
from socast.core.effects.verification import check_effect

__all__ = [
    "CANDIDATES",
    "ROAD_LOAD",
    "Effect",
    "Parameter",
    "check_effect",
    "effect",
    "get",
    "get_library",
    "group_by_topic",
    "list_own",
    "list_tabulated",
    "load_file",
]
