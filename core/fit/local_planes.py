"""Fit planes to scattered elevations about every node of a grid, with weights that fall with distance.

The elevation at a node t comes from local linear regression (Fan and Gijbels, Local Polynomial Modelling, Chapman and
Hall 1996, ch. 2): minimise sum K(|x - t| / h) (z - a - b (x - t))^2 with the Gaussian kernel K(r) = exp(-r^2 / 2). The
elevation is a. The slope b has a prior of mean 0 and of standard deviation `SLOPE_SD`, so that fixes along one straight
street do not determine a slope across it.

The bandwidths h grow by the square root of two, because the square of a kernel is then the kernel of the bandwidth
before: one set of moments gives both the estimate and its variance. At each node the widest bandwidth is used whose
elevation agrees with those of all narrower ones (intersection of confidence intervals: Katkovnik, IEEE Trans. Signal
Processing 47 (1999) 2567, DOI 10.1109/78.782208). Level ground is averaged widely, and a bridge or the foot of a hill
narrowly.

All sums over neighbours are convolutions, computed block by block with Fourier transforms.
"""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from core.batch import Floats, Ints

SLOPE_SD: Final = 0.05
"""Standard deviation of the slope of roads. [1] Few city streets are steeper than 10 %: AASHTO, A Policy on Geometric
Design of Highways and Streets, 7th ed. 2018, section 5.2."""
SIDE: Final = 128
"""Nodes of a block along each axis."""
REACH: Final = 3.5
"""Distance beyond which a kernel is zero. [bandwidths]"""
LEAST_WEIGHT: Final = 0.02
"""Sum of weights below which a node has no estimate. [fixes]"""

MOMENTS: Final = ("n", "x", "y", "xx", "xy", "yy", "z", "zx", "zy", "zz")
"""Sums over the fixes nearest to a node: number, products of offsets east x and north y of it, and elevation z."""


class NodeSums(NamedTuple):
    """Sums over the fixes nearest to each of m nodes.

    Parameters
    ----------
    row, column : (m,) int
        Nodes.
    moments : (len(MOMENTS), m) float
        Sums. [powers of m]
    """

    row: Ints
    column: Ints
    moments: Floats


class Planes(NamedTuple):
    """Planes at the nodes of a block, for each of several bandwidths; NaN where there are too few fixes.

    Parameters
    ----------
    row, column : int
        First node of the block.
    elevation, east, north : (bandwidths, SIDE, SIDE) float
        Elevation [m] and slopes [1] at the nodes.
    variance : (bandwidths, SIDE, SIDE) float
        Variance of the elevation by the errors of fixes and by the unknown slope, without curvature. [m^2]
    spread : (SIDE, SIDE) float
        Mean square distance of the nearest fixes, by the narrowest bandwidth that has any. [m^2]
    misfit : (SIDE, SIDE) float
        Mean square residual of the fixes within the narrowest bandwidth, and 0 without fixes. [m^2]
    fixes : (SIDE, SIDE) float
        Number of fixes nearest to each node.
    """

    row: int
    column: int
    elevation: Floats
    east: Floats
    north: Floats
    variance: Floats
    spread: Floats
    misfit: Floats
    fixes: Floats


