"""The polygons of range images: neighbouring beams that hit the same surface (Sect. 4.5).

How a sensor looks about is told by its beams, whatever the recording was read from:

- scans whose beams lie in a plane through the sensor are rows, and scans that follow one another
  are neighbours, in whatever direction a joint turns them;
- scans that are cut into rows of equal length, as depth pictures and the columns of lidars are;
- scans in rows of different lengths, as the rings of lidars without the beams that were lost;
- all others: the Delaunay triangulation of the directions.

In which order a sensor looks about: by rows of beams, by a plane at a time, or in any.
"""

from collections.abc import Callable, Iterator
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay, QhullError

from stillmap.core.recording import Recording
from stillmap.mesh.options import SurfaceOptions
from stillmap.mesh.triangulation import (
    filter_faces,
    split_rows,
    triangulate_grid,
    triangulate_strips,
)

Float = NDArray[np.float64]

Index = NDArray[np.intp]

_SAMPLES = 2000  # beams that are asked

_SHORTEST = 4  # beams in a row

_NEXT = 0.15  # rad, between neighbours in a row or in a column, at most

_STEPS = 30.0  # as far as so many beams of a row may two rows be from each other

_ACROSS = 0.5  # cosine between a row and a column

_FLAT = 0.04  # rad from a plane, of the beams of a planar laser: it may sit off the joint

_WIDE = 0.2  # rad, what these spread within the plane


def beam_directions(points: NDArray[np.floating]) -> Float:
    """(n, 3) of length one, NaN where points (n, 3) are, or lie in the sensor."""
    wide = points.astype(np.float64)
    length = np.linalg.norm(wide, axis=1, keepdims=True)
    return np.asarray(wide / np.where(length > 0.0, length, np.nan))


