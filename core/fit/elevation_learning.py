"""Learn a map of elevation from the fixes of a fleet.

A fix is modelled as the elevation of the place, plus the offset of its ride, plus an error. The offset of a ride is
that of the car plus a deviation; both are random effects with mean zero, so the map has the mean datum of the fleet's
loggers. Offsets and places are estimated in turn until they agree (backfitting: Breiman and Friedman, JASA 80 (1985)
580, DOI 10.1080/01621459.1985.10478157). The offsets are shrunk by their variance, which is estimated from the rides
(Henderson's mixed model equations: Robinson, Statistical Science 6 (1991) 15, DOI 10.1214/ss/1177011926). Residuals
beyond `CLIP` standard deviations count as that large, so that gross errors move a place little.

Places come from `core.fit.local_planes`. What it cannot know is chosen on rides that were not used: half of the
days predicts the other half, and the strictness of its intervals, the curvature of the ground and the factor of its
variance are those with the largest likelihood of the fixes. The final map then uses all days.
"""

from collections.abc import Iterable, Sequence
from itertools import product
from typing import Final, NamedTuple

import numpy as np

from core.batch import Batch, Floats, Ints
from core.cleaning.elevation_map import ElevationPlaces
from core.cleaning.kernel import Clean
from core.cleaning.quality import Quality
from core.columns import EARTH_RADIUS, SECONDS_PER_DAY, TELEMETRY
from core.errors import RecordingError
from core.fit.local_planes import SIDE, NodeSums, Planes, choose_bandwidths, fit_planes, group_by_block

SPACING: Final = 20.0
"""Distance between places. [m]"""
BANDWIDTHS: Final = tuple(SPACING * 2.0 ** (0.5 * k) for k in range(8))
"""Bandwidths of the planes, from the distance of places to 226 m. [m]"""
PILOT: Final = 3
"""Place among `BANDWIDTHS` of the one that serves while offsets are estimated."""
ROUNDS: Final = 8
"""Rounds of estimating offsets and places in turn."""
CLIP: Final = 4.0
"""Residual beyond which a fix counts as that far off. [standard deviations]"""
FIRST_FIX_SD: Final = 3.0
"""Standard deviation of a fix that is assumed in the first round. [m]"""
LEAST_FIX_SD: Final = 0.05
"""Least standard deviation of a fix, for loggers that round to 0.1 m. [m]"""
SIGMA: Final = 1.4826
"""Ratio of the standard deviation of a Gaussian to the median of its absolute value. [1]"""
MOVED: Final = 5.0
"""Least distance driven since the sample before. A fix of a standing car repeats the error of the one before it. [m]"""
LARGEST_SD: Final = 3.0
"""Standard uncertainty beyond which a place is not kept: that of SRTM, see `stream.elevation_tiles`. [m]"""
FEWEST_FIXES: Final = 100
"""Number of fixes below which no map is made."""
MOST_FOR_CHOICE: Final = 200_000
"""Number of fixes, evenly spread, on which the free parameters are chosen."""
STRICTNESS: Final = (0.7, 1.0, 1.5, 2.0, 3.0)
"""Candidates of the half-width of the intervals of `choose_bandwidths`. [standard deviations]"""
CURVATURES: Final = (0.0, 5e-5, 1e-4, 2e-4, 5e-4, 1e-3)
"""Candidates of the curvature of the ground. [1/m] Crest curves of city streets have up to 2e-3 (radius 500 m)."""
FACTORS: Final = (1.0, 1.5, 2.0, 3.0, 4.5, 6.5)
"""Candidates of the factor of the variance of a place, as errors of successive fixes are correlated. [1]"""
UNUSABLE: Final = int(
    Quality.DUPLICATE
    | Quality.LATE
    | Quality.POSITION_MISSING
    | Quality.POSITION_JUMP
    | Quality.POSITION_FROZEN
    | Quality.OUT_OF_RANGE
)
"""Quality bits of samples whose fix is not used."""
_ELEVATION: Final = next(column for column in TELEMETRY if column.name == "elevation")


class ElevationFixes(NamedTuple):
    """Fixes from which a map is learned.

    Parameters
    ----------
    latitude, longitude, elevation : (n,) float
        Fixes. [rad], [rad], [m]
    car, ride : (n,) int
        Lane of the car, and ordinal of the ride in the lane.
    day : (n,) int
        Day of Unix time.
    """

    latitude: Floats
    longitude: Floats
    elevation: Floats
    car: Ints
    ride: Ints
    day: Ints


