"""Things are larger than a voxel: what is beside an element tells of it. See `docs/space.md`.

What stands apart from all else moves as a whole, or stands still. See `docs/space.md`.

Which cells belong together.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy  # its parts load when they are first used
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core.chunks import iter_chunks
from stillmap.core.recording import Recording
from stillmap.em.observations import (
    Float,
    SurfelMap,
    iter_surfel_rows,
)
from stillmap.em.options import BesideOptions, BodyOptions
from stillmap.em.types import GroundMap

Index = NDArray[np.intp]

_CERTAIN = 1e-6


def smooth_mean_field(
    p_static: NDArray[np.float32], surface: SurfelMap, options: BesideOptions, threads: int = 1
) -> NDArray[np.float32]:
    """(E,) P(static) by the looks at each element alone (E,) and by the elements beside it.

    Args:
        p_static: (E,) by the looks alone.
        surface: the elements, in space; it knows the looks of its end points.
        options: see BesideOptions.
        threads: same result with any number.
    """
    if not options.enabled:
        return p_static
    if not isinstance(surface, _core.SurfelMap3D):
        raise TypeError("surface: expected one in space")
    p = np.clip(p_static, _CERTAIN, 1.0 - _CERTAIN)
    log_odds = np.log(p / (1.0 - p)).astype(np.float32)
    return _core.smooth_mean_field(surface, log_odds, **arguments(options), threads=threads)


def arguments(options: BesideOptions) -> dict[str, Any]:
    """Keyword arguments of `_core.smooth_mean_field`."""
    return {
        "radius": options.radius,
        "coplanar_std": options.coplanar,
        "static_coupling": options.for_static,
        "dynamic_coupling": options.for_dynamic,
        "min_log_odds": options.least,
        "max_log_odds": options.most,
        "tolerance": options.moved,
        "max_iterations": options.rounds,
    }


_SCATTERS = 2.5  # of end points about their surface, within which a beam ended on it


@dataclass(frozen=True, eq=False)
class ObstacleSurfels:
    """Which of E elements are of what stands on the ground.

    Attributes:
        surface: the elements, in space.
        stands: (E,) bool.
        ground: (E,) float32 metres, height of the ground below each.
        column: cells, edge of the columns over the ground that touch within a body.
    """

    surface: _core.SurfelMap3D
    stands: NDArray[np.bool_]
    ground: NDArray[np.float32]
    column: int


def select_obstacles(
    ground: GroundMap, surface: SurfelMap, options: BodyOptions
) -> ObstacleSurfels | None:
    """What stands on the ground; None where none was seen, and nobody knows, or wants to."""
    if not (options.enabled and ground.observed):
        return None
    if not isinstance(surface, _core.SurfelMap3D):
        raise TypeError("surface: expected one in space")
    stands, height = np.empty(surface.size, np.bool_), np.empty(surface.size, np.float32)
    for rows in iter_surfel_rows(surface):
        means = surface.surfels(rows)[1]
        below = ground.height_at(means[:, :2])
        above = means[:, 2] - below
        stands[slice(*rows)] = (above > options.low) & (above < options.high)
        height[slice(*rows)] = below
    column = max(1, round(options.column / surface.resolution))
    return ObstacleSurfels(surface, stands, height, column)


def pool_clusters(
    p_static: NDArray[np.float32],
    change: NDArray[np.float32],
    standing: ObstacleSurfels | None,
    recording: Recording,
    T_map_sensor: Float,
    options: BodyOptions,
    threads: int = 1,
) -> NDArray[np.float32]:
    """(E,) P(static), lowered for elements of bodies that move, or came or left.

    Args:
        p_static: (E,) by what is known of each element and of those right beside it.
        change: (E,) nats by which the looks at it say that a thing came or left; see `Told`.
        standing: what stands on the ground.
        recording: 3D, M beams without motion during its scans.
        T_map_sensor: (T, 4, 4).
        options: see BodyOptions.
        threads: same result with any number.
    """
    if standing is None:
        return p_static
    bodies = _core.ClusterPooling3D(
        standing.surface,
        standing.stands,
        np.stack([1.0 - p_static, change], axis=1),
        column_cells=standing.column,
        min_surfels=options.fewest,
    )
    for scans, beams, offset in iter_chunks(recording):
        points, hit = recording.points[beams], recording.hit[beams]
        bodies.add(points, hit, offset, T_map_sensor[scans], threads)
    return apply_pooled_evidence(p_static, bodies.means(), options)


def apply_pooled_evidence(
    p_static: NDArray[np.float32], means: NDArray[np.float32], options: BodyOptions
) -> NDArray[np.float32]:
    """(E,) lowered to log odds of slope (least - mean), -most at least, where that is negative.

    Args:
        p_static: (E,).
        means: (E, 2) of the bodies around each: probability to move, nats for a change; NaN: of
            none.
        options: `share` and `change` are the least values of these that tell.
    """
    above = np.nan_to_num(means - np.array([options.share, options.change], np.float32), nan=-1.0)
    nats = np.minimum(options.slope * above.max(axis=1), options.most)
    lower = np.where(nats > 0.0, 1.0 / (1.0 + np.exp(nats)), 1.0)
    return np.minimum(p_static, lower.astype(np.float32))


@dataclass(frozen=True, eq=False)
class GroundContact:
    """Asks of beams that end on the ground whether they met the feet of something that moves.

    Attributes:
        standing: what stands on the ground.
        p_static: (E,) of each element.
        low: m above the ground up to where an element's mean is the ground's.
        least: m above the ground from where on a beam did not end on it.
    """

    standing: ObstacleSurfels
    p_static: NDArray[np.float32]
    low: float
    least: float

    def of(
        self,
        points: NDArray[np.float32],
        hit: NDArray[np.bool_],
        offset: NDArray[np.int64],
        T_map_sensor: Float,
        element: NDArray[np.int32],
        threads: int = 1,
    ) -> NDArray[np.float32]:
        """(M,) P(static) of what moves over the end of each beam in its sweep; NaN: nothing does.

        Args:
            points, hit, offset, T_map_sensor: M beams of some scans.
            element: (M,) in which each ended, -1: none.
            threads: same result with any number.
        """
        return _core.relabel_ground_contact(
            self.standing.surface,
            points,
            hit,
            offset,
            T_map_sensor,
            element,
            is_obstacle=self.standing.stands,
            p_static=self.p_static,
            ground_height=self.standing.ground,
            column_cells=self.standing.column,
            max_ground_height=self.low,
            min_end_height=self.least,
            threads=threads,
        )


def make_ground_contact(
    standing: ObstacleSurfels | None, p_static: NDArray[np.float32], options: BodyOptions
) -> GroundContact | None:
    """Feet, as far as end points that scatter can tell them from the ground."""
    if standing is None:
        return None
    least = max(options.foot, _SCATTERS * standing.surface.noise_std)
    return GroundContact(standing, p_static, options.low, least)


def neighbor_pairs(cells: NDArray[np.int64], distance: float) -> Index:
    """(P, 2) which of the cells (K, D) lie within a distance of each other, in cells."""
    if not len(cells):
        return np.empty((0, 2), np.intp)
    return np.asarray(
        scipy.spatial.cKDTree(cells).query_pairs(distance, output_type="ndarray"), np.intp
    )


def connected_components(pairs: Index, n: int) -> list[Index]:
    """The members, rising, of every set of 0 to n - 1 that the pairs (P, 2) connect."""
    if n == 0:
        return []
    graph = scipy.sparse.coo_array(
        (np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(n, n)
    )
    _, label = scipy.sparse.csgraph.connected_components(graph, directed=False)
    order = np.argsort(label, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(label[order])) + 1)