def find_row_length(looking: Float) -> int:
    """How many beams each row of a range image has; 0: beams are in no such order.

    Between neighbours in a row directions change little, and across from row to row, at a right
    angle. Of the lengths that divide the number of beams the shortest one for which this holds.

    Args:
        looking: (n, 3) directions of the beams, row by row, NaN where unknown.
    """
    n = len(looking)
    step = max(n // _SAMPLES, 1)
    for length in range(_SHORTEST, n // 2 + 1):
        if n % length == 0 and _is_row(looking, length, step):
            return length
    return 0


def _is_row(looking: Float, length: int, step: int) -> bool:
    # not all in one column
    k = np.arange(0, len(looking) - length - 1, step)
    k += np.arange(len(k)) % 7
    k = k[(k + length < len(looking)) & (k % length != length - 1)]
    along, across = looking[k + 1] - looking[k], looking[k + length] - looking[k]
    known = np.isfinite(along).all(axis=1) & np.isfinite(across).all(axis=1)
    if np.count_nonzero(known) < max(8, len(k) // 20):
        return False
    along, across = along[known], across[known]
    one, other = np.linalg.norm(along, axis=1), np.linalg.norm(across, axis=1)
    usual, farthest = float(np.median(one)), float(np.percentile(other, 90))
    if not 0.0 < usual <= _NEXT or not 0.0 < farthest <= min(_NEXT, _STEPS * usual):
        return False
    cosine = np.abs(np.einsum("ni,ni->n", along, across)) / np.maximum(one * other, 1e-300)
    return float(np.median(cosine)) < _ACROSS


def is_planar(looking: Float) -> bool:
    """Whether beams with directions (n, 3), NaN where unknown, all lie in one plane."""
    known = looking[np.isfinite(looking).all(axis=1)]
    if len(known) < _SHORTEST:
        return False
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(known.T @ known / len(known)), 0.0))
    return bool(spread[0] < _FLAT and spread[1] > _WIDE)


def median_angle(one: Float, other: Float) -> float:
    """rad, median angle between directions (n, 3) and (n, 3); NaN where none are known of both."""
    chord = np.linalg.norm(one - other, axis=1)
    known = chord[np.isfinite(chord)]
    return float(2.0 * np.arcsin(0.5 * np.median(known))) if len(known) else float("nan")


_ROWS = 128  # planar scans worked on together

_SAME = 0.2  # of the usual angle between rows: nearer ones are the same row

_FAR = 4.0  # times the usual angle between rows, farther ones are no neighbours

_SEAM = 0.2  # rad by which a turn goes on beyond its end

_NARROW = 0.5  # cosine of the angle from the middle of a picture to its corners, at least


class Patch(NamedTuple):
    """Polygons of a range image, or of neighbouring planar scans.

    Attributes:
        points: (n, 3) metres.
        faces: (m, 3) int32, counter-clockwise seen from the sensor.
        beam: (n,) that each point is of, in the recording.
        origin: (n, 3) where the sensor was, in the frame of the points.
        standoff: (n,) metres from there to the surface's tangent plane at the point.
    """

    points: Float
    faces: NDArray[np.int32]
    beam: Index
    origin: Float
    standoff: Float


class ScanLayout(NamedTuple):
    """In which order the beams of a recording come.

    Attributes:
        planar: whether scans are rows.
        groups: of scans: a range image each, or planar ones that follow one another.
        stride: of pictures only each so many-th row and column is used.
    """

    is_planar: bool
    groups: list[Index]
    stride: int = 1


def find_scan_layout(seen: Recording, chosen: Index, o: SurfaceOptions) -> ScanLayout:
    """How the sensors look about.

    Args:
        seen: 3D.
        chosen: of its scans, those to be used; where scans are rows, all are.
        o: see SurfaceOptions.
    """
    counts = np.diff(seen.offset)
    asked = np.unique(np.linspace(0, seen.n_scans - 1, min(seen.n_scans, 9)).astype(np.intp))
    planar = [is_planar(beam_directions(seen.points[seen.beams_of(t)])) for t in asked]
    if sum(planar) * 2 > len(planar) and len(np.unique(counts[counts > 0])) == 1:
        return ScanLayout(True, _sequences(seen, o.pause))
    return ScanLayout(False, [np.array([t]) for t in chosen if counts[t]])


def _sequences(seen: Recording, pause: float) -> list[Index]:
    """Planar scans that follow one another, each sequence beginning where the last one ended."""
    out = []
    # a laser on a joint may count as another sensor at each scan, where it sits otherwise
    once = np.bincount(seen.sensor, minlength=len(seen.T_base_sensor)) == 1
    of_sensor = np.where(once[seen.sensor], np.int32(-1), seen.sensor)
    for sensor in np.unique(of_sensor):
        scans = np.flatnonzero((of_sensor == sensor) & (np.diff(seen.offset) > 0))
        ends = np.flatnonzero(np.diff(seen.stamp_ns[scans]) > pause * 1e9) + 1
        for part in np.split(scans, ends):
            for first in range(0, max(len(part) - 1, 0), _ROWS):
                out.append(part[first : first + _ROWS + 1])
    return sorted(out, key=lambda part: int(part[0]))


def triangulate_scans(
    seen: Recording, poses: Float, order: ScanLayout, o: SurfaceOptions
) -> Iterator[Callable[[], Patch]]:
    """What makes each patch, in the order of the scans.

    Args:
        seen: 3D, without motion during its scans.
        poses: (T, 4, 4) T_map_base.
        order: see `order_of`.
        o: limits.
    """
    T = seen.T_map_sensor(poses)
    lengths: dict[tuple[int, int], int] = {}
    for scans in order.groups:
        yield partial(_patch, seen, T, scans, order, lengths, o)


def _patch(
    seen: Recording,
    T_map_sensor: Float,
    scans: Index,
    order: ScanLayout,
    lengths: dict[tuple[int, int], int],
    o: SurfaceOptions,
) -> Patch:
    beam = np.concatenate([np.arange(seen.offset[t], seen.offset[t + 1]) for t in scans])
    local = seen.points[beam].astype(np.float64)
    scan = np.repeat(np.arange(len(scans)), np.diff(seen.offset)[scans])
    T = T_map_sensor[scans]
    bounds = np.concatenate([[0], np.cumsum(np.diff(seen.offset)[scans])])
    points = np.concatenate(
        [
            local[i:j] @ one[:3, :3].T + one[:3, 3]
            for one, (i, j) in zip(T, pairwise(bounds), strict=True)
        ]
    )
    origin = T[scan, :3, 3]
    x, y, z = points.T
    use = seen.hit[beam] & np.isfinite(x + y + z)
    points[~use] = 0.0  # nothing is made of these
    looking = beam_directions(local)
    if order.is_planar:
        turned = seen.T_base_sensor[seen.sensor[scans], :3, :3]
        looking = np.einsum("nij,nj->ni", turned[scan], looking)
        number = np.arange(len(beam), dtype=np.int32).reshape(len(scans), -1)
        faces = _between_rows(points, use, number, looking)
    else:
        key = (int(seen.sensor[scans[0]]), len(beam))
        if key not in lengths:
            lengths[key] = find_row_length(looking)
        faces = _of_image(points, use, looking, lengths[key], order.stride, o)
    kept = filter_faces(points, origin, faces, o)
    used = np.zeros(len(points), np.bool_)
    used[kept.faces] = True
    number = np.cumsum(used, dtype=np.int32) - np.int32(1)
    return Patch(points[used], number[kept.faces], beam[used], origin[used], kept.standoff[used])


def _between_rows(
    points: Float, use: NDArray[np.bool_], number: NDArray[np.int32], looking: Float
) -> NDArray[np.int32]:
    """Triangles between planar scans that follow one another, (R, W) numbers of their points."""
    angle = np.array([median_angle(looking[a], looking[b]) for a, b in pairwise(number)])
    usual = float(np.nanmedian(angle)) if np.isfinite(angle).any() else 0.0
    kept, gone = [0], 0.0
    breaks = []
    for row, step in enumerate(angle, start=1):
        gone += step if np.isfinite(step) else 0.0
        if gone < _SAME * usual and row < len(number) - 1:
            continue
        if gone > _FAR * usual:
            breaks.append(len(kept))
        kept.append(row)
        gone = 0.0
    parts = np.split(number[kept], breaks)
    faces = [triangulate_grid(points, use, part) for part in parts if len(part) > 1]
    return np.concatenate([np.zeros((0, 3), np.int32), *faces])


def _of_image(
    points: Float,
    use: NDArray[np.bool_],
    looking: Float,
    length: int,
    stride: int,
    o: SurfaceOptions,
) -> NDArray[np.int32]:
    """Triangles of one scan whose rows have a length, 0: of any order."""
    if not length:
        return _in_any_order(use, looking, o)
    number = np.arange(len(points), dtype=np.int32).reshape(-1, length)
    along = median_angle(looking[:-1], looking[1:])
    across = median_angle(looking[:-length], looking[length:])
    if median_angle(looking[number[:, -1]], looking[number[:, 0]]) < 2.0 * along:
        number = np.concatenate([number, number[:, :1]], axis=1)
    if len(number) > 2 and median_angle(looking[number[-1]], looking[number[0]]) < 2.0 * across:
        number = np.concatenate([number, number[:1]])
    return triangulate_grid(points, use, number[::stride, ::stride])


def _in_any_order(use: NDArray[np.bool_], looking: Float, o: SurfaceOptions) -> NDArray[np.int32]:
    """Triangles between beams that are used; none spans much more than most do."""
    beams = np.flatnonzero(use)
    if len(beams) < 3:
        return np.zeros((0, 3), np.int32)
    seen = looking[beams]
    rows_found = split_rows(seen)
    faces = triangulate_directions(seen) if rows_found is None else triangulate_strips(rows_found)
    if not len(faces):
        return faces
    chord = np.linalg.norm(seen[faces] - np.roll(seen[faces], 1, axis=1), axis=2).max(axis=1)
    faces = faces[chord <= o.widest * np.median(chord)]
    return np.asarray(beams[faces], np.int32)


def triangulate_directions(looking: Float) -> NDArray[np.int32]:
    """(m, 3) the Delaunay triangulation of directions (n, 3) of length one."""
    middle = looking.mean(axis=0)
    middle /= max(float(np.linalg.norm(middle)), 1e-12)
    if float((looking @ middle).min()) > _NARROW:
        side = np.linalg.svd(middle[None])[2][1:]
        plane, of = (looking @ side.T) / (looking @ middle)[:, None], np.arange(len(looking))
    else:
        plane, of = _unrolled(looking)
    try:
        found = Delaunay(plane).simplices
    except QhullError:  # all in one line
        return np.zeros((0, 3), np.int32)
    found = found[np.abs(plane[found].mean(axis=1)[:, 0]) <= np.pi]
    faces = of[found].astype(np.int32)
    return np.asarray(faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2])])


def _unrolled(looking: Float) -> tuple[Float, Index]:
    """Azimuth and elevation, going on beyond a turn on both sides, and which beam each is of."""
    azimuth = np.arctan2(looking[:, 1], looking[:, 0])
    elevation = np.arcsin(np.clip(looking[:, 2], -1.0, 1.0))
    plane, of = np.stack([azimuth, elevation], axis=1), np.arange(len(looking))
    low, high = azimuth < _SEAM - np.pi, azimuth > np.pi - _SEAM
    turn = np.array([2.0 * np.pi, 0.0])
    both = np.concatenate([plane, plane[low] + turn, plane[high] - turn])
    return both, np.concatenate([of, of[low], of[high]])
