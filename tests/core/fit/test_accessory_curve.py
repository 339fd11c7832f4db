"""Test that the fit of the accessory curve recovers planted choke points and levels."""

import numpy as np
import pytest

from socast.core.columns import ZERO_CELSIUS
from socast.core.fit.accessory_curve import TemperatureBins, compute_slopes
from socast.core.fit.recipes import RECIPES
from socast.core.vehicles import ACCESSORIES, AccessoryCurve
from tests.support.planted_rides import noisy, physical_energy, rides

MODEL = ("kia-soul-ev-2015",)


def planted(*knots: float, levels: tuple[float, float, float] = (3500.0, 400.0, 1500.0)) -> AccessoryCurve:
    return AccessoryCurve(*(ZERO_CELSIUS + t for t in knots), *levels)


def choke_points(curve) -> np.ndarray:
    points = (curve.heating_full, curve.heating_off, curve.cooling_on, curve.cooling_full)
    return np.array(points) - ZERO_CELSIUS


def levels(curve) -> np.ndarray:
    return np.array([curve.heating, curve.standby, curve.cooling])


def still_air(table, curve) -> np.ndarray:
    """Return the energy by the extended physical model, which ignores the wind. [kWh]"""
    wind = (table["effect_aero_drag_wind"] - table["effect_aero_drag"]) * table["drag_area_m2"]
    return physical_energy(table, curve=curve) - wind.to_numpy()


CURVES = (
    planted(-15.0, 10.0, 18.0, 26.0),
    planted(-20.0, 12.0, 21.0, 27.5),
    planted(-5.0, 15.0, 20.0, 25.0, levels=(5000.0, 250.0, 2500.0)),
    planted(-22.5, -2.0, 12.0, 24.0, levels=(2500.0, 600.0, 1200.0)),
)


@pytest.mark.parametrize("curve", CURVES, ids=lambda c: str(choke_points(c).tolist()))
def test_planted_choke_points_are_recovered_within_one_degree(curve):
    table = rides(12_000, seed=4, models=MODEL)
    made = noisy(table, still_air(table, curve), of_day=0.0)
    fitted = RECIPES["extended_physical"].fit(made, covariance=False).fits["*"].curve
    assert np.abs(choke_points(fitted) - choke_points(curve)).max() < 1.0
    np.testing.assert_allclose(levels(fitted), levels(curve), rtol=0.05, atol=20.0)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_choke_points_are_recovered_together_with_a_road_load_with_drivetrain_losses(seed):
    table = rides(12_000, seed=seed, models=MODEL)
    lossy = {"rolling": 1.4, "aero_drag_wind": 1.15, "climbing": 0.9}
    made = noisy(table, physical_energy(table, lossy, CURVES[1]), seed=seed + 10, of_day=0.004)
    model = RECIPES["fitted_physical"].fit(made, covariance=False)
    fitted = model.fits["*"].curve
    assert np.abs(choke_points(fitted) - choke_points(CURVES[1])).max() < 1.0
    np.testing.assert_allclose(levels(fitted), levels(CURVES[1]), rtol=0.08, atol=60.0)
    assert model.fits["*"].coefficients[0] == pytest.approx(1.4, abs=0.1)


def test_choke_points_are_recovered_closely_without_noise():
    table = rides(4000, seed=6, models=MODEL)
    made = table.assign(energy_kwh=still_air(table, CURVES[0]))
    fitted = RECIPES["extended_physical"].fit(made, covariance=False).fits["*"].curve
    assert np.abs(choke_points(fitted) - choke_points(CURVES[0])).max() < 0.1
    np.testing.assert_allclose(levels(fitted), levels(CURVES[0]), rtol=0.01)


def temperatures(curve, n=5000, low=-30.0, high=30.0, seed=0, noise=0.02) -> TemperatureBins:
    rng = np.random.default_rng(seed)
    ambient, time = rng.uniform(low, high, n), rng.uniform(100.0, 2000.0, n) / 3.6e6
    bins = TemperatureBins()
    for part in np.array_split(np.arange(n), 3):
        power = curve.power(ambient[part] + ZERO_CELSIUS)
        bins.add(ambient[part], time[part], time[part] * power + rng.normal(0.0, noise, len(part)))
    return bins


