"""Find samples that were lost on the way, by the numbers that advanced publishers give their samples."""

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, Final

MOST_PUBLISHERS: Final = 1 << 17
"""Largest number of publishers that are remembered; the next sample of a forgotten one may have any number."""


class SampleGaps:
    """Count the samples that are missing between those that arrive of each publisher, or ask for them.

    Attributes
    ----------
    missed : int
        Number of samples that publishers sent and nobody could get.
    """

    def __init__(self) -> None:
        self.missed = 0
        self._newest: dict[tuple[int, str], int] = {}  # number of a key, publisher -> number of its newest sample
        self._asked: dict[tuple[int, str], int] = {}  # the same -> sample up to which was asked

    def forget(self) -> None:
        """Forget all publishers, as keys are numbered anew."""
        self._newest.clear()
        self._asked.clear()

    def find(self, keys: Sequence[int], samples: Sequence[Any], ask: Callable[[Any, int], bool]) -> bool:
        """Look at n samples with the numbers of their keys; return whether some must wait.

        The last sample of a key tells that all of a single publisher have come. `ask` asks for the samples of a
        publisher from a number up to a given sample, and returns whether this has to wait for them.
        """
        counts, odd, waiting = Counter(keys), set[int](), set[tuple[int, str]]()
        for key, sample in dict(zip(keys, samples, strict=True)).items():
            if (source := sample.source_info) is not None:
                whose, number = (key, str(source.source_id)), source.source_sn
                if self._newest.get(whose) == number - counts[key]:
                    self._newest[whose] = number
                else:
                    odd.add(key)
        for key, sample in zip(keys, samples, strict=True) if odd else ():
            if key not in odd or (source := sample.source_info) is None:
                continue
            whose, number = (key, str(source.source_id)), source.source_sn
            newest = self._newest.get(whose, number - 1)
            if whose in waiting:
                continue
            if number > max(newest + 1, self._asked.get(whose, 0)) and ask(sample, newest + 1):
                self._asked[whose] = number
                waiting.add(whose)
            else:
                self.missed += max(0, number - newest - 1)
                self._newest[whose] = max(number, newest)
        if len(self._newest) > MOST_PUBLISHERS:
            self.forget()
        return bool(waiting)