class MapSummary(NamedTuple):
    """Describe how a map was learned.

    Parameters
    ----------
    fixes, rides, cars : int
        Number of fixes that were used, of their rides and of their cars.
    fix_sd : float
        Standard deviation of the error of a fix. [m]
    ride_sd, car_sd : float
        Standard deviations of the offsets of rides to their cars, and of cars to the fleet. [m]
    strictness, curvature, factor : float
        Chosen parameters: see `STRICTNESS` [1], `CURVATURES` [1/m], `FACTORS` [1].
    """

    fixes: int
    rides: int
    cars: int
    fix_sd: float
    ride_sd: float
    car_sd: float
    strictness: float
    curvature: float
    factor: float


def select_fixes(batch: Batch, clean: Clean) -> ElevationFixes:
    """Return the fixes of a batch from which a map can be learned.

    Parameters
    ----------
    batch : Batch
        n rows.
    clean : Clean
        The same rows, cleaned.
    """
    usable = (clean.quality & UNUSABLE) == 0
    usable &= (clean.dt > 0.0) & (clean.distance >= MOVED)
    usable &= np.isfinite(batch.latitude) & np.isfinite(batch.longitude)
    usable &= (batch.elevation >= _ELEVATION.low) & (batch.elevation <= _ELEVATION.high)
    day = np.floor(clean.time[usable] / SECONDS_PER_DAY).astype(np.int64)
    latitude, longitude, elevation = (each[usable] for each in (batch.latitude, batch.longitude, batch.elevation))
    return ElevationFixes(latitude, longitude, elevation, clean.lane[usable], clean.ride[usable], day)


