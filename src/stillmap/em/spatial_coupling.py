"""Spatial coupling of surfels in 3D: mean field, cluster pooling, far ground, ground contact.

Objects are larger than a voxel, so neighbouring voxels and the clusters of a sweep are labelled
together. `docs/estimator.md` has the equations.
"""

from dataclasses import dataclass, replace

import numpy as np

import stillmap._core as _core
from stillmap.core.array_types import Bool, Float, Float32, Int32
from stillmap.core.chunks import ScanBeams, iter_beams
from stillmap.core.recording import Recording
from stillmap.em.observations import iter_surfel_rows
from stillmap.em.types import DYNAMIC_BELOW, MIN_PROBABILITY, GroundMap

_MEAN_FIELD = {
    "radius": 2.5,  # voxels
    "coplanar_std": 0.2,  # voxels, of a mean from the plane of a neighbour
    "static_coupling": 5.0,  # nats if all neighbours are static
    "dynamic_coupling": 10.0,  # nats if all are dynamic
    "min_log_odds": -4.0,  # of a surfel's own observations
    "max_log_odds": 3.0,  # the same; ten seconds of hits fit a wall and a person who waits
    "tolerance": 0.1,  # change of P(static) above which neighbours are updated again
    "max_iterations": 10,
}

_MIN_CLUSTER_HEIGHT, _MAX_CLUSTER_HEIGHT = 0.2, 3.0  # m above the ground, of obstacles
_COLUMN = 0.3  # m, edge of the columns that touch within a cluster, rounded to voxels
_MIN_CLUSTER_SURFELS = 5  # in a sweep
_POOLED_P_DYNAMIC = 0.3  # mean P(dynamic) above which a whole cluster is dynamic
_POOLED_CHANGE = 1.0  # nats, mean evidence of a change above which it is dynamic
_POOLING_SLOPE = 20.0  # nats per unit above these two
_MAX_POOLED = 4.0  # nats
GROUND_CLEARANCE = 0.05  # m; end points closer to the ground belong to it
_CLEARANCE_STD = 2.5  # the same in noise_std; the larger of the two counts


def smooth_mean_field(
    p_static: Float32, surfel_map: _core.SurfelMap3D, threads: int = 1
) -> Float32:
    """(E,) P(static) of each surfel given its own observations and its neighbours.

    Args:
        p_static: (E,) given each surfel's own observations.
        surfel_map: E surfels, with the time bins of their end points.
        threads: does not change the result.

    Mean field of a Potts model:
    log odds_i = clip(o_i, -4, 3) + (5 S_i - 10 M_i) / (1 + W_i).
    """
    p = np.clip(p_static, MIN_PROBABILITY, 1.0 - MIN_PROBABILITY)
    log_odds = np.log(p / (1.0 - p)).astype(np.float32)
    return _core.smooth_mean_field(
        surfel_map,
        log_odds,
        **_MEAN_FIELD,  # type: ignore[arg-type]
        threads=threads,
    )


@dataclass(frozen=True, eq=False)
class ObstacleSurfels:
    """Which surfels are on the ground, and which above it.

    Attributes:
        surfel_map: E surfels in 3D.
        is_obstacle: (E,) bool, 0.2 to 3 m above the ground.
        is_ground: (E,) bool, at most `min_end_height` above or below the ground.
        was_dynamic: (E,) bool, on the ground, and dynamic before `label_far_ground`.
        ground_height: (E,) float32 metres, of the ground below each surfel.
        column_cells: voxels, edge of the columns that touch within a cluster.
    """

    surfel_map: _core.SurfelMap3D
    is_obstacle: Bool
    is_ground: Bool
    was_dynamic: Bool
    ground_height: Float32
    column_cells: int

    @property
    def min_end_height(self) -> float:
        """Metres above the ground; a beam that ends lower ended on the ground."""
        return _clearance(self.surfel_map)

    def label_ground_contact(
        self, p_static: Float32, data: ScanBeams, surfel: Int32, threads: int = 1
    ) -> Float32:
        """(M,) P(static) of the mover above each end point near the ground; NaN: none.

        Args:
            p_static: (E,) of each surfel.
            data: M beams of some scans.
            surfel: (M,) index of the surfel in which each ended, -1: none.
            threads: does not change the result.
        """
        return _core.relabel_ground_contact(
            self.surfel_map,
            *data,
            surfel,
            is_obstacle=self.is_obstacle,
            p_static=p_static,
            ground_height=self.ground_height,
            at_any_height=self.was_dynamic,
            column_cells=self.column_cells,
            max_ground_height=_MIN_CLUSTER_HEIGHT,
            min_end_height=self.min_end_height,
            threads=threads,
        )


