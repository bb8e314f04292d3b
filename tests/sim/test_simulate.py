"""The simulation as a whole: truth fits the recording, and everybody behaves."""

import dataclasses
import time
from collections.abc import Callable

import numpy as np
import pytest
from marks import slow_params
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.config import override, to_dict
from stillmap.core.errors import InputError
from stillmap.sim import SCENES, CrowdOptions, Scene, Simulation, scene_by_name, simulate
from stillmap.sim.people import Crowd, Figures
from stillmap.sim.planner import FreeSpace, Planner
from stillmap.sim.walls import box

Float = NDArray[np.float64]
# a scene of each kind: people, doors, things that are moved, cars, lights; the others are slow
QUICK = ["hall", "office", "warehouse-moved", "street", "crossing"]
OTHERS = {n for n in SCENES if not n.endswith(("-crowd", "-empty"))} - set(QUICK)

Distance = Callable[[Float, Float], Float]
EndPoints = Callable[[Simulation], tuple[Float, NDArray[np.int64]]]


def arrays(simulation: Simulation) -> list[NDArray[np.generic]]:
    r, t = simulation.recording, simulation.truth
    assert r.T_odom_base is not None
    return [
        r.stamp_ns, r.points, r.hit, r.T_odom_base, t.static, t.mover, t.T_world_base, t.movers,
    ]  # fmt: skip


def short(name: str, **crowd: object) -> Scene:
    changes = {"robot": {"scans": 150}, "laser": {"beams": 90}, "crowd": crowd}
    return scene_by_name(name, changes)


@pytest.mark.slow
@pytest.mark.parametrize("name", [*QUICK, *slow_params(*sorted(OTHERS))])
def test_one_seed_one_recording(name: str) -> None:
    first, again = simulate(short(name), 11), simulate(short(name), 11)
    for a, b in zip(arrays(first), arrays(again), strict=True):
        np.testing.assert_array_equal(a, b)
    assert first.truth.scene == again.truth.scene
    other = simulate(short(name), 12)
    assert not np.array_equal(first.recording.points, other.recording.points)


def test_a_generator_and_its_seed_give_the_same() -> None:
    a, b = simulate(short("hall"), 4), simulate(short("hall"), np.random.default_rng(4))
    np.testing.assert_array_equal(a.recording.points, b.recording.points)
    assert b.truth.scene["seed"] == 4


@pytest.mark.slow
def test_another_laser_and_odometry_leave_everybody_where_they_were() -> None:
    scene = short("hall")
    laser = dataclasses.replace(scene.laser, beams=33, range_noise=0.0)
    wheels = dataclasses.replace(scene.odometry, drift_noise=0.1)
    a = simulate(scene, 4)
    b = simulate(dataclasses.replace(scene, laser=laser), 4)
    c = simulate(dataclasses.replace(scene, odometry=wheels), 4)
    for other in (b, c):
        np.testing.assert_array_equal(a.truth.movers, other.truth.movers)
        np.testing.assert_array_equal(a.truth.T_world_base, other.truth.T_world_base)
    assert a.recording.T_odom_base is not None
    assert b.recording.n_beams == 150 * 33
    np.testing.assert_array_equal(a.recording.T_odom_base, b.recording.T_odom_base)
    np.testing.assert_array_equal(a.recording.points, c.recording.points)


@pytest.mark.slow
def test_static_hits_lie_on_walls(
    populated: Simulation, wall_distance: Distance, end_points: EndPoints
) -> None:
    xy, _ = end_points(populated)
    truth = populated.truth
    distance = wall_distance(xy[truth.static][::5], truth.walls)
    sigma = populated.scene.laser.range_noise
    assert distance.max() < 5.5 * sigma
    # a wall that is hit straight on shows the whole noise, one at a slant less of it
    assert 0.3 * sigma < np.sqrt(np.mean(distance**2)) < sigma


