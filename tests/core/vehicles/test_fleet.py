"""Test the kind of each car at each row."""

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.vehicles import load_catalogue
from socast.core.vehicles.fleet import UNKNOWN, CarParameters, Cars, ReplacedKind
from socast.core.wire.message_order import VehicleChange
from socast.core.wire.messages import Vehicle
from tests.support.telemetry import chunked, drive, leaf, make_message, ran, telemetry


def vehicle(model="nissan-leaf-2013", **fields):
    return Vehicle("a", 0.0, model, **fields)


def report(cars, *messages):
    """Apply one message of each lane, without rows."""
    changes = [VehicleChange(0, lane, message) for lane, message in enumerate(messages)]
    cars.kinds(np.zeros(0, int), changes, len(messages))


def test_only_a_message_that_changes_the_car_replaces_its_kind():
    cars, replaced = Cars(), []
    other = vehicle(mass_kg=1700.0)
    messages = [vehicle(), vehicle(), other, other, vehicle()]
    changes = [VehicleChange(0, 0, message, place) for place, message in enumerate(messages)]
    cars.kinds(np.zeros(0, int), changes, 1, replaced)
    assert replaced == [ReplacedKind(0, 0, UNKNOWN), ReplacedKind(2, 0, 1), ReplacedKind(4, 0, 2)]


@given(st.integers(0, 2**32 - 1))
def test_message_applies_from_its_row_on_and_only_in_its_lane(seed):
    rng = np.random.default_rng(seed)
    lane = rng.integers(0, 4, 50)
    models = list(load_catalogue())
    changes = sorted((int(rng.integers(0, 51)), int(rng.integers(0, 4)), i) for i in range(6))
    messages = [VehicleChange(row, who, vehicle(models[i])) for row, who, i in changes]
    cars = Cars()
    kinds = cars.kinds(lane, messages, 4)
    now = dict.fromkeys(range(4))
    for row in range(50):
        now |= {who: models[i] for at, who, i in changes if at == row}
        assert cars.name(int(kinds[row])) == now[lane[row]]
    now |= {who: models[i] for at, who, i in changes if at == 50}
    assert [cars.name(int(kind)) for kind in cars.of_lane[:4]] == list(now.values())


def test_equal_cars_share_a_kind_and_overrides_make_a_new_one():
    cars = Cars()
    messages = [vehicle(), msgspec.structs.replace(vehicle(), vehicle_id="b", time_s=9.0), vehicle(mass_kg=1700.0)]
    report(cars, *messages)
    assert cars.of_lane[:3].tolist() == [1, 1, 2]
    assert cars.parameters[:, CarParameters._fields.index("mass_kg")][2] == 1700.0


def test_unpredictable_car_is_counted_by_reason_and_keeps_its_model_name():
    cars = Cars()
    report(cars, vehicle("horse"), vehicle(mass_kg=1.0), vehicle("horse"))
    assert dict(cars.unpredictable) == {"unknown_vehicle_model": 2, "override_out_of_range": 1}
    assert cars.name(int(cars.of_lane[0])) == "horse"
    assert cars.name(UNKNOWN) is None
    assert np.isnan(cars.parameters[1:]).all()


def test_loaded_state_equals_the_dumped_state():
    cars = Cars()
    report(cars, vehicle(), vehicle("horse"), vehicle(mass_kg=1700.5))
    loaded = Cars()
    loaded.load(msgspec.msgpack.decode(msgspec.msgpack.encode(cars.dump())))
    assert np.array_equal(loaded.parameters, cars.parameters, equal_nan=True)
    assert np.array_equal(loaded.of_lane, cars.of_lane)
    assert loaded.messages == cars.messages
    assert loaded.unpredictable == cars.unpredictable
    assert loaded.kinds(np.array([2]), [], 3).tolist() == [3]


@pytest.mark.parametrize("cuts", [(), (101,), (100, 102), (51, 53, 101, 150)])
def test_message_within_a_batch_applies_from_its_row_on_for_any_chunking(cuts):
    messages = telemetry(drive(200, speed=10.0))
    messages.insert(100, make_message("vehicle", model="tesla-model-x"))
    messages.insert(50, leaf())
    pipeline, out = ran(messages, cuts)
    assert chunked(messages, cuts)
    whole, expected = ran(messages)
    assert out == expected
    assert pipeline.take_rides().equals(whole.take_rides())
    rolling = pipeline.totals.accumulator
    assert rolling is not whole.totals.accumulator


def test_changed_mass_enters_the_effects_from_its_row_on():
    messages = telemetry(drive(200, speed=10.0))
    light, _ = ran([leaf(), *messages])
    heavy, _ = ran([leaf(mass_kg=2 * 1493.0 + 75.0), *messages])
    both, _ = ran([leaf(), *messages[:100], leaf(mass_kg=2 * 1493.0 + 75.0), *messages[100:]])
    rolling = [p.take_rides()["effect_rolling"][0] for p in (light, both, heavy)]
    assert rolling[0] < rolling[1] < rolling[2]
    assert rolling[1] == pytest.approx((rolling[0] * 99 + rolling[2] * 100) / 199)
