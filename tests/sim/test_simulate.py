"""The simulation as a whole: truth fits the recording, and everybody behaves."""

import dataclasses

import numpy as np
import pytest
from marks import slow_params

from stillmap.core import se2
from stillmap.core.config import override
from stillmap.core.errors import InputError
from stillmap.sim import SCENES, Scene, scene_by_name, simulate
from stillmap.sim.options import CrowdOptions
from stillmap.sim.people import Crowd, Figures
from stillmap.sim.planner import FreeSpace, Planner
from stillmap.sim.walls import box

# a scene of each kind: people, doors, things that are moved, cars, lights; the others are slow
QUICK = ["hall", "office", "warehouse-moved", "street", "crossing"]
OTHERS = {n for n in SCENES if not n.endswith(("-crowd", "-empty"))} - set(QUICK)


def arrays(simulation):
    r, t = simulation.recording, simulation.truth
    recorded = r.stamp_ns, r.points, r.hit, r.T_odom_base
    return *recorded, t.static, t.mover, t.T_world_base, t.movers


def short(name, **crowd):
    changes = {"robot": {"scans": 150}, "laser": {"beams": 90}, "crowd": crowd}
    return scene_by_name(name, changes)


@pytest.mark.slow
@pytest.mark.parametrize("name", [*QUICK, *slow_params(*sorted(OTHERS))])
def test_one_seed_one_recording(name):
    first, again = simulate(short(name), 11), simulate(short(name), 11)
    for a, b in zip(arrays(first), arrays(again), strict=True):
        np.testing.assert_array_equal(a, b)
    assert first.truth.scene == again.truth.scene
    other = simulate(short(name), 12)
    assert not np.array_equal(first.recording.points, other.recording.points)


@pytest.mark.slow
def test_another_laser_and_odometry_leave_everybody_where_they_were():
    scene = short("hall")
    laser = dataclasses.replace(scene.laser, beams=33, range_noise=0.0)
    wheels = dataclasses.replace(scene.odometry, drift_noise=0.1)
    a = simulate(scene, 4)
    b = simulate(dataclasses.replace(scene, laser=laser), 4)
    c = simulate(dataclasses.replace(scene, odometry=wheels), 4)
    for other in (b, c):
        np.testing.assert_array_equal(a.truth.movers, other.truth.movers)
        np.testing.assert_array_equal(a.truth.T_world_base, other.truth.T_world_base)
    assert b.recording.n_beams == 150 * 33
    np.testing.assert_array_equal(a.recording.T_odom_base, b.recording.T_odom_base)
    np.testing.assert_array_equal(a.recording.points, c.recording.points)


def test_nobody_walks_through_walls_or_the_robot(any_run, wall_distance):
    movers, walls = any_run.truth.movers[..., :2], any_run.truth.walls
    assert wall_distance(movers.reshape(-1, 2), walls).min() > 0.24
    robot = any_run.truth.T_world_base[:, :2, 2]
    assert wall_distance(robot, walls).min() > 0.22
    from_robot = np.hypot(*np.moveaxis(movers - robot[:, None], -1, 0))
    assert from_robot.min() > 0.22 + 0.25
    # between two scans nobody goes farther than a fast walk: no jump across a wall either
    step = np.hypot(*np.moveaxis(np.diff(movers, axis=0), -1, 0))
    assert step.max() < 1.7 / any_run.scene.robot.scan_rate


@pytest.mark.parametrize("seed", range(3))
def test_where_there_is_no_room_to_pass_nobody_overlaps(seed, wall_distance):
    scene = Scene(name="alley", walls=tuple(box(0, 0, 14, 1.3)), route=((-6.0, 0.0), (6.0, 0.0)))
    changes = {"robot": {"scans": 400}, "laser": {"beams": 10}, "crowd": {"people": 7}}
    truth = simulate(override(scene, changes), seed).truth
    robot, people = truth.T_world_base[:, :2, 2], truth.movers[..., :2]
    distance = np.hypot(*np.moveaxis(people - robot[:, None], -1, 0))
    assert distance.min() >= 0.22 + 0.26
    assert distance.min() < 0.22 + 0.26 + 0.1  # or the alley is no test
    assert wall_distance(people.reshape(-1, 2), truth.walls).min() > 0.24


def test_a_planted_foot_stands_still():
    """Of a walker's two feet one rests on the floor at any time."""
    space = FreeSpace(np.array(box(0, 0, 80, 80)))
    far = np.array([-38.0, -38.0, 0.0])
    planner = Planner(space, np.zeros(2), 0.5)
    options = CrowdOptions(people=1, stopping_share=0.0, min_speed=1.2, max_speed=1.2)
    crowd = Crowd(options, space, planner, far[:2], np.random.default_rng(6))
    figures = Figures(1, "legs", space, np.random.default_rng(7))
    feet = []
    for _ in range(400):
        crowd.step(0.02, far, 0.5, False)
        figures.step(0.02, crowd, far[:2], 0.2)
        feet.append(figures.parts(crowd)[0])
    speed = np.hypot(*np.moveaxis(np.diff(np.array(feet), axis=0), -1, 0)) / 0.02
    walking = speed[150:]
    assert np.median(walking.min(axis=1)) < 0.1
    assert np.median(walking.max(axis=1)) == pytest.approx(2 * 1.2, rel=0.1)


def test_the_robot_covers_its_whole_route(populated):
    robot = populated.truth.T_world_base[:, :2, 2]
    for point in populated.scene.route:
        # corners are cut a little
        assert np.hypot(*(robot - point).T).min() < 0.35, point
    assert np.hypot(*(robot[-1] - populated.scene.route[-1])) < 0.2
    step = np.hypot(*np.diff(robot, axis=0).T)
    assert step.max() <= 0.5 / 5 + 1e-9
    turn = se2.wrap(np.diff(se2.parameters(populated.truth.T_world_base)[:, 2]))
    assert np.abs(turn).max() <= 0.8 / 5 + 1e-9


def test_a_route_through_a_wall_is_refused():
    scene = Scene(name="bad", walls=tuple(box(0, 0, 8, 8)), route=((3.95, 0.0), (0.0, 0.0)))
    with pytest.raises(InputError, match="no room"):
        simulate(scene, 0)


def test_progress_rises_to_one():
    shares: list[float] = []
    simulate(short("hall"), 0, shares.append)
    assert shares == sorted(shares)
    assert len(shares) > 3
    assert shares[-1] == 1.0
