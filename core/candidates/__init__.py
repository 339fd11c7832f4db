"""Candidate effects: what consumption may be made of beyond the base, one file a topic.

Each is what its phenomenon adds to the base effects of `core.road_load`, in the textbook's form, so that diagnosis can
ask of the data whether it is there. A plausible range that begins above zero says that physics demands the sign.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from core.candidates.air import AIR
from core.candidates.battery import BATTERY
from core.candidates.cabin import CABIN
from core.candidates.electrics import ELECTRICS
from core.candidates.powertrain import POWERTRAIN
from core.candidates.tyres import TYRES
from core.declaration import Effect

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
"""Topic -> its effects."""
