"""Tables of leg energy of a vehicle model before its first rides: the official consumption and the climate by physics.

A plan of the first day must have a forecast too. Driving takes the official consumption without charging losses.
Heating, air conditioning and standby take the power of the reference car, as in `socast.core.vehicles`. Until the
tables are learned, the same figures replace the energy that the model predicts, so that the filter compares the
measured energy with the tables of the forecast. Official cycles differ from city traffic, and cars of one model from
each other: most of that is the same for a whole shift, and the first kilometres reveal it.
"""

from typing import Final

import numpy as np

from socast.core.columns import ZERO_CELSIUS
from socast.core.forecast.learning.leg_energy import PACES, TEMPERATURES, LegEnergyTables
from socast.core.vehicles import ACCESSORIES, VehicleModel

DRIVING_SHARE: Final = 0.75
"""Share of the official consumption that driving takes: less charging losses and the accessories of the cycle. [1]

Estimated, as the other figures of this module: the standard deviation below covers what they miss."""
CONSUMPTION_PER_MASS: Final = 1.2e-4
"""Official consumption over kerb mass of the cars in the catalogue, for cars without a rating. [kWh/(km kg)]"""
FIRST_LEVEL_SD: Final = 0.3
"""Standard deviation of the energy of a shift over that of the tables. [1]"""
FIRST_RELATIVE_SD: Final = 0.15
"""Standard deviation of the energy of a part of a shift over the energy at the level of the shift. [1]"""
USUAL_SPEED: Final = 10.0
"""Kilometres of rides in an hour of a shift, idle periods included. [km/h]"""
USUAL_PACE: Final = 2.4
"""Time per kilometre of rides in a city. [min/km]"""
USUAL_PAUSE: Final = 0.25
"""Duration of an idle period. [h]"""
CLIMB_ENERGY_PER_MASS: Final = 3.2e-6
"""Energy of a metre gained over mass: g over the efficiency of the drive of 0.85. [kWh/(m kg)]"""
RECOVERED_CLIMB: Final = 0.6
"""Share of it that returns on the way down. [1]"""


def make_first_tables(model: VehicleModel, accessory_scale: float) -> LegEnergyTables:
    """Return the tables of a vehicle model before its first rides."""
    rated = CONSUMPTION_PER_MASS * model.mass_kg if model.rated_kwh_per_km is None else model.rated_kwh_per_km
    standing = accessory_scale * ACCESSORIES.power(TEMPERATURES + ZERO_CELSIUS) / 1000.0
    hours_per_km = PACES[:, np.newaxis] / 60.0
    usual = DRIVING_SHARE * rated + standing / USUAL_SPEED
    climb = CLIMB_ENERGY_PER_MASS * model.mass_kg
    zeros = np.zeros(len(TEMPERATURES))
    return LegEnergyTables(
        leg_energy_per_km=DRIVING_SHARE * rated + hours_per_km * standing,
        climbed_per_km=np.zeros(len(PACES)),
        descended_per_km=np.zeros(len(PACES)),
        climb_energy=climb,
        descent_energy=-RECOVERED_CLIMB * climb,
        start_energy=0.0,
        standing_power=standing,
        approach_energy=zeros,
        ride_factor=zeros,
        ride_power=standing,
        idle_factor=zeros,
        idle_power=standing,
        energy_per_km=usual,
        mean_power=USUAL_SPEED * usual,
        relative_sd=np.full(len(TEMPERATURES), FIRST_RELATIVE_SD),
        mean_pause=USUAL_PAUSE,
        ride_pace=USUAL_PACE,
        driven_energy_per_km=DRIVING_SHARE * rated,
        level_sd=FIRST_LEVEL_SD,
    )
