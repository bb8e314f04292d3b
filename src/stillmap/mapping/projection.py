"""A 3D recording as a 2D one sees it: what is in the way of a robot, and where it may go.

Above the ground lies a band as high as the robot. Where a beam ends within it, something is in the
way; as far as a beam runs within it, nothing is. So each sweep becomes one scan of a laser that
looks all around, and everything that is known of planar recordings holds for it.

Options of what counts as being in the robot's way.

Parts of a recording in space as a recording in the plane.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stillmap import em
from stillmap.core import se2
from stillmap.core.arrays import ArrayBuilder, finite_rows, first_index_per_group
from stillmap.core.config import option
from stillmap.core.parallel import map_ordered
from stillmap.core.recording import Recording
from stillmap.em import GroundMap

Float = NDArray[np.float64]

Index = NDArray[np.intp]


@dataclass(frozen=True)
class BandOptions:
    """Of 3D recordings the map shows what stands in a band above the ground."""

    low: float = option(0.2, "m above the ground from where on something is in the way")
    high: float = option(1.8, "m above the ground up to where something is in the way")

    def __post_init__(self) -> None:
        if not 0.0 <= self.low < self.high <= 100.0:
            raise ValueError("'output.band' wants 0 <= low < high <= 100 metres")


def make_planar_recording(
    recording: Recording,
    points: NDArray[np.float32],
    hit: NDArray[np.bool_],
    offset: NDArray[np.int64],
) -> Recording:
    """The same scans with other beams, of one sensor in the middle of the robot.

    Args:
        recording: 3D, T scans.
        points, hit, offset: (N, 2), (N,), (T + 1,); see Recording.
    """
    return replace(
        recording,
        points=points,
        hit=hit,
        offset=offset,
        T_base_sensor=np.eye(3)[None],
        sensor=np.zeros(recording.n_scans, np.int32),
        T_odom_base=None,
        T_recorded_base=None,
        beam_time=None,
        images=None,
    )


DIRECTIONS = 2048  # of the beams of a scan; at 50 m 15 cm apart

_ABOVE = 0.05  # m by which the band reaches above the sensor


@dataclass(frozen=True, eq=False)
class PlanarProjection:
    """The planar recording of a 3D one, T scans with N beams.

    Attributes:
        recording: 2D; scan t is of scan t. Beams that did not end in the band show free space up to
            where they left it.
        poses: (T, 3, 3) T_map_sensor, the sensor's place with its heading.
        beam: (N,) which beam of the 3D recording each is of.
    """

    recording: Recording
    poses: Float
    beam: Index


def project_to_plane(
    recording: Recording,
    poses: Float,
    ground: GroundMap,
    options: BandOptions,
    cell: float,
    open_space: bool,
    threads: int = 1,
) -> PlanarProjection:
    """What the beams of a 3D recording say of the band above the ground.

    Of beams in the same direction that end nowhere in the band, the longest is kept; of those that
    end in the same cell, the first.

    Args:
        recording: 3D, M beams without motion during its scans.
        poses: (T, 4, 4) T_map_base.
        ground: how high it is.
        options: see BandOptions.
        cell: metres of one cell of a map.
        open_space: whether beams without a return show free space.
        threads: same result with any number.
    """
    T_map_sensor = recording.T_map_sensor(poses)
    planar_poses = se2.project_to_plane(T_map_sensor)
    top = max(options.high, ground.sensor_height + _ABOVE)
    scratch, offset = recording.scratch, np.zeros(recording.n_scans + 1, np.int64)
    ends, hits = ArrayBuilder(np.float32, (2,), scratch), ArrayBuilder(np.bool_, (), scratch)
    numbers = ArrayBuilder(np.intp, (), scratch)

    def of_scan(t: int) -> tuple[NDArray[np.float32], NDArray[np.bool_], Index]:
        beams = recording.beams_of(t)
        xy, hit, number = _of_scan(
            recording.points[beams], recording.hit[beams], T_map_sensor[t], ground,
            (options.low, options.high, top), cell, open_space,
        )  # fmt: skip
        local = (xy - planar_poses[t, :2, 2]) @ planar_poses[t, :2, :2]
        return local.astype(np.float32), hit, beams.start + number

    in_turn = recording.iter_scans(range(recording.n_scans))
    for t, (local, hit, number) in enumerate(map_ordered(of_scan, in_turn, threads)):
        ends.append(local)
        hits.append(hit)
        numbers.append(number)
        offset[t + 1] = offset[t] + len(number)
    flat = make_planar_recording(recording, ends.finish(), hits.finish(), offset)
    return PlanarProjection(flat, planar_poses, numbers.finish())


def _of_scan(
    points: NDArray[np.float32],
    hit: NDArray[np.bool_],
    T: Float,
    ground: GroundMap,
    heights: tuple[float, float, float],
    cell: float,
    open_space: bool,
) -> tuple[Float, NDArray[np.bool_], Index]:
    """Ends (n, 2) in the map frame, whether something stands there, which beams these are."""
    low, high, top = heights
    at = np.flatnonzero(finite_rows(points) & (hit | open_space))
    end: Float = points.take(at, axis=0).astype(np.float64) @ T[:3, :3].T + T[:3, 3]
    start = T[:3, 3] - [0.0, 0.0, ground.height_at(T[None, :2, 3])[0]]
    above: Float = end[:, 2] - ground.height_at(end[:, :2])
    stands = hit[at] & (above >= low) & (above <= high)
    share = _share_within(start[2], above, low, top)
    way = (end[:, :2] - T[:2, 3]) * share[:, None]
    length = np.sqrt(np.square(way[:, 0]) + np.square(way[:, 1]))
    direction = np.floor(np.arctan2(way[:, 1], way[:, 0]) * (DIRECTIONS / (2.0 * np.pi)))
    direction = direction.astype(np.int64) % DIRECTIONS
    kept = _kept(direction, length, stands, cell)
    return T[:2, 3] + way[kept], stands[kept], at[kept]


def _kept(direction: Index, length: Float, stands: NDArray[np.bool_], cell: float) -> Index:
    """Of hits the first per direction and cell, of the others the longest of each direction; of
    equals the first. By directions, hits after the others and the farther ones last."""
    rank = np.where(stands, 1 + np.floor(length / cell).astype(np.int64), 0)
    group = direction * (rank.max(initial=0) + 1) + rank
    hits, others = np.flatnonzero(stands), np.flatnonzero(~stands)
    hits = hits[first_index_per_group(group[hits])]
    longest = np.zeros(DIRECTIONS)
    np.maximum.at(longest, direction[others], length[others])
    others = others[length[others] == longest[direction[others]]]
    others = others[first_index_per_group(direction[others])]
    kept = np.concatenate([others, hits])
    return np.asarray(kept[np.argsort(group[kept])])


def _share_within(start: float, above: Float, low: float, top: float) -> Float:
    """(n,) the share of its way after which a beam leaves the band, at heights above the ground."""
    rise = above - start
    with np.errstate(divide="ignore", invalid="ignore"):
        down = np.where(above < low, (start - low) / -rise, 1.0)
        up = np.where(above > top, (top - start) / rise, 1.0)
    return np.clip(np.minimum(down, up), 0.0, 1.0)


def project_cells(
    known: em.CellProbabilities, ground: GroundMap, options: BandOptions, cell: float
) -> em.CellProbabilities:
    """The columns of a plan in which something stands within the band.

    Args:
        known: what is known of (K, 3) cells.
        ground, options: where the band is.
        cell: metres of one cell.
    """
    middle = np.asarray((known.cells + 0.5) * cell, np.float64)
    above = middle[:, 2] - ground.height_at(middle[:, :2])
    inside = (above >= options.low) & (above <= options.high)
    columns, of = np.unique(known.cells[inside, :2], axis=0, return_inverse=True)
    p = np.zeros(len(columns), np.float32)
    np.maximum.at(p, of.reshape(-1), known.p_occupied[inside])
    return em.CellProbabilities(columns, p, known.free_prior)
