"""Find the nearest weather station that has observed by the time of a sample, in the order of their latitudes.

The search of a sample begins at the stations north and south of it, and goes on in both directions until the difference
of the latitudes alone is larger than the smallest distance so far. Its time therefore hardly grows with the number of
stations.
"""

from math import isnan, pi
from typing import Any, Final

from socast.core.compiled_cache import njit

_NONE: Final = -1


@njit(cache=True)
def find_nearest_stations(
    time: Any, latitude: Any, longitude: Any, order: Any, sorted_latitude: Any, places: Any, first: Any, out: Any
) -> None:
    """Find the nearest station of each sample.

    Parameters
    ----------
    time, latitude, longitude : (n,) float
        Samples; the position may be NaN. [s], [rad], [rad]
    out : (n,) int
        Receives the stations. Of several at the same distance it is the first one; of a sample without a position the
        first one, too. -1 where no station has observed by then.

    Notes
    -----
    The square of the distance is Δφ² + (Δλ cos φ)², with latitude φ of the station and longitude λ.
    """
    stations = len(order)
    for i in range(len(time)):
        if i > 0 and latitude[i] == latitude[i - 1] and longitude[i] == longitude[i - 1] and time[i] == time[i - 1]:
            out[i] = out[i - 1]
            continue
        if isnan(latitude[i]) or isnan(longitude[i]):
            out[i] = _find_first(time[i], first)
            continue
        nearest, best = _NONE, 1e300
        north = _find_place(sorted_latitude, latitude[i])
        south = north - 1
        while True:
            to_north = sorted_latitude[north] - latitude[i] if north < stations else 1e300
            to_south = latitude[i] - sorted_latitude[south] if south >= 0 else 1e300
            step = min(to_north, to_south)
            if step >= 1e300 or step * step > best:
                break
            if to_north <= to_south:
                station = order[north]
                north += 1
            else:
                station = order[south]
                south -= 1
            if first[station] > time[i]:
                continue
            up = latitude[i] - places[station, 0]
            east = abs(longitude[i] - places[station, 1])
            east = min(east, 2.0 * pi - east) * places[station, 2]
            far = up * up + east * east
            if far < best or (far == best and station < nearest):
                nearest, best = station, far
        out[i] = nearest


@njit(cache=False)
def _find_first(time: float, first: Any) -> int:
    """Return the first station that has observed by a time."""
    for station in range(len(first)):
        if first[station] <= time:
            return station
    return _NONE


@njit(cache=False)
def _find_place(values: Any, value: float) -> int:
    """Return the number of sorted values below a value."""
    low, high = 0, len(values)
    while low < high:
        middle = (low + high) // 2
        if values[middle] < value:
            low = middle + 1
        else:
            high = middle
    return low


@njit(cache=True)
def take_observations(time: Any, station: Any, times: Any, counts: Any, values: Any, out: Any) -> None:
    """Take the latest observation of a station that is not later than a sample.

    Parameters
    ----------
    times : (stations, kept) float
        Times of the observations of each station, ascending. [s]
    """
    for i in range(len(time)):
        at = station[i]
        if at >= 0:
            last = _find_place(times[at, : counts[at]], time[i])
            if last == counts[at] or times[at, last] > time[i]:
                last -= 1
            for field in range(out.shape[0]):
                out[field, i] = values[at, last, field]
