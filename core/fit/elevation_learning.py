"""Learn a map of elevation from the fixes of a fleet.

A fix is modelled as the elevation of the ground, plus the offset of its car, plus the offset of its ride, plus an
error. The ground is a sum of bilinear functions on grids of `SPACINGS`, a hierarchical basis (Yserentant, Numerische
Mathematik 49 (1986) 379, DOI 10.1007/BF01389538) with random coefficients of mean zero (multiresolution kriging: Nychka
et al., J. Comput. Graph. Stat. 24 (2015) 579, DOI 10.1080/10618600.2014.914946). Their standard deviation is a power of
the distance between nodes. The exponent is the one with which one half of the days predicts the fixes of the other half
best. The offsets of cars and of rides are random with mean zero as well. All are estimated jointly, which takes the
offsets out of the map; its datum is the mean of the fleet's loggers.

The posterior mean solves one linear system, by conjugate gradients. Its uncertainty comes from samples of the
posterior: the same system solved for simulated fixes (Papandreou and Yuille, NIPS 23 (2010) 1858). The variances of
offsets and errors are those of largest likelihood, by a Monte Carlo EM algorithm (Wei and Tanner, JASA 85 (1990) 699,
DOI 10.1080/01621459.1990.10474930).

Errors of successive fixes are correlated; their weight is reduced accordingly. Fixes more than `CLIP` standard
deviations off have a smaller weight (Huber, Ann. Math. Stat. 35 (1964) 73, DOI 10.1214/aoms/1177703732). Where fixes at
one place disagree more than by their errors, as at a bridge over another road, the place is less certain.
"""

from collections.abc import Iterable
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import LinearOperator, cg, splu
from threadpoolctl import threadpool_limits

from socast.core.batch import Batch, Floats, Ints
from socast.core.cleaning.clean_columns import Clean
from socast.core.cleaning.clock import SIGMA
from socast.core.cleaning.elevation_map import CORNERS, ElevationPlaces, number_nodes
from socast.core.cleaning.quality import Quality
from socast.core.columns import EARTH_RADIUS, SECONDS_PER_DAY, TELEMETRY
from socast.core.errors import RecordingError

SPACING: Final = 20.0
"""Distance between places. [m]"""
SPACINGS: Final = tuple(SPACING * 4.0**k for k in range(4))
"""Distances between the nodes of the grids, up to 1.28 km. [m]"""
ROUNDS: Final = 3
"""Rounds of the EM algorithm before and after the roughness of the ground is chosen."""
SAMPLES: Final = 2
"""Samples of the posterior in each round."""
LAST_SAMPLES: Final = 16
"""Samples of the posterior for the uncertainty of places, which is thereby known to 18 %."""
SEED: Final = 20_260_101
"""Seed of the samples, so that the same fixes give the same map."""
FINEST: Final = 2
"""Number of fine grids, whose nodes are too many for a direct solution."""
PRECISION: Final = 1e-5
"""Relative residual at which the solution of a system is accepted. [1]"""
MOST_STEPS: Final = 2000
"""Largest number of steps of conjugate gradients; 537 rides of five cars take up to 150."""
CLIP: Final = 3.0
"""Residual beyond which the weight of a fix is reduced. [standard deviations]"""
FIRST_FIX_SD: Final = 3.0
"""Standard deviation of the error of a fix in the first round. [m]"""
FIRST_OFFSET_SD: Final = (3.0, 30.0)
"""Standard deviations of the offsets of rides and of cars in the first round. [m]"""
EXPONENTS: Final = (0.5, 0.75, 1.0, 1.25, 1.5, 1.75, 2.0)
"""Candidates of the exponent with which the standard deviation of coefficients grows with the distance of nodes. [1]
Natural terrain has 0.5 to 1 (Mark and Aronson, Math. Geol. 16 (1984) 671, DOI 10.1007/BF01033029), roads more."""
FIRST_EXPONENT: Final = 1.0
"""Exponent that serves until one is chosen. [1]"""
UNSEEN: Final = 1e-6
"""Factor of the weight of fixes that are to be predicted. [1]"""
LEAST_SD: Final = 1e-3
"""Least standard deviation of errors, coefficients and offsets. [m]"""
MOVED: Final = 5.0
"""Least distance driven since the sample before. A fix of a standing car repeats the error of the one before it. [m]"""
NEAR: Final = 5
"""Largest distance of a place from the nearest fix, in steps north or east. [places]"""
LARGEST_SD: Final = 3.0
"""Standard uncertainty beyond which a place is not kept: that of SRTM, see `socast.stream.elevation_tiles`. [m]"""
FEWEST_FIXES: Final = 100
"""Number of fixes below which no map is made."""
ENOUGH: Final = 4
"""Number of fixes at a place from which they can show that the ground has two levels."""
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


