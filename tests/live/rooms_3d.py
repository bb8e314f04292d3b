"""Two rooms with people for a small lidar: a thing in the first one is taken away and another one
is brought between two runs, and only the second run goes through the door into the second room."""

import numpy as np

from stillmap.core import se2
from stillmap.sim import simulate
from stillmap.sim.options import CrowdOptions, HeightOptions, LidarOptions, RobotOptions
from stillmap.sim.scene import Scene
from stillmap.sim.walls import box, pillar, wall
from stillmap.slam import deskew_recording
from stillmap.slam.options import SlamOptions

GONE, CAME = (4.5, 6.6, 1.6, 0.8), (10.5, 2.4, 0.8, 1.4)  # x, y, width, depth, m
DOOR = 14.0  # m, x of the wall between the rooms
FIRST_ROOM = ((3.0, 3.0), (8.0, 2.2), (11.8, 4.6), (8.0, 6.0))
BOTH_ROOMS = ((7.0, 6.2), (8.0, 2.6), (11.8, 4.4), (16.5, 4.4), (23.0, 2.0))
AND_BACK = ((17.0, 4.4), (11.0, 4.4))


def run_through_rooms(thing, route, scans, seed, people=5):
    """A recording of a lidar of 16 channels, and its truth."""
    walls = [
        *wall((0, 0), 14, "south", [(3, 1.5, 0.4)]),
        *wall((0, 9), 14, "north", [(8, 2, 0.6)]),
        *wall((0, 0), 9, "west", [(5.5, 1.2, 0.3)]),
        *wall((DOOR, 0), 9, "east", [(3.5, 1.8, 0.2, True)]),
        *[(DOOR, y, DOOR + 0.2, y) for y in (3.5, 5.3)],
        *wall((14.2, -3), 12, "south", [(7, 2.0, 0.5)]),
        *wall((14.2, 10), 12, "north", [(2, 1.0, 0.3)]),
        *wall((14.2, -3), 13, "west", [(6.5, 1.8, 0.2, True)]),
        *wall((26.2, -3), 13, "east", [(8, 1.2, 0.4)]),
        *pillar(6.5, 4.2, 0.3, 10),
        *pillar(19.5, 1.0, 0.35, 10),
    ]
    for case in (
        (1.2, 1.4, 1.2, 0.8),
        (9.3, 7.7, 1.5, 0.7, 0.2),
        (12.6, 7.5, 0.7, 1.6),
        (24.0, 7.5, 1.6, 1.0, 0.3),
        (16.5, -1.5, 0.9, 2.0),
        (21.0, 5.5, 2.4, 0.8),
        thing,
    ):
        walls += box(*case)
    scene = Scene(
        name="rooms",
        walls=tuple(walls),
        route=route,
        people_at=((7.0, 2.5),),
        crowd=CrowdOptions(people=people),
        heights=HeightOptions(ceiling=3.2, furniture=1.1),
        lidar=LidarOptions(channels=16, columns=360),
        robot=RobotOptions(scans=scans, speed=2.0, turn_rate=1.5),
    )
    return simulate(scene, seed)


def static_ends(simulation):
    """(N, 3) end points of the world that do not move, m."""
    poses = simulation.truth.T_world_base
    deskewed = deskew_recording(simulation.recording, poses, SlamOptions())
    use = np.flatnonzero(deskewed.hit & simulation.truth.static)
    return deskewed.end_points(use, poses)


def is_of(points, thing):
    """(N,) which of the points (N, 3) in the world lie on a thing."""
    x, y, width, depth = thing
    off = np.abs(points[:, :2] - [x, y]) - 0.5 * np.array([width, depth])
    return (off < 0.1).all(axis=1) & (points[:, 2] > 0.2) & (points[:, 2] < 1.3)


def to_world(simulation, points):
    """Points (N, 3) of the map of a simulated recording, in the world."""
    T = simulation.truth.T_world_base[0]
    return points @ T[:3, :3].T + T[:3, 3]


def true_poses(first, simulation):
    """(T, 4, 4) of a simulated recording in the map of another one."""
    return se2.inverse(first.truth.T_world_base[0]) @ simulation.truth.T_world_base