@pytest.mark.slow
def test_hits_on_movers_lie_on_that_mover(any_run: Simulation, end_points: EndPoints) -> None:
    xy, scan = end_points(any_run)
    mover = any_run.truth.mover
    hit = mover >= 0
    centre = any_run.truth.movers[scan[hit], mover[hit], :2]
    off = np.hypot(*(xy[hit] - centre).T)
    sigma = any_run.scene.laser.range_noise
    assert off.max() < 0.28 + 0.2 + 5 * sigma  # half a step and a foot, or half a body
    assert np.quantile(off, 0.95) < 0.4
    assert off.mean() > 0.1


def test_every_hit_is_either_static_or_a_mover(populated: Simulation) -> None:
    hit, truth = populated.recording.hit, populated.truth
    np.testing.assert_array_equal(hit, truth.static | (truth.mover >= 0))
    assert not np.any(truth.static & (truth.mover >= 0))


def test_shares_of_beams_are_plausible(populated: Simulation) -> None:
    hit, truth = populated.recording.hit, populated.truth
    assert 0.02 < (truth.mover >= 0)[hit].mean() < 0.15
    assert 0.001 < 1 - hit.mean() < 0.1
    free = np.hypot(*populated.recording.points[~hit].T)
    np.testing.assert_allclose(free, populated.scene.laser.max_range, rtol=1e-6)


def test_nobody_walks_through_walls_or_the_robot(
    any_run: Simulation, wall_distance: Distance
) -> None:
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
def test_where_there_is_no_room_to_pass_nobody_overlaps(seed: int, wall_distance: Distance) -> None:
    scene = Scene(name="alley", walls=tuple(box(0, 0, 14, 1.3)), route=((-6.0, 0.0), (6.0, 0.0)))
    changes = {"robot": {"scans": 400}, "laser": {"beams": 10}, "crowd": {"people": 7}}
    truth = simulate(override(scene, changes), seed).truth
    robot, people = truth.T_world_base[:, :2, 2], truth.movers[..., :2]
    distance = np.hypot(*np.moveaxis(people - robot[:, None], -1, 0))
    assert distance.min() >= 0.22 + 0.26
    assert distance.min() < 0.22 + 0.26 + 0.1  # or the alley is no test
    assert wall_distance(people.reshape(-1, 2), truth.walls).min() > 0.24


def test_people_keep_apart(crowded: Simulation) -> None:
    xy = crowded.truth.movers[::5, :, :2]
    distance = np.hypot(*np.moveaxis(xy[:, :, None] - xy[:, None], -1, 0))
    distance[:, *np.diag_indices(distance.shape[1])] = np.inf
    assert (distance.min(axis=2) < 0.4).mean() < 0.01
    assert distance.min() > 0.2


def test_people_walk_at_their_own_speeds(populated: Simulation) -> None:
    rate = populated.scene.robot.scan_rate
    xy = populated.truth.movers[..., :2]
    speed = np.hypot(*np.moveaxis(np.diff(xy, axis=0), -1, 0)) * rate
    usual = np.nanmedian(np.where(speed > 0.1, speed, np.nan), axis=0)
    assert 0.35 < usual.min() < 0.8
    assert 1.1 < usual.max() < 1.65
    # a third of them stop, for a share of their time
    assert 0.03 < (speed < 0.05).mean() < 0.3
    never = (speed < 0.01).mean(axis=0) < 0.01
    assert never.mean() == pytest.approx(2 / 3, abs=0.1)


def test_everybody_gets_about(populated: Simulation) -> None:
    xy = populated.truth.movers[..., :2]
    assert np.hypot(*(xy.max(axis=0) - xy.min(axis=0)).T).min() > 10.0