def join_fixes(parts: Iterable[ElevationFixes]) -> ElevationFixes:
    """Return fixes concatenated."""
    return ElevationFixes(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


class _Grid(NamedTuple):
    """The nodes that are nearest to fixes, and the offset of each fix from its node."""

    steps: tuple[float, float]  # of nodes, north and east [rad]
    row: Ints  # of the nodes
    column: Ints
    node: Ints  # of each fix, an index into `row`
    east: Floats  # of the fix [m]
    north: Floats

    @classmethod
    def of(cls, fixes: ElevationFixes) -> "_Grid":
        """Return the grid for fixes; its cells are square at their median latitude."""
        scale = float(np.cos(np.median(fixes.latitude)))
        steps = SPACING / EARTH_RADIUS, SPACING / (EARTH_RADIUS * scale)
        y, x = fixes.latitude / steps[0], fixes.longitude / steps[1]
        row, column, node = _number_pairs(np.rint(y).astype(np.int64), np.rint(x).astype(np.int64))
        return cls(steps, row, column, node, (x - column[node]) * SPACING, (y - row[node]) * SPACING)

    def sum_up(self, elevation: Floats, which: Ints) -> NodeSums:
        """Return the moments of some of the fixes."""
        node, x, y, z = self.node[which], self.east[which], self.north[which], elevation[which]
        values = (np.ones(len(z)), x, y, x * x, x * y, y * y, z, z * x, z * y, z * z)
        moments: Floats = np.stack([np.bincount(node, each, len(self.row)) for each in values])
        some = moments[0] > 0.0
        return NodeSums(self.row[some], self.column[some], moments[:, some])

    def follow(self, value: Floats, east: Floats, north: Floats) -> Floats:
        """Return the elevation at each fix by the planes of the nodes, given as their elevation and slopes."""
        node = self.node
        return np.asarray(value[node] + east[node] * self.east + north[node] * self.north)


def _number_pairs(one: Ints, other: Ints) -> tuple[Ints, Ints, Ints]:
    """Return the different pairs of whole numbers, and the place of each pair among them."""
    low, width = int(other.min()), int(np.ptp(other)) + 1
    key, place = np.unique(one * width + (other - low), return_inverse=True)
    return key // width, key % width + low, place


def learn_elevation(fixes: ElevationFixes) -> tuple[ElevationPlaces, MapSummary]:
    """Return a map of the places near the fixes of a fleet, and how it was learned.

    Parameters
    ----------
    fixes : ElevationFixes
        n fixes.

    Raises
    ------
    RecordingError
        If there are fewer than `FEWEST_FIXES`.
    """
    if len(fixes.elevation) < FEWEST_FIXES:
        raise RecordingError(
            f"{len(fixes.elevation)} usable fixes with an elevation, and a map takes {FEWEST_FIXES}: "
            "give recordings of cars that drive and send elevation_m"
        )
    datum = float(np.median(fixes.elevation))
    fixes = fixes._replace(elevation=fixes.elevation - datum)
    grid = _Grid.of(fixes)
    elevation, errors = _remove_offsets(fixes, grid)
    chosen = _choose_parameters(fixes, grid, elevation, errors.fix_sd)
    sums = grid.sum_up(elevation, np.arange(len(elevation)))
    parts = []
    for planes in fit_planes(sums, (SPACING, SPACING), BANDWIDTHS, errors.fix_sd**2):
        block = _Block.of(planes, chosen.strictness)
        variance = block.variance(errors.fix_sd, chosen.curvature, chosen.factor)
        kept = np.nonzero(variance <= LARGEST_SD**2)  # False for NaN
        place = planes.row + kept[0], planes.column + kept[1], block.elevation[kept] + datum, np.sqrt(variance[kept])
        parts.append((*place, np.rint(planes.fixes[kept])))
    places = ElevationPlaces(*grid.steps, *(np.concatenate(each) for each in zip(*parts, strict=True)))
    cars, rides = len(np.unique(fixes.car)), len(_number_pairs(fixes.car, fixes.ride)[0])
    return places, MapSummary(len(elevation), rides, cars, *errors, *chosen)


class _Errors(NamedTuple):
    """Standard deviations of errors of fixes, and of offsets of rides and of cars. [m]"""

    fix_sd: float
    ride_sd: float
    car_sd: float


def _remove_offsets(fixes: ElevationFixes, grid: _Grid) -> tuple[Floats, _Errors]:
    """Return elevations without offsets and gross errors, and the standard deviations of errors and offsets."""
    car_of_ride, _, ride = _number_pairs(fixes.car, fixes.ride)
    _, car = np.unique(car_of_ride, return_inverse=True)
    count = np.bincount(ride).astype(np.float64)
    elevation, offset, errors = fixes.elevation, np.zeros(len(count)), _Errors(FIRST_FIX_SD, 0.0, 0.0)
    for _ in range(ROUNDS):
        sums = grid.sum_up(elevation, np.arange(len(ride)))
        planes = fit_planes(sums, (SPACING, SPACING), BANDWIDTHS[PILOT : PILOT + 1], errors.fix_sd**2)
        place = grid.follow(*_gather(planes, grid, STRICTNESS[:1])[0][:3])
        residual = fixes.elevation - offset[ride] - place
        fix_sd = max(LEAST_FIX_SD, SIGMA * float(np.nanmedian(np.abs(residual))))
        clipped = np.nan_to_num(np.clip(residual, -CLIP * fix_sd, CLIP * fix_sd))
        mean = offset + np.bincount(ride, clipped) / count
        noise = fix_sd**2 / count * _correlation_factor(clipped, ride)
        offset, ride_sd, car_sd = _shrink_offsets(mean, noise, car)
        errors = _Errors(fix_sd, ride_sd, car_sd)
        deviation = np.clip(fixes.elevation - offset[ride] - place, -CLIP * fix_sd, CLIP * fix_sd)
        elevation = np.where(np.isnan(place), fixes.elevation - offset[ride], place + deviation)
    return elevation, errors


def _correlation_factor(residual: Floats, ride: Ints) -> float:
    """Return how much more the mean of a ride varies, because the errors of successive fixes are correlated. [1]"""
    order = np.argsort(ride, kind="stable")
    before, after = residual[order[:-1]], residual[order[1:]]
    same = ride[order[:-1]] == ride[order[1:]]
    correlation = float(np.clip((before * after)[same].sum() / max((before * before)[same].sum(), 1e-9), 0.0, 0.95))
    return (1.0 + correlation) / (1.0 - correlation)


def _shrink_offsets(mean: Floats, noise: Floats, car: Ints) -> tuple[Floats, float, float]:
    """Return the offset of each ride, and the standard deviations of rides about their car, and of cars.

    Parameters
    ----------
    mean, noise : (rides,) float
        Mean residual of each ride [m], and its variance [m^2].
    car : (rides,) int
        Car of each ride, from 0.
    """
    weight = 1.0 / noise
    of_car = np.bincount(car, weight * mean) / np.bincount(car, weight)
    left = 1.0 - weight / np.bincount(car, weight)[car]  # share of the noise that the mean of the car does not take up
    within = (mean - of_car[car]) ** 2 - noise * left
    ride_variance = max(0.0, float(within.sum() / max(left.sum(), 1e-9)))
    weight = 1.0 / (noise + ride_variance)
    total = np.bincount(car, weight)
    of_car = np.bincount(car, weight * mean) / total
    centre = float(np.average(of_car, weights=total))
    car_variance = max(0.0, float(np.mean((of_car - centre) ** 2 - 1.0 / total)))
    car_offset = (of_car - centre) * car_variance / (car_variance + 1.0 / total)
    deviation = (mean - centre - car_offset[car]) * ride_variance / (ride_variance + noise)
    return car_offset[car] + deviation, ride_variance**0.5, car_variance**0.5


class _Block(NamedTuple):
    """What the planes of the chosen bandwidths say about the nodes of a block, or about some nodes."""

    elevation: Floats  # [m]
    east: Floats  # slopes [1]
    north: Floats
    plane_variance: Floats  # [m^2]
    spread: Floats  # [m^2]
    misfit: Floats  # [m^2]

    @classmethod
    def of(cls, planes: Planes, strictness: float) -> "_Block":
        """Return what the planes of the bandwidths say that a strictness chooses."""
        which = choose_bandwidths(planes, strictness)[None]
        of_bandwidths = (planes.elevation, planes.east, planes.north, planes.variance)
        elevation, east, north, variance = (np.take_along_axis(each, which, 0)[0] for each in of_bandwidths)
        return cls(elevation, east, north, variance, planes.spread, planes.misfit)

    def variance(self, fix_sd: float, curvature: float, factor: float) -> Floats:
        """Return the variance of the elevation, NaN where unknown. [m^2]

        It is that of the plane times its factor, plus the square of what the ground may curve up to the nearest fixes,
        plus what fixes at the node disagree beyond their errors, as at a bridge over another road.
        """
        excess = np.maximum(self.misfit - 2.0 * fix_sd**2, 0.0)
        return np.asarray(factor * self.plane_variance + (0.5 * curvature * self.spread) ** 2 + excess)


def _gather(blocks: Iterable[Planes], grid: _Grid, strictnesses: Sequence[float]) -> list[_Block]:
    """Return what planes say about the nodes of a grid, for each strictness."""
    nodes = [np.full((len(_Block._fields), len(grid.row)), np.nan) for _ in strictnesses]
    of_block = group_by_block(grid.row, grid.column)
    for planes in blocks:
        which = of_block.get((planes.row // SIDE, planes.column // SIDE))
        if which is None:
            continue
        place = grid.row[which] - planes.row, grid.column[which] - planes.column
        for values, strictness in zip(nodes, strictnesses, strict=True):
            values[:, which] = np.stack([each[place] for each in _Block.of(planes, strictness)])
    return [_Block(*values) for values in nodes]


class _Chosen(NamedTuple):
    """Chosen values of `STRICTNESS`, `CURVATURES` and `FACTORS`."""

    strictness: float
    curvature: float
    factor: float


def _choose_parameters(fixes: ElevationFixes, grid: _Grid, elevation: Floats, fix_sd: float) -> _Chosen:
    """Return the parameters with which one half of the days, or of the rides of one day, predicts the other best."""
    unit = fixes.day if np.ptp(fixes.day) > 0 else fixes.ride
    learned = np.flatnonzero(unit % 2 == unit.min() % 2)
    unseen = np.flatnonzero(unit % 2 != unit.min() % 2)
    unseen = unseen[:: 1 + len(unseen) // MOST_FOR_CHOICE]
    best, chosen = -np.inf, _Chosen(STRICTNESS[1], CURVATURES[-1], FACTORS[-1])
    if not len(unseen):
        return chosen
    planes = fit_planes(grid.sum_up(elevation, learned), (SPACING, SPACING), BANDWIDTHS, fix_sd**2)
    for strictness, nodes in zip(STRICTNESS, _gather(planes, grid, STRICTNESS), strict=True):
        square = (elevation - grid.follow(*nodes[:3]))[unseen] ** 2
        for curvature, factor in product(CURVATURES, FACTORS):
            variance = fix_sd**2 + nodes.variance(fix_sd, curvature, factor)[grid.node[unseen]]
            terms = np.log(variance) + np.minimum(square / variance, CLIP**2)
            likelihood = -float(np.nanmean(terms))
            if likelihood > best:
                best, chosen = likelihood, _Chosen(strictness, curvature, factor)
    return chosen
