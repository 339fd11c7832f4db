"""Test batches and lanes."""

import numpy as np
import pytest

from socast.core.batch import Lanes, grown, sum_weighted
from tests.support.telemetry import decoded, drive, telemetry


def test_lanes_are_numbered_in_order_of_first_appearance():
    lanes = Lanes(["x"])
    assert [lanes.lane(name) for name in ("b", "a", "b", "x", "a")] == [1, 2, 1, 0, 2]
    assert lanes.names == ["x", "b", "a"]
    assert len(lanes) == 3


def test_rows_are_a_view_of_the_batch():
    batch = decoded(telemetry(drive(10)))
    part = batch.rows(3, 7)
    assert part.size == 4
    assert all(np.shares_memory(whole, view) for whole, view in zip(batch, part, strict=True))
    assert np.array_equal(part.stamp, batch.stamp[3:7])


def test_grown_array_keeps_its_values_and_fills_the_new_rows():
    array = np.arange(6.0).reshape(3, 2)
    assert grown(array, 3) is array
    larger = grown(array, 4, -1.0)
    assert larger.shape == (4, 2)
    assert np.array_equal(larger[:3], array)
    assert np.all(larger[3:] == -1.0)
    assert len(grown(array, 100)) == 128


def test_weighted_sum_of_a_row_does_not_depend_on_the_number_of_rows():
    rng = np.random.default_rng(3)
    values, weights = rng.normal(size=(269, 2, 2)), rng.normal(size=(269, 2))
    together = sum_weighted(sum_weighted(values, weights), weights)
    alone = [sum_weighted(sum_weighted(values[i : i + 1], weights[i : i + 1]), weights[i : i + 1]) for i in range(269)]
    assert together.tobytes() == np.concatenate(alone).tobytes()
    assert together == pytest.approx(np.einsum("np,npq,nq->n", weights, values, weights))
