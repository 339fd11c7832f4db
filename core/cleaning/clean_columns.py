"""The columns of cleaned telemetry."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Floats, Ints


class Clean(NamedTuple):
    """Hold cleaned telemetry: equally long columns, one row per sample.

    Rejected samples contribute zero time and zero distance.

    Parameters
    ----------
    lane : (n,) int64
        Lane of the vehicle.
    ride : (n,) int64
        Ordinal of the ride in its lane, -1 outside rides.
    window : (n,) int64
        Ordinal of the window in its lane.
    quality : (n,) int64
        Bits of `socast.core.cleaning.quality.Quality`.
    due : (n,) bool
        Whether a forecast is due at this sample.
    time : (n,) float64
        Repaired Unix time. [s]
    dt, travel : (n,) float64
        Time that the row stands for, and time in which its distance was driven. [s]
    distance, climb : (n,) float64
        Distance driven in the step, and change of elevation. [m] `climb` is causal here;
        `socast.core.totals.deferred_rows` replaces it, and `elevation`, by the two-sided estimate.
    causal_climb : (n,) float64
        Change of elevation in the step from fixes up to this row only. [m]
    speed, acceleration : (n,) float64
        Over the step, of the reported speed or of its moving average. [m/s], [m/s^2]
    acceleration_spread : (n,) float64
        Standard deviation of the acceleration within the step; 0 where unknown. [m/s^2]
    wide_speed, wide_acceleration : (n,) float64
        Over the step and the one before, or over the step where that is unknown. [m/s], [m/s^2]
    latitude, longitude, heading, turn_rate : (n,) float64
        Of the last accepted fix. [rad], the last one [rad/s]
    elevation : (n,) float64
        Smoothed elevation. [m]
    elevation_fix : (n,) float64
        Elevation by a new fix; NaN where there is none, or where the receiver repeats the last fix. [m]
    ground, ground_variance : (n,) float64
        Elevation of the map under the fix [m], NaN where it is unknown or the receiver repeats the last fix; variance
        of its error [m^2].
    power : (n,) float64
        Power drawn from the battery at the sample, by voltage times current; NaN where not measured. [W]
    energy, metered : (n,) float64
        Energy drawn from the battery in the step, by voltage times current [J], and the time for which it is known [s].
    energy_variance : (n,) float64
        Variance of that energy, because the power between two samples is unknown. [J^2]
    elapsed, parked, since_charge : (n,) float64
        Time since the ride began, time parked before the ride, time since the car last charged. [s]
    lost : (n,) float64
        Where a ride begins or ends: time before the row that no sample covers. [s]
    mistimed : (n,) float64
        Time by which earlier steps turn out to be wrong with this row. [s]
    unseen : (n,) float64
        Time for which a bridged distance was driven beyond the time that passed. [s]
    disputed : (n,) float64
        Distance that was counted, and that fixes or odometer dispute with this row. [m]
    path, path_run : (n,) float64
        Where a section between two fixes ends: distance of the fixes, and distance counted between them. [m]
    straight, straight_run : (n,) float64
        The same where the road is straight.
    ticked, ticked_run : (n,) float64
        Where the odometer changes: by how much, and distance counted since it changed before. [m]
    slow, slow_run : (n,) float64
        Of a long step of a slow logger: distance by the speeds at its ends, and distance that was counted. [m]
    stop, stopped : (n,) float64
        1 where a stop begins; 1 while the car stands.
    stale_fall : (n,) float64
        Fall of the state of charge of which a report after a pause shows that it is, at least in part, from before. [1]
    soc, soc_step, odometer, battery_temperature, occupants : (n,) float64
        As last reported. [1], [1], [m], [K], [1]
    ambient, hvac, current : (n,) float64
        As reported with the sample, NaN where not. [K], [W], [A]
    speed_scale : (n,) float64
        Factor by which the reported speed was multiplied, 0 for a factor of 1. [1]
    code : (n,) float64
        Code of the ride's name, see `socast.core.wire.rides.RideNames`.
    fix_sd : (n,) float64
        Standard deviation of a fix where fixes alone show the motion, NaN elsewhere. [m] There, tables have the motion
        of `socast.core.cleaning.position_smoother`.
    """

    lane: Ints
    ride: Ints
    window: Ints
    quality: Ints
    due: NDArray[np.bool_]
    time: Floats
    dt: Floats
    travel: Floats
    distance: Floats
    climb: Floats
    causal_climb: Floats
    speed: Floats
    acceleration: Floats
    acceleration_spread: Floats
    wide_speed: Floats
    wide_acceleration: Floats
    latitude: Floats
    longitude: Floats
    heading: Floats
    turn_rate: Floats
    elevation: Floats
    elevation_fix: Floats
    ground: Floats
    ground_variance: Floats
    power: Floats
    energy: Floats
    metered: Floats
    energy_variance: Floats
    elapsed: Floats
    parked: Floats
    since_charge: Floats
    lost: Floats
    mistimed: Floats
    unseen: Floats
    disputed: Floats
    path: Floats
    path_run: Floats
    straight: Floats
    straight_run: Floats
    ticked: Floats
    ticked_run: Floats
    slow: Floats
    slow_run: Floats
    stop: Floats
    stopped: Floats
    stale_fall: Floats
    soc: Floats
    soc_step: Floats
    odometer: Floats
    battery_temperature: Floats
    ambient: Floats
    occupants: Floats
    hvac: Floats
    current: Floats
    speed_scale: Floats
    code: Floats
    fix_sd: Floats