def select_obstacles(ground: GroundMap, surfels: _core.SurfelMap3D) -> ObstacleSurfels | None:
    """The surfels of obstacles on the ground; None where no ground was observed."""
    if not ground.observed:
        return None
    is_obstacle, is_ground = (np.empty(surfels.size, np.bool_) for _ in range(2))
    ground_height = np.empty(surfels.size, np.float32)
    for rows in iter_surfel_rows(surfels):
        means = surfels.surfels(rows)[1]
        below = ground.height_at(means[:, :2])
        above = means[:, 2] - below
        is_obstacle[slice(*rows)] = (above > _MIN_CLUSTER_HEIGHT) & (above < _MAX_CLUSTER_HEIGHT)
        is_ground[slice(*rows)] = np.abs(above) <= _clearance(surfels)
        ground_height[slice(*rows)] = below
    column_cells = max(1, round(_COLUMN / surfels.resolution))
    none = np.zeros(surfels.size, np.bool_)
    return ObstacleSurfels(surfels, is_obstacle, is_ground, none, ground_height, column_cells)


def _clearance(surfel_map: _core.SurfelMap3D) -> float:
    return max(GROUND_CLEARANCE, _CLEARANCE_STD * surfel_map.noise_std)


def label_far_ground(
    p_static: Float32, obstacles: ObstacleSurfels
) -> tuple[Float32, ObstacleSurfels]:
    """Raise P(static) of the surfels on the ground to at least their mean.

    Far away the rings of a lidar lie metres apart on the ground: no plane can be fitted, and as the
    robot moves, beams of one ring graze where those of another ended, which then seems to be empty.

    Args:
        p_static: (E,) of each surfel.
        obstacles: of the same surfels.

    Returns:
        (E,) P(static); the obstacles with `was_dynamic`, so that beams that end there below a mover
        are labelled by it (`ObstacleSurfels.label_ground_contact`).
    """
    is_ground = obstacles.is_ground
    if not is_ground.any():
        return p_static, obstacles
    mean = p_static[is_ground].mean(dtype=np.float64)
    was_dynamic = is_ground & (p_static < DYNAMIC_BELOW)
    out = np.where(is_ground, np.maximum(p_static, np.float32(mean)), p_static)
    return out, replace(obstacles, was_dynamic=was_dynamic)


def pool_clusters(
    p_static: Float32,
    change: Float32,
    obstacles: ObstacleSurfels,
    recording: Recording,
    poses: Float,
    threads: int = 1,
) -> Float32:
    """(E,) P(static), lowered for surfels of clusters that move, arrived or left.

    Args:
        p_static: (E,) after `smooth_mean_field`.
        change: (E,) nats, log likelihood ratio of changed to static.
        obstacles: the surfels that form clusters.
        recording: 3D, M beams, deskewed.
        poses: (T, 4, 4) T_map_base.
        threads: does not change the result.
    """
    pooling = _core.ClusterPooling3D(
        obstacles.surfel_map,
        obstacles.is_obstacle,
        np.stack([1.0 - p_static, change], axis=1),
        column_cells=obstacles.column_cells,
        min_surfels=_MIN_CLUSTER_SURFELS,
    )
    for *_, data in iter_beams(recording, poses):
        pooling.add(*data, threads)
    return apply_pooled_evidence(p_static, pooling.means())


def apply_pooled_evidence(p_static: Float32, means: Float32) -> Float32:
    """(E,) log odds = min(own, -min(20 max(a - 0.3, b - 1), 4)).

    Args:
        p_static: (E,) own.
        means: (E, 2) a and b of each surfel's clusters: mean P(dynamic), and mean evidence of a
            change in nats; NaN where it is in no cluster.
    """
    least = np.array([_POOLED_P_DYNAMIC, _POOLED_CHANGE], np.float32)
    above = np.nan_to_num(means - least, nan=-1.0)
    nats = np.minimum(_POOLING_SLOPE * above.max(axis=1), _MAX_POOLED)
    lower = np.where(nats > 0.0, 1.0 / (1.0 + np.exp(nats)), 1.0)
    return np.minimum(p_static, lower.astype(np.float32))
