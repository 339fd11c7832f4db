"""Find cars whose samples hold mean powers without saying so, by a pass over their recordings."""

from collections.abc import Collection, Iterable, Sequence
from typing import Final

import numpy as np

from socast.core.batch import Floats, Lanes
from socast.core.columns import KMH
from socast.core.wire.decoder import Decoder
from socast.core.wire.messages import Message
from socast.tools.importers.table.row_messages import ONE_SIDED, measure_span

MOST_SAMPLES: Final = 5000
"""Samples of a car by which its power is judged."""


def find_mean_powers(blocks: Iterable[Sequence[Message]], announced: Collection[str]) -> dict[str, str]:
    """Return a sentence for each car that has a mean power and does not announce what its power covers.

    Parameters
    ----------
    announced : collection of str
        Cars that announce it, whatever it is.
    """
    lanes = Lanes()
    decoder = Decoder(lanes)
    parts: dict[int, list[Floats]] = {}
    counts: dict[int, int] = {}
    for messages in blocks:
        batch, _ = decoder.decode(messages)
        rows = np.column_stack([batch.stamp, batch.speed, batch.voltage * batch.current])
        for lane in np.unique(batch.lane).tolist():
            if counts.get(lane, 0) < MOST_SAMPLES:
                of_car = rows[batch.lane == lane]
                parts.setdefault(lane, []).append(of_car)
                counts[lane] = counts.get(lane, 0) + len(of_car)
    found = {}
    for lane, some in parts.items():
        name = lanes.names[lane]
        times, speed, power = np.concatenate(some)[:MOST_SAMPLES].T
        evidence = None if name in announced else measure_span(times, speed / KMH, power)
        if evidence is not None and evidence.span is not None:
            share = evidence.share if evidence.span == "before" else 1.0 - evidence.share
            found[name] = (
                f"voltage times current is probably the mean over the time {evidence.span} each sample, where "
                f"{share:.0%} of its kinetic power is (limit: {ONE_SIDED[0]:.0%}): announce power_covers "
                f"'{evidence.span}', else the noise of the measured energy is stated too large"
            )
    return found
