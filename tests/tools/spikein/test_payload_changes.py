"""Only the number of a sample changes in its message."""

import pyarrow as pa
import pytest

from socast.core.wire.arrow_batch import write_rows
from socast.tools.spikein.payload_changes import change_payload

CURRENT = "battery_current_a"


def test_other_bytes_of_a_sample_stay():
    payload = b'{ "time_s":1.70e9,"battery_current_a" : 20, "own": {"battery": 1.50}, "soc_pct": 55.50}'
    assert change_payload(payload, CURRENT, {0: 0.25}) == payload.replace(b" 20,", b" 20.25,")


def test_samples_of_a_list_change_by_their_places():
    payload = b'[{"ride_id": "a}\\"{", "battery_current_a": 1.5},\n {"battery_current_a": -2}, {"soc_pct": 3}]'
    changed = change_payload(payload, CURRENT, {1: -0.5, 2: 1.0})
    assert changed == payload.replace(b"-2", b"-2.5")


@pytest.mark.parametrize("kind", [pa.float32(), pa.float64(), pa.int16()])
def test_rows_of_a_batch_change_by_their_places(kind):
    table = pa.table(
        {
            "vehicle_id": ["a", "b", "c"],
            "time_s": [1.0, 2.0, 3.0],
            CURRENT: pa.array([10, None, 30], kind),
            "own": ["x", "y", "z"],
        }
    )
    with pa.ipc.open_stream(change_payload(write_rows(table), CURRENT, {0: 0.5, 1: 0.5})) as reader:
        changed = reader.read_all()
    assert changed.column(CURRENT).to_pylist() == [10.5, None, 30.0]
    assert changed.drop_columns([CURRENT]).equals(table.drop_columns([CURRENT]))


def test_message_without_the_field_stays():
    assert change_payload(b'{"soc_pct": 5}', CURRENT, {0: 1.0}) == b'{"soc_pct": 5}'