_NO_FIXES: Final = ElevationFixes(*(np.empty(0, kind) for kind in (float, float, float, np.int64, np.int64, np.int64)))


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
    correlation : float
        Correlation of the errors of successive fixes. [1]
    exponent : float
        Chosen roughness of the ground, see `EXPONENTS`. [1]
    """

    fixes: int
    rides: int
    cars: int
    fix_sd: float
    ride_sd: float
    car_sd: float
    correlation: float
    exponent: float


def select_fixes(batch: Batch, clean: Clean) -> ElevationFixes:
    """Return the fixes of rides in a batch from which a map can be learned."""
    usable = ((clean.quality & UNUSABLE) == 0) & (clean.ride >= 0)
    usable &= (clean.dt > 0.0) & (clean.distance >= MOVED)
    usable &= np.isfinite(batch.latitude) & np.isfinite(batch.longitude)
    usable &= (batch.elevation >= _ELEVATION.low) & (batch.elevation <= _ELEVATION.high)
    day = np.floor(clean.time[usable] / SECONDS_PER_DAY).astype(np.int64)
    latitude, longitude, elevation = (each[usable] for each in (batch.latitude, batch.longitude, batch.elevation))
    return ElevationFixes(latitude, longitude, elevation, clean.lane[usable], clean.ride[usable], day)


def join_fixes(parts: Iterable[ElevationFixes]) -> ElevationFixes:
    """Return fixes concatenated; no fixes without parts."""
    return ElevationFixes(*(np.concatenate(columns) for columns in zip(_NO_FIXES, *parts, strict=True)))


class _Columns:
    """Columns of the linear system: the nodes of every grid that fixes touch, then rides, then cars."""

    def __init__(self, row: Floats, column: Floats) -> None:
        """Give a number to the nodes about positions, which are in units of `SPACING`."""
        self.keys = [
            np.unique(np.concatenate([key for key, _ in _find_corners(row, column, k)])) for k in range(len(SPACINGS))
        ]
        self.first = np.concatenate([[0], np.cumsum([len(keys) for keys in self.keys])])

    @property
    def nodes(self) -> int:
        """Number of nodes of all grids."""
        return int(self.first[-1])

    def design(self, row: Floats, column: Floats) -> tuple[Any, Floats]:
        """Return the values of all functions at positions, (n, nodes), and the squares without a column, (n, grids)."""
        at, places, values = [], [], []
        without = np.zeros((len(row), len(SPACINGS)))
        for k, keys in enumerate(self.keys):
            for key, weight in _find_corners(row, column, k):
                place = np.minimum(np.searchsorted(keys, key), len(keys) - 1)
                known = keys[place] == key
                at.append(np.flatnonzero(known))
                places.append(self.first[k] + place[known])
                values.append(weight[known])
                without[:, k] += np.where(known, 0.0, weight * weight)
        shape = len(row), self.nodes
        entries = np.concatenate(values), (np.concatenate(at), np.concatenate(places))
        return coo_array(entries, shape=shape).tocsr(), without


def _find_corners(row: Floats, column: Floats, k: int) -> list[tuple[Ints, Floats]]:
    """Return key and bilinear weight of the four nodes of a grid about positions."""
    scale = SPACINGS[k] / SPACING
    y, x = row / scale, column / scale
    south, west = np.floor(y).astype(np.int64), np.floor(x).astype(np.int64)
    north, east = y - south, x - west
    return [
        (number_nodes(south + up, west + right), (north if up else 1.0 - north) * (east if right else 1.0 - east))
        for up, right in CORNERS
    ]


class _System:
    """The linear model of the fixes."""

    def __init__(self, design: Any, component: Ints) -> None:
        self.design, self.transposed, self.component = design, design.T.tocsr(), component
        self.squares = self.transposed.power(2)
        self.far = np.flatnonzero(component >= FINEST)
        self.of_far = design[:, self.far]


class _Posterior:
    """The posterior of the coefficients, given the weight of each fix and the precision of each column.

    Its equations are solved by conjugate gradients. The preconditioner solves those of wide grids, rides and cars
    exactly: these columns overlap, and with the diagonal alone their sum would converge long before its parts.
    """

    def __init__(self, system: _System, weight: Floats, precision: Floats) -> None:
        self._system, self._weight, self._precision = system, weight, precision
        size, self._diagonal = (len(precision),) * 2, system.squares @ weight + precision
        far = system.of_far.T @ diags_array(weight) @ system.of_far + diags_array(precision[system.far])
        options = {"SymmetricMode": True}
        self._of_far = splu(far.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
        self._matrix = LinearOperator(size, matvec=self._apply)
        self._preconditioner = LinearOperator(size, matvec=self._precondition)

    def _apply(self, vector: Floats) -> Floats:
        system = self._system
        return np.asarray(system.transposed @ (self._weight * (system.design @ vector)) + self._precision * vector)

    def _precondition(self, vector: Floats) -> Floats:
        out = np.asarray(vector / self._diagonal)
        out[self._system.far] = self._of_far.solve(vector[self._system.far])
        return out

    def find_mean(self, elevation: Floats, start: Floats | None = None) -> Floats:
        """Return the posterior mean of the coefficients."""
        right = self._system.transposed @ (self._weight * elevation)
        solution, status = cg(self._matrix, right, x0=start, rtol=PRECISION, maxiter=MOST_STEPS, M=self._preconditioner)
        if status != 0:
            residual = float(np.linalg.norm(right - self._apply(solution)) / np.linalg.norm(right))
            raise RecordingError(
                f"no map: after {MOST_STEPS:,} steps the equations of {len(elevation):,} fixes have a residual of "
                f"{residual:.1e}, above {PRECISION:g}; learn from fewer days, or from a smaller area at a time"
            )
        return np.asarray(solution)

    def draw(self, rng: np.random.Generator) -> Floats:
        """Return a sample of the posterior, less its mean."""
        coefficients = rng.normal(size=len(self._precision)) / np.sqrt(self._precision)
        errors = rng.normal(size=len(self._weight)) / np.sqrt(self._weight)
        return coefficients - self.find_mean(self._system.design @ coefficients + errors)


class _Fit(NamedTuple):
    """What is estimated of the fixes besides the elevation of places."""

    coefficients: Floats  # posterior mean [m]
    variances: Floats  # of each component: the grids, rides, cars [m^2]
    weight: Floats  # of each fix [1/m^2]
    fix_sd: float  # [m]
    correlation: float  # of successive errors


def learn_elevation(fixes: ElevationFixes) -> tuple[ElevationPlaces, MapSummary]:
    """Return a map of the places near the fixes of a fleet, and how it was learned."""
    if len(fixes.elevation) < FEWEST_FIXES:
        raise RecordingError(
            f"{len(fixes.elevation)} usable fixes with an elevation, and a map takes {FEWEST_FIXES}: "
            "give recordings of cars that drive and send elevation_m"
        )
    datum = float(np.median(fixes.elevation))
    fixes = fixes._replace(elevation=fixes.elevation - datum)
    scale = float(np.cos(np.median(fixes.latitude)))  # makes the cells square
    steps = SPACING / EARTH_RADIUS, SPACING / (EARTH_RADIUS * scale)
    row, column = fixes.latitude / steps[0], fixes.longitude / steps[1]
    car, ride = (
        np.unique(code, return_inverse=True)[1]
        for code in (fixes.car, fixes.car * (int(fixes.ride.max()) + 2) + fixes.ride)
    )
    columns = _Columns(row, column)
    rng = np.random.default_rng(SEED)
    system = _make_system(columns.design(row, column)[0], columns, ride, car)
    with threadpool_limits(1):  # vectors are short, so threads would wait, and sums would depend on their number
        fit, exponent = _estimate(system, fixes, ride, rng)
        residual = fixes.elevation - system.design @ fit.coefficients
        places = _make_places(columns, system, fit, _measure_disagreement(row, column, residual, fit.fix_sd), rng)
    y, x, z, variance, count = places
    kept = variance <= LARGEST_SD**2
    learned = ElevationPlaces(*steps, y[kept], x[kept], z[kept] + datum, np.sqrt(variance[kept]), count[kept])
    ride_sd, car_sd = np.sqrt(fit.variances[-2:]).tolist()
    counts = len(ride), int(ride.max()) + 1, int(car.max()) + 1
    summary = MapSummary(*counts, fit.fix_sd, ride_sd, car_sd, fit.correlation, exponent)
    return learned, summary


def _make_system(design: Any, columns: _Columns, ride: Ints, car: Ints) -> _System:
    """Return the linear model with columns for rides and cars after those of the nodes."""
    n, rides, cars = len(ride), int(ride.max()) + 1, int(car.max()) + 1
    nodes = design.tocoo()
    fix = np.arange(n)
    at = np.concatenate([nodes.coords[0], fix, fix])
    place = np.concatenate([nodes.coords[1], columns.nodes + ride, columns.nodes + rides + car])
    values = np.concatenate([nodes.data, np.ones(2 * n)])
    sizes = [len(keys) for keys in columns.keys] + [rides, cars]
    component = np.repeat(np.arange(len(sizes)), sizes)
    return _System(coo_array((values, (at, place)), shape=(n, len(component))).tocsr(), component)


def _compute_ground_variances(fixes: ElevationFixes, exponent: float) -> Floats:
    """Return the variance of the coefficients of each grid: that of the fixes for the widest. [m^2]"""
    relief = max(LEAST_SD, float(np.std(fixes.elevation)))
    return (relief * (np.array(SPACINGS) / SPACINGS[-1]) ** exponent) ** 2


def _estimate(system: _System, fixes: ElevationFixes, ride: Ints, rng: np.random.Generator) -> tuple[_Fit, float]:
    """Return coefficients, variances and weights, and the exponent of the ground that predicts unseen days best."""
    weight = np.full(len(ride), FIRST_FIX_SD**-2.0)
    variances = np.append(_compute_ground_variances(fixes, FIRST_EXPONENT), np.square(FIRST_OFFSET_SD))
    fit = _Fit(np.zeros(len(system.component)), variances, weight, FIRST_FIX_SD, 0.0)
    for _ in range(ROUNDS):
        fit = _improve(system, fixes.elevation, ride, fit, rng)
    exponent = _choose_exponent(system, fixes, fit)
    fit.variances[:-2] = _compute_ground_variances(fixes, exponent)
    for _ in range(ROUNDS):
        fit = _improve(system, fixes.elevation, ride, fit, rng)
    return fit, exponent


def _improve(system: _System, elevation: Floats, ride: Ints, fit: _Fit, rng: np.random.Generator) -> _Fit:
    """Return the fit after one round of the EM algorithm for offsets and errors."""
    component = system.component
    posterior = _Posterior(system, fit.weight, 1.0 / fit.variances[component])
    coefficients = posterior.find_mean(elevation, fit.coefficients)
    samples = [posterior.draw(rng) for _ in range(SAMPLES)]
    variances = fit.variances.copy()
    variances[-2:] = [
        _compute_mean_square(coefficients, samples, component == place) for place in component[-1] - [1, 0]
    ]
    residual = elevation - system.design @ coefficients
    taken_up = np.mean([(system.design @ sample) ** 2 for sample in samples])
    fix_sd = max(LEAST_SD, float(np.sqrt((SIGMA * np.median(np.abs(residual))) ** 2 + taken_up)))
    correlation = _correlate(np.clip(residual, -CLIP * fix_sd, CLIP * fix_sd), ride)
    reduced = np.minimum(1.0, CLIP * fix_sd / np.maximum(np.abs(residual), LEAST_SD))
    weight = reduced * (1.0 - correlation) / (1.0 + correlation) / fix_sd**2
    return _Fit(coefficients, variances, weight, fix_sd, correlation)


def _compute_mean_square(coefficients: Floats, samples: list[Floats], which: NDArray[np.bool_]) -> float:
    """Return the expected variance of some coefficients about their mean, which belongs to the datum of the map."""
    about = [each[which] - each[which].mean() for each in (coefficients, *samples)]
    mean, deviations = about[0], about[1:]
    square = float(mean @ mean + np.mean([deviation @ deviation for deviation in deviations]))
    return max(LEAST_SD**2, square / max(1, len(mean) - 1))


def _choose_exponent(system: _System, fixes: ElevationFixes, fit: _Fit) -> float:
    """Return the exponent with which every second day, or ride of one day, predicts the others best."""
    unit = fixes.day if np.ptp(fixes.day) > 0 else fixes.ride
    unseen = np.unique(unit, return_inverse=True)[1] % 2 == 1
    if not unseen.any():
        return FIRST_EXPONENT
    weight = np.where(unseen, UNSEEN * fit.weight, fit.weight)
    errors = []
    for exponent in EXPONENTS:
        variances = np.append(_compute_ground_variances(fixes, exponent), fit.variances[-2:])
        coefficients = _Posterior(system, weight, 1.0 / variances[system.component]).find_mean(fixes.elevation)
        residual = (fixes.elevation - system.design @ coefficients)[unseen]
        errors.append(float(np.mean(np.minimum(np.abs(residual), CLIP * fit.fix_sd) ** 2)))
    return EXPONENTS[int(np.argmin(errors))]


def _correlate(residual: Floats, ride: Ints) -> float:
    """Return the correlation of successive residuals of a ride, 0 to 0.9."""
    order = np.argsort(ride, kind="stable")
    before, after = residual[order[:-1]], residual[order[1:]]
    same = ride[order[:-1]] == ride[order[1:]]
    total = float((before * before)[same].sum())
    return float(np.clip((before * after)[same].sum() / total, 0.0, 0.9)) if total > 0.0 else 0.0


def _measure_disagreement(
    row: Floats, column: Floats, residual: Floats, fix_sd: float
) -> tuple[Ints, Ints, Ints, Floats]:
    """Return the places nearest to fixes: row, column, number of fixes, and their variance beyond that of errors."""
    y, x = np.rint(row).astype(np.int64), np.rint(column).astype(np.int64)
    _, first, place = np.unique(number_nodes(y, x), return_index=True, return_inverse=True)
    count = np.bincount(place)
    mean_square = np.bincount(place, residual**2) / count
    excess = np.where(count >= ENOUGH, np.maximum(mean_square - 2.0 * fix_sd**2, 0.0), 0.0)
    return y[first], x[first], count, excess


def _make_places(
    columns: _Columns,
    system: _System,
    fit: _Fit,
    measured: tuple[Ints, Ints, Ints, Floats],
    rng: np.random.Generator,
) -> tuple[Ints, Ints, Floats, Floats, Ints]:
    """Return row, column, elevation, variance and number of fixes of all places near fixes."""
    row, column = _dilate(measured[0], measured[1])
    design, without = columns.design(row.astype(np.float64), column.astype(np.float64))
    cars = system.component == system.component[-1]
    posterior = _Posterior(system, fit.weight, 1.0 / fit.variances[system.component])
    square = np.zeros(len(row))
    for _ in range(LAST_SAMPLES):
        square += _evaluate(design, posterior.draw(rng), cars) ** 2
    variance = square / LAST_SAMPLES + without @ fit.variances[: len(SPACINGS)]
    place = np.searchsorted(number_nodes(row, column), number_nodes(measured[0], measured[1]))
    count = np.zeros(len(row), np.int64)
    count[place] = measured[2]
    variance[place] += measured[3]
    return row, column, _evaluate(design, fit.coefficients, cars), variance, count


def _evaluate(design: Any, coefficients: Floats, cars: NDArray[np.bool_]) -> Floats:
    """Return the elevation of places as the mean of all loggers reports it, which fixes the datum of the map. [m]"""
    return np.asarray(design @ coefficients[: design.shape[1]] + coefficients[cars].mean())


def _dilate(row: Ints, column: Ints) -> tuple[Ints, Ints]:
    """Return all places within `NEAR` steps of some places, in the order of their keys."""
    for _ in range(NEAR):
        around = [(row + up, column + right) for up in (-1, 0, 1) for right in (-1, 0, 1)]
        y, x = (np.concatenate(each) for each in zip(*around, strict=True))
        _, first = np.unique(number_nodes(y, x), return_index=True)
        row, column = y[first], x[first]
    return row, column
