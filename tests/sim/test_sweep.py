"""Scans that take time: each beam shows the world as it was when the beam was taken."""

import numpy as np
import pytest

from stillmap.core import se2
from stillmap.core.config import override
from stillmap.sim import Scene, simulate
from stillmap.sim.dynamics import Motion
from stillmap.sim.laser import Movers, Outlines
from stillmap.sim.options import LaserOptions
from stillmap.sim.planar import Sweep, cast_sweeps
from stillmap.sim.walls import box

NOTHING = Movers(np.empty((2, 0, 2)), np.empty((2, 0)), np.empty((0, 2)), np.empty(0, np.int32))
EXACT = {"range_noise": 0.0, "no_return_share": 0.0}


def at_beam_times(simulation):
    """True sensor poses x, y, theta at each beam's time, which scan it is of, and when in it."""
    recording = simulation.recording
    T = recording.T_map_sensor(simulation.truth.T_world_base)
    x, y, theta = se2.parameters(T).T
    beams = recording.n_beams // recording.n_scans
    later = np.repeat(np.arange(recording.n_scans), beams)
    when = later + recording.beam_time * simulation.scene.robot.scan_rate
    scans = np.arange(recording.n_scans)
    poses = [np.interp(when, scans, values) for values in (x, y, np.unwrap(theta))]
    # beyond the last stamp nothing is known
    return np.stack(poses, axis=-1), later, when


@pytest.mark.parametrize("sweep_time", [0.2, 0.07])
def test_hits_lie_on_the_walls_seen_from_where_the_laser_was(
    sweep_time, wall_distance, end_points, yard
):
    laser = {"beams": 90, "sweep_time": sweep_time, **EXACT}
    run = yard(robot={"scans": 250}, laser=laser)
    poses, scan, _ = at_beam_times(run)
    use = run.recording.hit & (scan < run.recording.n_scans - 1)
    T, points = se2.matrix(*poses.T), run.recording.points
    xy = np.einsum("nij,nj->ni", T[:, :2, :2], points) + T[:, :2, 2]
    # the laser sits off the centre of a robot that turns: 2 rad/s x 0.2 s bend 8 cm by 4 mm
    assert wall_distance(xy[use], run.truth.walls).max() < 0.005
    at_once, _ = end_points(run)
    off = wall_distance(at_once[use], run.truth.walls)
    assert np.quantile(off, 0.9) > 0.3 * sweep_time * 1.5


def test_people_are_where_they_are_at_the_beam_time(yard):
    laser = {"beams": 90, "sweep_time": 0.2, **EXACT}
    run = yard(people=6, robot={"scans": 250}, laser=laser)
    poses, scan, when = at_beam_times(run)
    hit = np.flatnonzero((run.truth.mover >= 0) & (scan < run.recording.n_scans - 1))
    T = se2.matrix(*poses[hit].T)
    xy = np.einsum("nij,nj->ni", T[:, :2, :2], run.recording.points[hit]) + T[:, :2, 2]
    person = run.truth.movers[:, run.truth.mover[hit], :2]
    before, n = np.floor(when[hit]).astype(int), np.arange(len(hit))
    share = (when[hit] - before)[:, None]
    centre = (1 - share) * person[before, n] + share * person[before + 1, n]
    # half a step and a foot, or half a body
    assert np.hypot(*(xy - centre).T).max() < 0.48
    late = share[:, 0] > 0.7
    assert late.sum() > 30
    behind = np.hypot(*(xy - person[before, n]).T)
    assert behind[late].mean() > np.hypot(*(xy - centre).T)[late].mean() + 0.02


@pytest.mark.parametrize("beams", [2, 3, 90, 181, 361])
@pytest.mark.parametrize("fov", [np.pi, 2 * np.pi])
def test_beam_times_grow_with_the_angle(beams, fov):
    options = LaserOptions(beams=beams, fov=fov, sweep_time=0.1)
    times = Sweep.of(options).beam_times(beams).astype(float)
    assert times.shape == (beams,)
    assert (np.diff(times) >= 0).all()
    closed = beams % 2 == 1 and fov < 6
    exact = 0.1 * np.arange(beams) / (beams - 1 if closed else beams)
    # beams are taken in groups of six at most
    np.testing.assert_allclose(times, exact, atol=2.5 * exact[1] + 1e-9)
    assert times.mean() == pytest.approx(exact.mean(), abs=1e-6)


def standing_before(faces):
    """A robot that stands still for two scans, 0.2 s apart, before faces (2, 1, 4)."""
    return Motion(
        period=0.2,
        seconds=np.array([0.0, 0.2]),
        carried=2,
        paused=2,
        robot=np.zeros((2, 3)),
        poses=np.zeros((2, 1, 3)),
        kinds=["car"],
        people=NOTHING,
        outlines=Outlines(faces, np.zeros(1, np.int32)),
        things=Outlines(np.empty((2, 0, 4)), np.empty(0, np.int32)),
        still=np.empty((0, 4)),
        still_thing=np.empty(0, np.int32),
        sizes=np.array([[4.4, 1.8]]),
        moved=np.ones(1, bool),
    )


def test_beams_of_a_sweep_meet_what_comes_by_meanwhile():
    """A wall that comes nearer at 5 m/s, seen by a laser that stands still."""
    near = np.array([[[10.0, -50, 10, 50]], [[9.0, -50, 9, 50]]])
    motion = standing_before(near)
    options = LaserOptions(beams=101, fov=1.0, sweep_time=0.2, range_noise=0.0)
    returns = cast_sweeps(motion, np.empty((0, 4)), np.eye(3)[None].repeat(2, 0), options)
    along = returns.range * np.cos(np.linspace(-0.5, 0.5, 101))
    times = Sweep.of(options).beam_times(101)
    # and goes on coming after the last scan
    np.testing.assert_allclose(along, [10 - 5 * times, 9 - 5 * times], atol=1e-6)
    assert (returns.mover == 0).all()


def test_a_robot_that_is_carried_away_is_not_seen_to_move():
    """The last scan before goes on as it began, and so does the first one after."""
    walls = tuple(box(0, 0, 40, 30))
    scene = Scene(name="yard", walls=walls, route=((-15.0, -10.0), (15.0, -10.0), (15.0, 10.0)))
    changes = {
        "laser": {"beams": 90, "sweep_time": 0.2, **EXACT},
        "robot": {"scans": 120, "speed": 1.0, "carried_at": 0.5},
        "crowd": {"people": 0},
    }
    run = simulate(override(scene, changes), 2)
    carried = run.truth.scene["carried_at_scan"]
    assert carried == 60
    ranges = np.hypot(*run.recording.points.T).reshape(120, 90)
    change = np.abs(np.diff(ranges, axis=0)).max(axis=1)
    assert change[carried - 1] > 5.0
    # a beam that is of before and after would show in its own scan
    jumps = np.abs(np.diff(ranges[[carried - 1, carried]], axis=1)).max(axis=1)
    usual = np.abs(np.diff(ranges[carried - 20 : carried - 1], axis=1)).max()
    assert jumps[0] < usual + 0.5