def test_nobody_stops_when_nobody_shall() -> None:
    scene = scene_by_name("hall", {"crowd": {"stopping_share": 0.0}, "robot": {"scans": 500}})
    xy = simulate(scene, 2).truth.movers[..., :2]
    speed = np.hypot(*np.moveaxis(np.diff(xy, axis=0), -1, 0)) * 5
    # somebody may still have to let others pass
    assert (speed < 0.05).mean() < 0.01


def test_a_planted_foot_stands_still() -> None:
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


def test_the_robot_covers_its_whole_route(populated: Simulation) -> None:
    robot = populated.truth.T_world_base[:, :2, 2]
    for point in populated.scene.route:
        # corners are cut a little
        assert np.hypot(*(robot - point).T).min() < 0.35, point
    assert np.hypot(*(robot[-1] - populated.scene.route[-1])) < 0.2
    step = np.hypot(*np.diff(robot, axis=0).T)
    assert step.max() <= 0.5 / 5 + 1e-9
    turn = se2.wrap(np.diff(se2.parameters(populated.truth.T_world_base)[:, 2]))
    assert np.abs(turn).max() <= 0.8 / 5 + 1e-9


def test_more_scans_than_the_route_takes_go_round_again() -> None:
    scene = Scene(
        name="square",
        walls=tuple(box(0, 0, 8, 8)),
        route=((-2, -2), (2, -2), (2, 2), (-2, 2)),
    )
    scene = dataclasses.replace(
        scene,
        crowd=dataclasses.replace(scene.crowd, people=0),
        robot=dataclasses.replace(scene.robot, scans=600),
    )
    robot = simulate(scene, 0).truth.T_world_base[:, :2, 2]
    assert len(robot) == 600
    way = np.hypot(*np.diff(robot, axis=0).T).sum()
    assert way > 2 * 16
    for point in scene.route:
        near = np.hypot(*(robot - point).T) < 0.3
        assert np.count_nonzero(np.diff(near.astype(int)) == 1) >= 2


def test_a_robot_that_stands_still_records_too() -> None:
    scene = Scene(name="standing", walls=tuple(box(0, 0, 8, 8)), route=((0.0, 1.0),))
    options = {"robot": {"scans": 40}, "crowd": {"people": 4}}
    truth = simulate(override(scene, options), 0).truth
    np.testing.assert_array_equal(truth.T_world_base, truth.T_world_base[:1].repeat(40, 0))
    assert (truth.mover >= 0).any()


def test_a_crowd_does_not_hold_up_the_robot_for_good(crowded: Simulation) -> None:
    robot = crowded.truth.T_world_base[:, :2, 2]
    way = np.hypot(*np.diff(robot, axis=0).T).sum()
    assert way > 0.6 * 0.5 * len(robot) / 5


def test_a_route_through_a_wall_is_refused() -> None:
    scene = Scene(name="bad", walls=tuple(box(0, 0, 8, 8)), route=((3.95, 0.0), (0.0, 0.0)))
    with pytest.raises(InputError, match="no room"):
        simulate(scene, 0)


def test_progress_rises_to_one() -> None:
    shares: list[float] = []
    simulate(short("hall"), 0, shares.append)
    assert shares == sorted(shares)
    assert len(shares) > 3
    assert shares[-1] == 1.0


def test_scene_parameters_are_kept_with_the_truth() -> None:
    scene = short("corridor", people=5, shape="bodies")
    kept = simulate(scene, 1).truth.scene
    assert kept["name"] == "corridor"
    for part in ("crowd", "laser", "robot", "odometry"):
        assert kept[part] == to_dict(getattr(scene, part))


@pytest.mark.slow
def test_ten_thousand_scans_take_seconds() -> None:
    changes = {"robot": {"scans": 10_000}, "laser": {"beams": 360}, "crowd": {"people": 20}}
    started = time.process_time()
    simulation = simulate(scene_by_name("corridor", changes), 1)
    took = time.process_time() - started
    assert simulation.recording.n_beams == 3_600_000
    assert took < 40.0  # about 10 s on one core of 2020
