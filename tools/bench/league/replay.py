"""Check that the league gives the same bytes however its stream is cut: live operation equals replay."""

from collections.abc import Sequence
from typing import Final

import numpy as np
import pandas as pd

from socast.core.pipeline import Pipeline
from socast.core.wire.messages import Message
from socast.tools.bench.league.fleet import choose_faults, make_entry, write_stream

LARGEST: Final = 3000
"""Largest number of messages of a chunk."""


def find_difference(seed: int, cars: Sequence[int], names: Sequence[str] = ()) -> str:
    """Return what depends on how the stream of some cars is cut: forecasts, rides, windows or counts; '' if nothing."""
    messages = write_stream([make_entry(seed, number, choose_faults(seed, number, names)) for number in cars])
    rng = np.random.default_rng([seed, 2])
    for live in (True, False):
        whole, expected = _run(messages, [len(messages)], live=live)
        sizes = np.ceil(np.exp(rng.uniform(0.0, np.log(LARGEST), len(messages)))).astype(int)
        parts, found = _run(messages, np.cumsum(sizes).tolist(), live=live)
        if found != expected:
            return "forecasts"
        for name in ("take_rides", "take_windows"):
            if not _are_equal(getattr(whole, name)(), getattr(parts, name)()):
                return name.removeprefix("take_")
        if whole.quality() != parts.quality():
            return "counts"
    return ""


def _run(messages: Sequence[Message], cuts: Sequence[int], *, live: bool) -> tuple[Pipeline, list[Message]]:
    """Return the pipeline that has taken messages in chunks, and its forecasts."""
    pipeline = Pipeline(keep_forecasts=live, two_sided=not live)
    out, at = list[Message](), 0
    for cut in cuts:
        if at < len(messages):
            out += pipeline.push(messages[at:cut])
            at = cut
    return pipeline, out + pipeline.finish()


def _are_equal(one: pd.DataFrame, other: pd.DataFrame) -> bool:
    """Return whether two tables are equal to the bit."""
    return one.equals(other) and list(one.columns) == list(other.columns)