def test_curve_is_independent_of_blocks_of_rides_and_of_repeated_fits():
    assert temperatures(CURVES[0]).fit() == temperatures(CURVES[0]).fit()
    rng = np.random.default_rng(1)
    ambient, time, energy = rng.uniform(-30, 30, 900), rng.random(900), rng.random(900)
    whole, parts = TemperatureBins(), TemperatureBins()
    whole.add(ambient, time, energy)
    for part in np.array_split(np.arange(900), 7):
        parts.add(ambient[part], time[part], energy[part])
    np.testing.assert_allclose(parts.sums, whole.sums, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(("low", "high"), [(-30.0, 5.0), (14.0, 30.0), (-3.0, 9.0), (16.0, 19.0), (20.0, 20.0)])
def test_curve_is_valid_where_rides_do_not_cover_every_segment(low, high):
    fitted = temperatures(CURVES[0], low=low, high=high).fit()
    points = choke_points(fitted)
    assert (np.diff(points) > 0.0).all()
    assert (levels(fitted) >= 0.0).all()
    seen = np.linspace(low, high, 20) + ZERO_CELSIUS
    np.testing.assert_allclose(fitted.power(seen), CURVES[0].power(seen), atol=400.0)


def test_one_temperature_scales_the_reference_curve():
    fitted = temperatures(ACCESSORIES, low=0.0, high=0.0, noise=0.0).fit()
    assert choke_points(fitted) == pytest.approx(choke_points(ACCESSORIES))
    np.testing.assert_allclose(levels(fitted), levels(ACCESSORIES), rtol=1e-9)


def test_few_rides_scale_the_reference_curve_even_with_a_zero_road_load():
    rng = np.random.default_rng(8)
    ambient, time = rng.uniform(-20.0, 25.0, 300), rng.uniform(0.5, 1.0, 300) / 3600.0
    energy = 1.5 * time * ACCESSORIES.power(ambient + ZERO_CELSIUS)
    for rides_, exact in ((60, True), (300, False)):
        bins = TemperatureBins(beside=2)
        flat = np.zeros(rides_)
        bins.add(ambient[:rides_], time[:rides_], energy[:rides_], [flat, flat])
        curve = bins.fit()
        assert (curve.heating_full == ACCESSORIES.heating_full) == exact
        seen = curve.power(ambient + ZERO_CELSIUS)
        np.testing.assert_allclose(seen, 1.5 * ACCESSORIES.power(ambient + ZERO_CELSIUS), rtol=0.02)


def test_rides_without_temperature_keep_the_reference_curve():
    nothing = TemperatureBins()
    nothing.add(np.array([np.nan]), np.ones(1), np.ones(1))
    assert levels(nothing.fit()) == pytest.approx(levels(ACCESSORIES))


def test_levels_are_never_negative():
    cold = TemperatureBins()
    rng = np.random.default_rng(3)
    ambient = rng.uniform(-30.0, 30.0, 500)
    cold.add(ambient, np.full(500, 1e-4), -0.1 * np.ones(500))
    assert (levels(cold.fit()) >= 0.0).all()


@pytest.mark.parametrize("number", range(7))
def test_slopes_equal_numerical_derivatives(number):
    curve = AccessoryCurve(
        heating_full=258.15, heating_off=283.15, cooling_on=291.15, cooling_full=299.15,
        heating=3500.0, standby=400.0, cooling=1500.0,
    )  # fmt: skip
    ambient = np.linspace(-29.7, 29.8, 200)
    h = 1e-4
    above, below = (moved(curve, number, by).power(ambient + ZERO_CELSIUS) for by in (h, -h))
    np.testing.assert_allclose(compute_slopes(curve, ambient)[:, number], (above - below) / (2.0 * h), atol=1e-4)


def moved(curve: AccessoryCurve, number: int, by: float) -> AccessoryCurve:
    """Return the curve with one of its numbers changed; heating and cooling count above standby."""
    standby, heat, cool = curve.standby, curve.heating - curve.standby, curve.cooling - curve.standby
    numbers = [standby, heat, cool, curve.heating_full, curve.heating_off, curve.cooling_on, curve.cooling_full]
    numbers[number] += by
    standby, heat, cool, *points = numbers
    return AccessoryCurve(*points, standby + heat, standby, standby + cool)
