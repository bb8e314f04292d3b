"""A mirror shows what lies before it as far behind it."""

import math

import numpy as np

from stillmap.core.config import override
from stillmap.sim import Scene, simulate
from stillmap.sim.planar import MIRRORED
from stillmap.sim.walls import box, polyline

EXACT = {"range_noise": 0.0, "no_return_share": 0.0, "glass_no_return_share": 0.0}


def room(share=0.0, **changes):
    """A room of 10 x 6 m with a box in it, whose west wall is a mirror, at x = 0."""
    walls = (*polyline([(0, 0), (10, 0), (10, 6), (0, 6)]), *box(6.0, 4.2, 1.0, 0.6, 0.3))
    route = ((2.0, 2.0), (8.0, 2.0), (8.5, 5.0), (3.0, 5.0))
    scene = Scene(name="room", walls=walls, mirrors=((0, 0, 0, 6),), route=route)
    laser = {**EXACT, "beams": 180, "fov": 2 * math.pi, "mirror_return_share": share}
    usual = {"laser": laser, "crowd": {"people": 0}, "robot": {"scans": 100}}
    sections = {k: {**usual.get(k, {}), **changes.get(k, {})} for k in {*usual, *changes}}
    return simulate(override(scene, sections), 3)


def mirrored_points(run, end_points):
    """Which beams are of the mirror, where all end, and the scan of each."""
    return run.truth.mover == MIRRORED, *end_points(run)


def test_what_is_in_the_mirror_lies_on_mirrored_walls(wall_distance, end_points):
    run = room(robot={"radius": 1e-3})
    mirrored, xy, scan = mirrored_points(run, end_points)
    assert 0.05 < mirrored.mean() < 0.5
    assert (xy[mirrored, 0] < 0).all()
    assert (xy[~mirrored, 0] > -1e-6).all()
    back = xy[mirrored] * [-1.0, 1.0]
    is_robot = np.hypot(*(back - run.truth.T_world_base[scan[mirrored], :2, 2]).T) < 0.01
    assert wall_distance(back[~is_robot], run.truth.walls).max() < 1e-4
    assert not run.truth.static[mirrored].any()
    assert run.truth.static[run.recording.hit & ~mirrored].all()


def test_the_robot_sees_itself(end_points):
    run = room(robot={"radius": 0.22})
    mirrored, xy, scan = mirrored_points(run, end_points)
    robot = run.truth.T_world_base[scan, :2, 2]
    off = np.hypot(*(xy * [-1.0, 1.0] - robot).T)
    assert (mirrored & (np.abs(off - 0.22) < 1e-4)).sum() > 10


def test_mirrored_people_are_no_people(end_points):
    run = room(crowd={"people": 4}, robot={"radius": 1e-3})
    mirrored, xy, scan = mirrored_points(run, end_points)
    person = run.truth.movers[scan, :, :2]
    off = np.hypot(*np.moveaxis((xy * [-1.0, 1.0])[:, None] - person, -1, 0)).min(axis=1)
    assert (mirrored & (off < 0.45)).sum() > 50
    assert (xy[run.truth.mover >= 0, 0] > 0).all()


def test_a_sweep_and_a_turned_laser_see_the_same_mirror(end_points):
    for laser in ({"sweep_time": 0.2}, {"yaw": 1.0, "upside_down": "known"}):
        run = room(laser=laser, robot={"scans": 60, "turn_rate": 1e-6, "radius": 1e-3})
        mirrored, xy, _ = mirrored_points(run, end_points)
        # the farthest wall in the mirror is the east one
        assert -10.3 < xy[mirrored, 0].min() < -9.5