def fit_planes(
    sums: NodeSums, steps: tuple[float, float], bandwidths: Sequence[float], fix_variance: float
) -> Iterator[Planes]:
    """Fit planes at the nodes of every block that has fixes near it.

    Parameters
    ----------
    sums : NodeSums
        Sums over the fixes.
    steps : (float, float)
        Distance between nodes east and north. [m]
    bandwidths : sequence of float
        Bandwidths, each the square root of two times the one before. [m]
    fix_variance : float
        Variance of the elevation of a fix. [m^2]

    Yields
    ------
    Planes
        Block by block.
    """
    pads = [int(np.ceil(REACH * bandwidths[-1] / step)) for step in (steps[1], steps[0])]
    shape = fft.next_fast_len(SIDE + 2 * pads[0], real=True), fft.next_fast_len(SIDE + 2 * pads[1], real=True)
    first = bandwidths[0] / np.sqrt(2.0)
    kernels = [_kernels(width, steps, shape) for width in (first, *bandwidths)]
    for row, column, images in _windows(sums, pads, shape):
        inner = slice(pads[0], pads[0] + SIDE), slice(pads[1], pads[1] + SIDE)
        spectra = fft.rfft2(images)
        moments = [_convolve(spectra, kernel, shape)[(slice(None), *inner)] for kernel in kernels]
        fixes = images[(0, *inner)]
        yield _solve(row, column, moments, fixes, fix_variance)


def group_by_block(row: Ints, column: Ints) -> dict[tuple[int, int], Ints]:
    """Return the places of nodes in each block, by the block's row and column.

    Parameters
    ----------
    row, column : (m,) int
        Nodes.

    Examples
    --------
    >>> group_by_block(np.array([0, 5, -1]), np.array([3, 2, 200]))
    {(-1, 1): array([2]), (0, 0): array([0, 1])}
    """
    rows, columns = row // SIDE, column // SIDE
    order = np.lexsort((columns, rows))
    changes = (np.diff(rows[order]) != 0) | (np.diff(columns[order]) != 0)
    parts = np.split(order, np.flatnonzero(changes) + 1)
    return {(int(rows[part[0]]), int(columns[part[0]])): part for part in parts}


