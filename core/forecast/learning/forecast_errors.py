"""What became of forecasts: each is held against the charge that the shift ended with, and learned from.

Every ten minutes of a shift its forecast is noted. When the shift has ended, as planned or in silence, the errors over
the forecasts' own standard deviations go to `core.forecast.conformal`. A forecast with a charge between it and the end is
not held against anything: no plan tells of it. Nor is one that is below empty: cars stop there, and what they would
have taken beyond it nobody knows. It is left out whatever became of it: to keep those that proved wrong would keep
errors of one side.
"""

from math import nan
from struct import Struct
from typing import Any, Final, NamedTuple

import numpy as np

from core.batch import Floats, grown

NOTE_S: Final = 600.0
"""Time between two forecasts of a car that are noted. [s]"""
LAST_S: Final = 30.0
"""Time before the shift's end at which the last one is noted. [s]"""
LEAN_PRIOR: Final = 1.0
"""Charge taken as foretold that stands for what is not known of forecasts: some eight shifts'. [1]"""
LEAN_MEMORY: Final = 0.998
"""What a shift still counts a shift later."""
LEAN_LIMITS: Final = 0.7, 1.4
"""Farthest from what is foretold. [1]"""


class Note(NamedTuple):
    """A forecast: when it was made, for when [s], by plan (0) or habit (1), how far ahead, and what it says.

    Of the charge `soc` that there was, `lean` stands for what earlier forecasts were found to be short by, see `Lean`.
    """

    time: float
    end: float
    kind: int
    far_km: float
    ambient_c: float
    mean: float
    sd: float
    soc: float = nan
    lean: float = 1.0


_PACKED: Final = Struct(f"{len(Note._fields)}d")
_END: Final = Note._fields.index("end")
_KIND: Final = Note._fields.index("kind")
_MEAN: Final = Note._fields.index("mean")


class Judged(NamedTuple):
    """Standardised errors of the forecasts of one shift of one kind, (n,) each; charge taken and foretold. [1]"""

    kind: int
    far_km: Floats
    ambient_c: Floats
    scores: Floats
    taken: Floats
    foretold: Floats


class Lean:
    """By how much more shifts take than is foretold of what is ahead, on average.

    What makes a shift as a whole agree with what was predicted of it (`core.forecast.scales`) may still be early or
    late in it: cars warm up at the beginning. So what forecasts of the rest were short by is learned of
    forecasts.

    Attributes
    ----------
    factor : (kinds,) float
        Of the energy ahead, by plan and by habit. [1]
    """

    def __init__(self) -> None:
        self._sums = np.full((2, 2), LEAN_PRIOR)
        self.factor = np.ones(2)

    def learn(self, errors: Judged) -> None:
        """Learn from a shift's forecasts, together as much as one."""
        sums = np.array([errors.taken.mean(), errors.foretold.mean()])
        if np.isfinite(sums).all() and sums[1] > 0.0:
            self._sums[errors.kind] = LEAN_PRIOR + LEAN_MEMORY * (self._sums[errors.kind] - LEAN_PRIOR) + sums

    def settle(self) -> None:
        """Make factors of what was learned."""
        self.factor = np.clip(self._sums[:, 0] / self._sums[:, 1], *LEAN_LIMITS)

    def dump(self) -> Any:
        """Return the state as plain lists."""
        return self._sums.tolist(), self.factor.tolist()

    def load(self, state: Any) -> None:
        """Take up a state that `dump` returned."""
        self._sums, self.factor = (np.array(part, dtype=np.float64) for part in state)


class ShiftLog:
    """Notes of the shifts in progress."""

    def __init__(self) -> None:
        self._notes: dict[int, bytearray] = {}  # of each lane, `Note` after `Note`
        self._next = np.zeros(0)
        self._ends = np.zeros(0)

    def grow(self, lanes: int) -> None:
        """Have room for so many lanes."""
        self._next = grown(self._next, lanes)
        self._ends = grown(self._ends, lanes, np.inf)

    def due(self, lane: Any, time: Any, mean: Any = 0.0) -> Any:
        """Tell at which rows, in order, a note of a mean is due or a noted forecast has come to its end, (n,) bool."""
        return ((time >= self._next[lane]) & np.isfinite(mean)) | (time >= self._ends[lane])

    def note(self, lane: int, note: Note) -> None:
        """Note a forecast, unless the last one was just now."""
        if note.time >= self._next[lane] and np.isfinite(note.mean):
            self._notes.setdefault(lane, bytearray()).extend(_PACKED.pack(*note))
            last = note.end - LAST_S
            self._next[lane] = min(note.time + NOTE_S, last) if last > note.time else note.time + NOTE_S
            self._ends[lane] = min(self._ends[lane], note.end)

    def ended(self, lane: int, time: float, soc: float, charged: float) -> list[Judged]:
        """Judge the forecasts of a lane for ends up to a time by the charge that is reported then."""
        if not time >= self._ends[lane]:
            return []
        notes = self.notes(lane)
        left = notes[notes[:, _END] > time]
        self._notes[lane] = bytearray(left.tobytes())
        self._ends[lane] = left[:, _END].min(initial=np.inf)
        return judged(notes[notes[:, _END] <= time], soc, charged)

    def closed(self, lane: int, soc: float, charged: float) -> list[Judged]:
        """Judge what is left of a shift that is over."""
        notes = self.notes(lane)
        self._notes.pop(lane, None)
        self._next[lane], self._ends[lane] = 0.0, np.inf
        return judged(notes, soc, charged)

    def notes(self, lane: int) -> Floats:
        """Return the notes of a lane, (n, len(Note._fields))."""
        return np.frombuffer(bytes(self._notes.get(lane, b""))).reshape(-1, len(Note._fields))

    def dump(self) -> Any:
        """Return the state as plain values."""
        return list(self._notes.items()), self._next.tobytes(), self._ends.tobytes()

    def load(self, state: Any) -> None:
        """Take up a state that `dump` returned."""
        notes, following, ends = state
        self._notes = {int(lane): bytearray(own) for lane, own in notes}
        self._next, self._ends = np.frombuffer(following).copy(), np.frombuffer(ends).copy()


def judged(notes: Floats, soc: float, charged: float) -> list[Judged]:
    """Return the standardised errors of forecasts by kind, but for those before a charge and those below empty.

    Parameters
    ----------
    notes : (n, len(Note._fields)) float
    soc : float
        As it turned out. [1]
    charged : float
        When the car charged last; NaN for never. [s]
    """
    if not np.isfinite(soc):
        return []
    good = notes[~(charged >= notes[:, 0]) & (notes[:, _MEAN] >= 0.0)]
    out = []
    for own in (good[good[:, _KIND] == kind] for kind in np.unique(good[:, _KIND])):
        _, _, kind, far_km, ambient, mean, sd, began, lean = own.T
        out.append(Judged(int(kind[0]), far_km, ambient, (soc - mean) / sd, began - soc, (began - mean) / lean))
    return out
