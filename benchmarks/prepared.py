"""A simulated run together with the walls that a map of it should show."""

from dataclasses import dataclass

import numpy as np
from cases import Case
from numpy.typing import NDArray

from stillmap import _core, em
from stillmap.core import se2
from stillmap.core.recording import Recording
from stillmap.results.eval.map import MapScores, extract_wall_cells, score_map
from stillmap.results.reader import Grid
from stillmap.sim import Simulation, laser, simulate
from stillmap.sim.dynamics import transform_faces

Float = NDArray[np.float64]

RESOLUTION = 0.05  # m, of the maps that say which wall cells should be there


@dataclass(frozen=True, eq=False)
class Prepared:
    """A run and its references.

    Attributes:
        simulation: the run.
        walls_without_people: (K, 2) wall cells that the same run shows without people and
            vehicles: same poses, same doors and things.
        walls_at_best: (L, 2) those that the run itself shows with true labels and true poses:
            what somebody stood before all the time is in no one's reach.
        of_truth: scores of the map of (15) with true labels and true poses.
    """

    simulation: Simulation
    walls_without_people: Float
    walls_at_best: Float
    of_truth: MapScores


def prepare(case: Case, seed: int) -> Prepared:
    sim = simulate(case.build(), seed)
    walls, recording = sim.truth.walls, sim.recording
    empty = _map_of(sim, *without_people(sim, np.random.default_rng([seed, 1])))
    truth = _map_of(sim, recording.points, recording.hit, sim.truth.static)
    without = extract_wall_cells(empty, walls, np.eye(3))
    at_best = extract_wall_cells(truth, walls, np.eye(3))
    return Prepared(sim, without, at_best, score_map(truth, walls, without, np.eye(3)))


def without_people(
    sim: Simulation, rng: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.bool_]]:
    """The same run, at the same poses, without people and vehicles: points (M, 2), hit, static."""
    o, scene, truth = sim.scene.laser, sim.scene, sim.truth
    angles = laser.compute_beam_angles(o.beams, o.fov)
    poses = se2.parameters(sim.recording.T_map_sensor(truth.T_world_base))
    T = len(poses)
    nobody = laser.Movers(
        np.empty((T, 0, 2)), np.empty((T, 0)), np.empty((0, 2)), np.empty(0, np.int32)
    )
    exact = laser.cast_beams(poses, angles, truth.walls, nobody, doors_and_things(sim))
    is_glass = laser.find_glass(exact.wall, scene)
    ranges, hit = laser.simulate_measurement(exact.range, is_glass, o, rng)
    points = ranges[..., None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    static = hit & (exact.mover < 0)
    return points.reshape(-1, 2).astype(np.float32), hit.ravel(), static.ravel()


def doors_and_things(sim: Simulation) -> laser.Outlines:
    """The leaves of the doors that moved, and the things that did, at each scan."""
    doors, movers = moving_doors(sim), sim.truth.movers
    faces, mover = [doors.faces], [doors.mover]
    first = movers.shape[1] - len(sim.scene.things)
    for number, thing in enumerate(sim.scene.things, start=first):
        if np.isnan(movers[:, number]).any() or np.ptp(movers[:, number], axis=0).any():
            faces.append(transform_faces(thing, movers[:, number]))
            mover.append(np.full(len(thing.faces), number, np.int32))
    return laser.Outlines(np.concatenate(faces, axis=1), np.concatenate(mover))


def moving_doors(sim: Simulation) -> laser.Outlines:
    """The leaves of the doors that moved, at each scan."""
    movers, kinds = sim.truth.movers, sim.truth.scene["mover_kinds"]
    doors = np.flatnonzero(np.array(kinds) == "door")
    moved = np.any(np.ptp(movers[:, doors], axis=0) > 0, axis=1)
    poses = movers[:, doors[moved]]
    half = np.array([leaf.width / 2 for leaf in sim.scene.leaves])[moved, None]
    ahead = half * np.stack([np.cos(poses[..., 2]), np.sin(poses[..., 2])], axis=-1)
    faces = np.concatenate([poses[..., :2] - ahead, poses[..., :2] + ahead], axis=-1)
    return laser.Outlines(faces, doors[moved].astype(np.int32))


def grid_of(occupancy: em.OccupancyMap) -> Grid:
    """As evaluation wants it."""
    return Grid(occupancy.p_occupied, occupancy.origin, occupancy.resolution)


def counts(
    recording: Recording,
    points: NDArray[np.float32],
    hit: NDArray[np.bool_],
    weights: NDArray[np.float32],
    poses: Float,
) -> _core.OccupancyGrid2D:
    """The sums of (10) of these beams, taken at the recording's scans."""
    grid = _core.OccupancyGrid2D(RESOLUTION)
    _core.add_beams(grid, points, hit, weights, recording.offset, recording.T_map_sensor(poses), 1)
    return grid


def _map_of(
    sim: Simulation,
    points: NDArray[np.float32],
    hit: NDArray[np.bool_],
    static: NDArray[np.bool_],
) -> Grid:
    """The map of (15) at true poses."""
    weights, poses = static.astype(np.float32), sim.truth.T_world_base
    return grid_of(em.make_occupancy_map(counts(sim.recording, points, hit, weights, poses)))