def _windows(sums: NodeSums, pads: Sequence[int], shape: tuple[int, int]) -> Iterator[tuple[int, int, Floats]]:
    """Yield the first node of each block near fixes, and images of the moments about it."""
    of_block = group_by_block(sums.row, sums.column)
    far = [-(-pad // SIDE) for pad in pads]
    around = [(up, right) for up in range(-far[0], far[0] + 1) for right in range(-far[1], far[1] + 1)]
    near = sorted({(row + up, column + right) for row, column in of_block for up, right in around})
    for block_row, block_column in near:
        beside = [(block_row + up, block_column + right) for up, right in around]
        which = np.concatenate([of_block[each] for each in beside if each in of_block])
        y = sums.row[which] - block_row * SIDE + pads[0]
        x = sums.column[which] - block_column * SIDE + pads[1]
        inside = (y >= 0) & (y < SIDE + 2 * pads[0]) & (x >= 0) & (x < SIDE + 2 * pads[1])
        if not inside.any():
            continue
        images = np.zeros((len(MOMENTS), *shape))
        images[:, y[inside], x[inside]] = sums.moments[:, which[inside]]
        yield block_row * SIDE, block_column * SIDE, images


def _kernels(width: float, steps: tuple[float, float], shape: tuple[int, int]) -> NDArray[np.complex128]:
    """Return the spectra of the kernel times 1, u, v, u^2, u v and v^2, for correlation, (6, ...)."""
    v = fft.fftfreq(shape[0], 1.0 / shape[0])[:, None] * steps[1]
    u = fft.fftfreq(shape[1], 1.0 / shape[1])[None, :] * steps[0]
    square = (u * u + v * v) / (width * width)
    kernel = np.where(square <= REACH * REACH, np.exp(-0.5 * square), 0.0)
    return np.conj(fft.rfft2(np.stack([kernel * factor for factor in (1.0, u, v, u * u, u * v, v * v)])))


def _convolve(spectra: NDArray[np.complex128], kernel: NDArray[np.complex128], shape: tuple[int, int]) -> Floats:
    """Return the moments about every node, weighted by a kernel, in the order of `MOMENTS`, (10, ...)."""
    n, x, y, xx, xy, yy, z, zx, zy, zz = spectra
    k, ku, kv, kuu, kuv, kvv = kernel
    about = np.stack(
        [
            k * n,
            ku * n + k * x,
            kv * n + k * y,
            kuu * n + 2.0 * ku * x + k * xx,
            kuv * n + ku * y + kv * x + k * xy,
            kvv * n + 2.0 * kv * y + k * yy,
            k * z,
            ku * z + k * zx,
            kv * z + k * zy,
            k * zz,
        ]
    )
    return np.asarray(fft.irfft2(about, s=shape))


def _solve(row: int, column: int, moments: Sequence[Floats], fixes: Floats, fix_variance: float) -> Planes:
    """Return the planes of a block from its moments, for the bandwidths after the first."""
    found = [_solve_one(one, squared, fix_variance) for squared, one in pairwise(moments)]
    elevation, east, north, variance = (np.stack(each) for each in zip(*found, strict=True))
    spread = np.full(fixes.shape, np.nan)
    for one in reversed(moments[1:]):
        some = one[0] > LEAST_WEIGHT
        spread[some] = ((one[3] + one[5])[some] / one[0][some]).clip(0.0)
    n, x, y, xx, xy, yy, z, zx, zy, zz = moments[1]
    a, b, c = elevation[0], east[0], north[0]
    squares = zz - 2.0 * (a * z + b * zx + c * zy)
    squares += a * a * n + b * b * xx + c * c * yy + 2.0 * (a * b * x + a * c * y + b * c * xy)
    with np.errstate(invalid="ignore", divide="ignore"):
        misfit = np.where(n > 0.5, squares / n, 0.0).clip(0.0)
    return Planes(row, column, elevation, east, north, variance, spread, np.nan_to_num(misfit), fixes)


def _solve_one(moments: Floats, squared: Floats, fix_variance: float) -> tuple[Floats, Floats, Floats, Floats]:
    """Return elevation, slopes and variance by the moments of a kernel and of its square."""
    n, x, y, xx, xy, yy, z, zx, zy, _ = moments
    prior = fix_variance / SLOPE_SD**2
    known = n > LEAST_WEIGHT
    matrix = np.stack([n, x, y, x, xx + prior, xy, y, xy, yy + prior], axis=-1).reshape(*n.shape, 3, 3)
    matrix[~known] = np.eye(3)
    inverse = np.linalg.inv(matrix)
    solution = np.einsum("...ij,j...->i...", inverse, np.stack([z, zx, zy]))
    row = np.moveaxis(inverse[..., 0, :], -1, 0)
    sn, sx, sy, sxx, sxy, syy = squared[:6]
    square = row[0] ** 2 * sn + row[1] ** 2 * sxx + row[2] ** 2 * syy
    square += 2.0 * (row[0] * row[1] * sx + row[0] * row[2] * sy + row[1] * row[2] * sxy)
    variance = fix_variance * square.clip(0.0) + (SLOPE_SD * prior) ** 2 * (row[1] ** 2 + row[2] ** 2)
    nothing = np.where(known, 0.0, np.nan)
    elevation, east, north = solution + nothing
    return elevation, east, north, variance + nothing


def choose_bandwidths(planes: Planes, strictness: float) -> Ints:
    """Return the widest bandwidth at each node whose elevation agrees with those of all narrower ones.

    Parameters
    ----------
    planes : Planes
        Planes of a block.
    strictness : float
        Half-width of the intervals that must have a point in common. [standard deviations]

    Returns
    -------
    (SIDE, SIDE) int
        Place of the bandwidth; 0 where none has an elevation.
    """
    half = strictness * np.sqrt(planes.variance)
    low = np.full(planes.spread.shape, -np.inf)
    high = -low
    which = np.zeros(low.shape, np.int64)
    for place, (elevation, margin) in enumerate(zip(planes.elevation, half, strict=True)):
        low, high = np.fmax(low, elevation - margin), np.fmin(high, elevation + margin)  # NaN changes neither
        which[(low <= high) & ~np.isnan(elevation)] = place
    return which
