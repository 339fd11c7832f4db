"""Test the meters of a car: frozen currents, and a state of charge that freezes or jumps."""

import numpy as np
import pytest

from socast.core.cleaning.kernel import Cleaner
from socast.core.cleaning.quality import Quality
from socast.core.settings import Settings
from tests.support.telemetry import PERIOD, cleaned, count, decoded, drive, telemetry, without

N = 400
CAPACITY = 24.0 * 3.6e6
FAULTS = Quality.SOC_JUMP | Quality.SOC_FROZEN | Quality.POWER_FROZEN


def metered(quantum=0.5, seed=2, n=N):
    """Return a drive with voltage and current that follow the speed, and the charge that they use, in per cent."""
    columns = drive(n, seed=seed, battery_voltage_v=360.0)
    columns["battery_current_a"] = 4.0 + 0.9 * columns["speed_kmh"]
    used = np.cumsum(360.0 * columns["battery_current_a"]) * PERIOD / CAPACITY
    columns["soc_pct"] = np.floor((80.0 - 100.0 * used) / quantum) * quantum
    return columns


def clean(columns, capacity=CAPACITY):
    """Return the cleaned samples of a car of known capacity."""
    return Cleaner(Settings()).clean(decoded(telemetry(columns)), 1, capacity)


@pytest.mark.parametrize("quantum", [0.1, 0.5, 1.0])
@pytest.mark.parametrize("scale", [0.65, 1.0, 1.3])
def test_healthy_meters_of_any_quantum_and_yield_have_no_fault(quantum, scale):
    assert count(clean(metered(quantum), CAPACITY * scale), FAULTS) == 0


def test_charge_that_stays_while_power_is_drawn_is_frozen_until_it_moves():
    columns = metered()
    columns["soc_pct"][100:300] = columns["soc_pct"][100]
    bits = clean(columns).quality & Quality.SOC_FROZEN
    rows = np.flatnonzero(bits)
    assert rows[-1] == 300  # the step that ends it says nothing of its own window
    assert np.array_equal(rows, np.arange(rows[0], 301))
    used = np.cumsum(360.0 * columns["battery_current_a"])[[99, rows[0]]] * PERIOD
    assert np.diff(used)[0] == pytest.approx(0.04 * CAPACITY, rel=0.2)


def test_frozen_charge_is_not_seen_without_capacity_or_without_power():
    columns = metered()
    columns["soc_pct"][100:300] = columns["soc_pct"][100]
    assert count(cleaned(columns), Quality.SOC_FROZEN) == 0
    columns["battery_current_a"][:] = np.nan
    assert count(clean(columns), Quality.SOC_FROZEN) == 0


@pytest.mark.parametrize("change", [-8.0, -4.0, 4.0, 8.0])
def test_jump_that_power_contradicts_is_marked_once(change):
    columns = metered(0.1)
    columns["soc_pct"][200:] += change
    assert np.flatnonzero(clean(columns).quality & Quality.SOC_JUMP).tolist() == [200]


@pytest.mark.parametrize(("quantum", "change"), [(0.02, -2.0), (0.5, -25.0), (1.0, -40.0)])
def test_jump_beyond_what_the_car_can_use_is_marked_without_power(quantum, change):
    columns = metered(quantum)
    columns["battery_current_a"][:] = np.nan
    columns["soc_pct"][200:] += change
    assert np.flatnonzero(clean(columns, np.nan).quality & Quality.SOC_JUMP).tolist() == [200]


def test_change_between_two_rides_is_no_jump():
    columns = metered()
    columns["ride_id"][200:] = "r2"
    columns["soc_pct"][200:] += 15.0
    assert count(clean(columns), Quality.SOC_JUMP | Quality.SOC_FROZEN) == 0


def test_change_while_charging_or_over_a_long_silence_is_no_jump():
    columns = metered()
    columns["charging"] = np.zeros(N, bool)
    columns["charging"][150:200] = True
    columns["soc_pct"][200:] += 12.0
    columns["soc_pct"][151:200] += np.linspace(0.0, 12.0, 49).round(1)
    columns["soc_pct"][300:] -= 30.0
    columns["time_s"][300:] += 3600.0
    columns["seq"][300:] += 1200
    assert count(clean(columns), Quality.SOC_JUMP | Quality.SOC_FROZEN) == 0


def test_current_that_stays_the_same_while_the_speed_varies_is_frozen_and_not_metered():
    columns = metered()
    columns["battery_current_a"][100:250] = columns["battery_current_a"][100]
    result = clean(columns)
    rows = np.flatnonzero(result.quality & Quality.POWER_FROZEN)
    assert rows[-1] == 249
    assert 100 < rows[0] < 130
    assert np.all(result.metered[rows] == 0.0)
    assert np.all(result.energy[rows] == 0.0)
    assert result.metered[260] == PERIOD


