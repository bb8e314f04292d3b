"""Detections of tracks: the points that a track has in a scan, as one position and a width."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from stillmap.core import arrays
from stillmap.core.array_types import Float, Index
from stillmap.tracking.clustering import DynamicPoints

_MANY = 1 << 16  # points that tell how far apart beams are


class Centroids(NamedTuple):
    """Mean end point of each track in each scan, in the order of tracks, then scans.

    Attributes:
        track: (L,) track numbers.
        scan: (L,) of the recording.
        xy: (L, 2) mean of the end points, in the map frame.
        hits: (L,) end points.
    """

    track: Index
    scan: Index
    xy: Float
    hits: Index


def compute_centroids(points: DynamicPoints, owner: Index, here: slice | Index) -> Centroids:
    """Centroids of some points, all or none of a scan; points without a track (-1) are left out."""
    track, scan, xy = owner[here], points.scan[here], points.xy[here]
    own = np.flatnonzero(track >= 0)
    order = own[np.lexsort((scan[own], track[own]))]
    track, scan = track[order], scan[order]
    begins = np.flatnonzero(np.diff(track, prepend=-1) | np.diff(scan, prepend=-1))
    count = np.diff(begins, append=len(order))
    sums = np.add.reduceat(xy[order], begins) if len(begins) else np.zeros((0, 2))
    return Centroids(track[begins], scan[begins], sums / count[:, None], count)


def collect_centroids(points: DynamicPoints, owner: Index) -> Centroids:
    """Centroids of all points."""
    blocks = [compute_centroids(points, owner, here) for here in scan_blocks(points, owner)]
    centroids = Centroids._make(np.concatenate(column) for column in zip(*blocks, strict=True))
    order = np.argsort(centroids.track, kind="stable")  # blocks follow each other in time
    return Centroids._make(column[order] for column in centroids)


def measure_widths(points: DynamicPoints, centroids: Centroids) -> Float:
    """(L,) metres across the line of sight that the beams of a centroid cover."""
    some = slice(0, _MANY)
    bearing = np.arctan2(*(points.xy[some] - points.sensor[points.scan[some]]).T[::-1])
    turn = np.abs((np.diff(bearing) + np.pi) % (2.0 * np.pi) - np.pi)
    adjacent = (np.diff(points.beam[some]) == 1) & (np.diff(points.cluster[some]) == 0)
    between = float(np.median(turn[adjacent])) if adjacent.any() else 0.0
    distance = np.linalg.norm(centroids.xy - points.sensor[centroids.scan], axis=1)
    return np.asarray(centroids.hits * between * distance)


def find_near_pairs(scan: Index, xy: Float, max_distance: float) -> Index:
    """(P, 2) pairs of positions (K, 2) of the same scan within a distance of each other.

    The k-th and the (k + shift)-th position by scan are compared for every shift, of which there
    are as many as positions in one scan.
    """
    order = np.argsort(scan, kind="stable")
    scan, xy = scan[order], xy[order]
    parts, shift = [np.empty((0, 2), np.intp)], 1
    while (first := np.flatnonzero(scan[shift:] == scan[:-shift])).size:
        near = ((xy[first + shift] - xy[first]) ** 2).sum(axis=1) <= max_distance**2
        parts.append(np.column_stack([first, first + shift])[near])
        shift += 1
    return order[np.concatenate(parts)]


def iterate_tracks(points: DynamicPoints, owner: Index) -> Iterator[tuple[int, Index]]:
    """Yield each track number, rising, with its points, rising; in bounded memory."""
    count = np.zeros(count_tracks(owner), np.intp)
    for block in arrays.iter_blocks(owner):
        count += np.bincount(owner[block][owner[block] >= 0], minlength=len(count))
    first = np.cumsum(count) - count
    order = arrays.empty((int(count.sum()),), np.intp, points.scratch)
    free = first.copy()
    for block in arrays.iter_blocks(owner, order):
        own = np.flatnonzero(owner[block] >= 0)
        own = own[np.argsort(owner[block][own], kind="stable")]
        track = owner[block][own]
        begins = np.flatnonzero(np.diff(track, prepend=-1))
        runs = np.diff(begins, append=len(track))
        at = np.repeat(free[track[begins]] - begins, runs) + np.arange(len(track))
        order[at] = block.start + own
        free[track[begins]] += runs
    read = 0
    for k in np.flatnonzero(count).tolist():
        yield k, np.array(order[first[k] : first[k] + count[k]])
        read += count[k]
        if read > arrays.BLOCK:
            points.release(owner, order)
            read = 0


def count_tracks(owner: Index) -> int:
    """The largest track number + 1."""
    return max((int(owner[b].max()) for b in arrays.iter_blocks(owner)), default=-1) + 1


def scan_blocks(points: DynamicPoints, *beside: Index) -> Iterator[slice]:
    """Slices of points of whole scans; their cached pages are released afterwards."""
    first, at = points.first, 0
    while at < len(points.scan):
        end = first[np.searchsorted(first, at + arrays.BLOCK, side="right") - 1]
        if end <= at:  # one scan alone
            end = first[np.searchsorted(first, at, side="right")]
        yield slice(at, int(end))
        points.release(*beside)
        at = int(end)


def renumber(points: DynamicPoints, owner: Index, new_number: Callable[[Index], Index]) -> Index:
    """(N,) track numbers replaced block by block."""
    out = arrays.empty(owner.shape, np.intp, points.scratch)
    for block in arrays.iter_blocks(owner, out):
        out[block] = new_number(owner[block])
    return out


_WINDOW, _MIN_WINDOW_SCANS = 1.5, 5  # s, and detections at least
_OVERLAP = 3  # windows that begin within one
_MAX_GAP = 0.5  # s without a detection
_MIN_WINDOW_TRAVEL = 0.5  # m
_SCATTER, _RELATIVE_SCATTER = 0.03, 0.15  # m off the line (rms), and more as share of the travel


def count_steady_windows(t: Float, xy: Float, period: float) -> tuple[float, float]:
    """Windows along a track, and those in which it moves along a line at constant velocity.

    Windows overlap; their number is divided by how many do, so that they count as independent.

    Args:
        t: (L,) seconds, rising.
        xy: (L, 2) metres.
        period: seconds from scan to scan.
    """
    length, max_gap = max(_WINDOW, _MIN_WINDOW_SCANS * period), max(_MAX_GAP, 1.5 * period)
    start = np.arange(t[0], t[-1] - length + 1e-6, length / _OVERLAP)
    if not len(start):
        return 0.0, 0.0
    low, high = np.searchsorted(t, start), np.searchsorted(t, start + length, side="right")
    enough = high - low >= _MIN_WINDOW_SCANS
    start, low, high = start[enough], low[enough], high[enough]
    breaks = np.concatenate([[0], np.cumsum(np.diff(t) > max_gap)])
    whole = breaks[high - 1] == breaks[low]
    whole &= (t[low] - start <= max_gap) & (start + length - t[high - 1] <= max_gap)
    speed, scatter = _fit_lines(t - t[0], xy - xy[0], low, high)
    travel = speed * length
    steady = (travel >= _MIN_WINDOW_TRAVEL) & (scatter <= _SCATTER + _RELATIVE_SCATTER * travel)
    return len(enough) / _OVERLAP, float(np.count_nonzero(whole & steady)) / _OVERLAP


def _fit_lines(t: Float, xy: Float, low: Index, high: Index) -> tuple[Float, Float]:
    """Speed and rms distance (W,) of lines through detections low to high, over time."""
    terms = np.column_stack([t, t * t, xy, t[:, None] * xy, (xy**2).sum(axis=1)])
    sums = np.concatenate([np.zeros((1, terms.shape[1])), np.cumsum(terms, axis=0)])
    of, n = sums[high] - sums[low], high - low
    spread = np.maximum(of[:, 1] - of[:, 0] ** 2 / n, 1e-9)  # sum (t - mean t)^2
    moment = of[:, 4:6] - of[:, :1] * of[:, 2:4] / n[:, None]
    squares = of[:, 6] - (of[:, 2:4] ** 2).sum(axis=1) / n - (moment**2).sum(axis=1) / spread
    return np.linalg.norm(moment, axis=1) / spread, np.sqrt(np.maximum(squares, 0.0) / n)
