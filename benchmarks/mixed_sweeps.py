"""Runs of mixed worlds, lidars, methods and poses in 3D, drawn by their seed."""

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy  # its parts load when they are first used
from common import Scores, options_of
from numpy.typing import NDArray
from prepared import grid_of

import stillmap
from stillmap import slam
from stillmap.core import se2, se3
from stillmap.core.profiling import StageTimer, no_progress
from stillmap.pipeline.final_map import FinalEstimate, make_maps
from stillmap.results.eval.labels import score_labels
from stillmap.results.eval.map import GHOST_DISTANCE, is_near_occupied
from stillmap.results.eval.trajectory import align, compute_absolute_errors
from stillmap.results.reader import Grid, moved
from stillmap.sim import Simulation, scene_by_name, simulate

Float = NDArray[np.float64]

WORLDS = ("street", "street-jam", "street-turn", "crossing", "hall", "corridor", "office")
LIDARS: dict[str, dict[str, Any]] = {
    "16 channels": {"channels": 16, "columns": 900},
    "32 channels": {"channels": 32, "columns": 600},
    "64 channels": {"channels": 64, "columns": 600},
    "32 channels, at once": {"channels": 32, "columns": 600, "sweep": False},
}
SCANS = (40, 80, 120)
# method and size of its voxels in m; as printed it takes minutes with smaller ones
METHODS = (
    ("stillmap", 0.1),
    ("stillmap", 0.15),
    ("stillmap", 0.2),
    ("stillmap", 0.3),
    ("paper", 0.3),
    ("paper", 0.4),
)
# m and rad per sqrt(sweep) that the poses given are off by; None: stillmap estimates them
POSES: dict[str, float | None] = {
    "estimated": None,
    "estimated from scans": None,
    "true": 0.0,
    "drift of 5 mm": 0.005,
    "drift of 2 cm": 0.02,
    "drift of 6 cm": 0.06,
}
_TURN = 0.15  # rad of the drift for each metre of it


@dataclass(frozen=True)
class MixedSweeps:
    """One run; every property is drawn by the seed."""

    seed: int
    world: str
    laser: str
    scans: int
    voxel: float
    method: str
    odometry: str

    def simulate(self) -> Simulation:
        """Its world and lidar."""
        changes = {"lidar": LIDARS[self.laser], "robot": {"scans": self.scans}}
        return simulate(scene_by_name(self.world, changes), self.seed)

    def options(self) -> stillmap.Options:
        """Method and size of voxels."""
        return options_of(self.method, [f"slam.voxel_size={self.voxel}"])

    def inputs(self, simulation: Simulation) -> tuple[stillmap.Recording, Float | None]:
        """The recording as it is mapped, and the poses given."""
        recording, drift = simulation.recording, POSES[self.odometry]
        if drift is not None:
            rng = np.random.default_rng([self.seed, 2])
            return recording, drifted(simulation.truth.T_world_base, drift, rng)
        return (recording if self.odometry == "estimated" else recording.without_odometry()), None


def draw(seed: int) -> MixedSweeps:
    """The run of a seed."""
    rng = np.random.default_rng([seed, 29])

    def one(values: Any) -> Any:
        values = list(values)
        return values[int(rng.integers(len(values)))]

    world, laser, scans = one(WORLDS), one(LIDARS), one(SCANS)
    method, voxel = one(METHODS)
    return MixedSweeps(seed, world, laser, scans, voxel, method, one(POSES))


def drifted(poses: Float, drift: float, rng: np.random.Generator) -> Float:
    """Poses (T, 4, 4) with errors of each step, in the plane, that add up."""
    steps = se2.inverse(poses[:-1]) @ poses[1:]
    off = drift * rng.standard_normal((len(steps), 3)) * (1.0, 1.0, _TURN)
    turned = np.tile(np.eye(4), (len(steps), 1, 1))
    planar = se2.matrix(*off.T)
    turned[:, :2, :2], turned[:, :2, 3] = planar[:, :2, :2], planar[:, :2, 2]
    out = np.empty_like(poses)
    out[0] = poses[0]
    for t, step in enumerate(steps @ turned):
        out[t + 1] = out[t] @ step
    return se3.normalize(out)


def scores_of(result: stillmap.Result, simulation: Simulation) -> Scores:
    """Labels against the truth, poses against the true ones, the map against that of the truth.

    Walls are the occupied cells of the map that true poses and true labels give.
    """
    truth = simulation.truth
    labels = score_labels(result.p_static, truth.static, simulation.recording.hit)
    of_truth, grid = grid_of(_map_of_truth(result, simulation)), grid_of(result.map)
    T_world_map = se2.project_to_plane(align(result.poses, truth.T_world_base)[None])[0]
    walls = of_truth.centres(np.argwhere(of_truth.occupied))
    kept = is_near_occupied(grid, moved(se2.inverse(T_world_map), walls))
    return {
        "f1": labels.f1,
        "ate": compute_absolute_errors(result.poses, truth.T_world_base).rmse,
        "walls": float(kept.mean()) if len(kept) else float("nan"),
        "ghosts": _ghosts_per_100_m2(grid, walls, T_world_map),
    }


def _map_of_truth(result: stillmap.Result, simulation: Simulation) -> stillmap.em.OccupancyMap:
    """The map, with the options of a result, of true poses and labels."""
    truth, estimate, options = simulation.truth, result.estimate, result.options
    m_step = dataclasses.replace(estimate.m_step, poses=truth.T_world_base)
    labels = truth.static.astype(np.float32)
    e_step = dataclasses.replace(estimate.e_step, p_static=labels, occupied=None, ground=None)
    true = dataclasses.replace(estimate, m_step=m_step, e_step=e_step)
    deskewed = slam.deskew_recording(simulation.recording, truth.T_world_base, options.slam)
    final = FinalEstimate(deskewed, true, [], [])
    return make_maps(final, options, no_progress, StageTimer()).filtered


def _ghosts_per_100_m2(grid: Grid, walls: Float, T_world_map: Float) -> float:
    """Occupied cells that lie far from all cells of walls (K, 2), by free area."""
    occupied = moved(T_world_map, grid.centres(np.argwhere(grid.occupied)))
    free = float(np.count_nonzero(grid.free)) * grid.resolution**2
    if not len(walls) or not free:
        return float("nan")
    distance, _ = scipy.spatial.cKDTree(walls).query(occupied)
    ghosts = np.count_nonzero(distance > GHOST_DISTANCE * grid.resolution)
    return 100.0 * float(ghosts) / free