def test_current_of_zero_over_distance_is_frozen_even_at_constant_speed():
    columns = drive(N, speed=15.0, battery_voltage_v=360.0, battery_current_a=30.0)
    assert count(clean(columns), Quality.POWER_FROZEN) == 0  # a constant power at a constant speed is plausible
    columns["battery_current_a"][200:] = 0.0
    rows = np.flatnonzero(clean(columns).quality & Quality.POWER_FROZEN)
    assert rows[0] == pytest.approx(200 + 300 / (15 * PERIOD), abs=2)
    assert rows[-1] == N - 1


def test_current_of_zero_while_the_car_stands_is_healthy():
    columns = drive(N, speed=0.0, battery_voltage_v=360.0, battery_current_a=0.0)
    assert count(clean(columns), Quality.POWER_FROZEN) == 0


@pytest.mark.parametrize("first", [0.0, 0.5])
def test_charge_from_before_sleep_is_stale_although_it_changed_by_a_quantum_before(first):
    columns = without(drive(N, speed=10.0), "ride_id", "seq")
    columns["soc_pct"] = np.round((80.0 - 0.01 * np.arange(N)) * 2.0) / 2.0
    columns["time_s"][200:] += 9 * 3600.0
    columns["soc_pct"][200:] = np.round((78.0 - 0.01 * np.arange(N - 200)) * 2.0) / 2.0
    columns["soc_pct"][206:] -= first
    columns["soc_pct"][230:] -= 5.0
    assert np.flatnonzero(clean(columns).quality & Quality.SOC_STALE).tolist() == [230]


@pytest.mark.parametrize(("step", "frozen"), [(0.1, True), (2.777, False)])
def test_current_of_a_slow_logger_is_frozen_after_one_stop_if_its_meter_is_fine(step, frozen):
    columns = drive(N, speed=15.0, battery_voltage_v=360.0)
    columns["time_s"] = columns["time_s"][0] + 15.0 * np.arange(N)
    columns["battery_current_a"] = step * (20.0 + np.arange(N) % 7)
    columns["speed_kmh"][200:205] = 54.0, 36.0, 18.0, 0.0, 18.0
    columns["battery_current_a"][200:206] = 22.0 * step
    columns = without(columns, "latitude_deg", "longitude_deg")
    assert (count(cleaned(columns, period=15.0), Quality.POWER_FROZEN) > 0) == frozen


def test_current_that_is_the_same_after_a_night_is_not_frozen():
    columns = metered()
    columns["speed_kmh"][198:203] = 50.0, 50.0, 20.0, 10.0, 0.0
    columns["battery_current_a"][197:203] = 2.0
    columns["latitude_deg"][200:] += 0.01
    columns["time_s"][200:] += 39_000.0
    columns["seq"][200:] += 13_000
    assert count(clean(columns), Quality.POWER_FROZEN) == 0


@pytest.mark.parametrize(("fall", "expected"), [(0.1, 0), (3.0, 1)])
def test_charge_is_stale_by_more_than_the_steps_of_a_fine_display(fall, expected):
    """A fine display falls by one of its steps at any time, also in the first seconds after a night."""
    columns = metered(0.02)
    columns["time_s"][200:] += 39_000.0
    columns["seq"][200:] += 13_000
    columns["soc_pct"][200:203] = columns["soc_pct"][199]
    columns["soc_pct"][203:] -= fall
    result = clean(columns)
    assert count(result, Quality.SOC_STALE) == expected
    assert result.stale_fall.sum() == pytest.approx(0.01 * fall * expected, abs=0.002)


def test_charge_that_is_not_reported_is_held_through_a_short_silence_only():
    columns = without(drive(N, speed=0.0, soc_pct=73.0), "ride_id")  # one idle period, which goes on over the silence
    columns["soc_pct"][200:] = np.nan
    for pause, is_held in ((60.0, True), (900.0, False), (39_000.0, False)):
        later = {name: values.copy() for name, values in columns.items()}
        later["time_s"][200:] += pause
        later["seq"][200:] += int(pause / PERIOD)
        soc = clean(later).soc
        assert np.isfinite(soc[:200]).all()
        assert (np.isfinite(soc[202:]) == is_held).all()  # the sample after a silence waits for the next one


def test_charge_that_is_not_reported_while_the_car_charges_is_unknown_until_the_next_report():
    columns = without(drive(N, speed=0.0, soc_pct=73.0), "ride_id")
    columns["charging"] = np.zeros(N, bool)
    columns["charging"][150:250] = True
    columns["soc_pct"][150:300] = np.nan
    unknown = np.flatnonzero(np.isnan(clean(columns).soc))
    assert unknown.tolist() == list(range(unknown[0], 300))
    assert unknown[0] == pytest.approx(150 + 60.0 / PERIOD, abs=2)
