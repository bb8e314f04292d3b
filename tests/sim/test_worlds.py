"""The worlds: truth holds in all of them, with any sensor, and the empty ones are empty."""

import math
from itertools import pairwise

import numpy as np
import pytest
from marks import slow_params

from stillmap.sim import SCENES, scene_by_name, simulate
from stillmap.sim.dynamics import place_faces
from stillmap.sim.geometry import BOX, CYLINDER, ELLIPSOID, Ground
from stillmap.sim.walls import box
from stillmap.sim.world_3d import make_static_world, trace_loops

OUTER = 5.25  # m, from the middle of the road to that of the outer lane
BARE = [name for name in SCENES if name.endswith("-empty")]
POPULATED = [name for name in SCENES if not name.endswith(("-empty", "-crowd"))]


def largest_slow(names):
    """The names; the kilometre of the drive is slow."""
    large = [name for name in names if name.startswith("drive")]
    return [*(name for name in names if name not in large), *slow_params(*large)]


def kinds(simulation):
    return np.array(simulation.truth.scene["mover_kinds"])


@pytest.mark.slow
@pytest.mark.parametrize("name", largest_slow(BARE))
def test_empty_worlds_have_no_movers_but_things_whose_time_comes_later(name):
    # else mirrors show the robot to itself
    laser = {"beams": 90, "mirror_return_share": 1.0}
    run = simulate(scene_by_name(name, {"robot": {"scans": 60}, "laser": laser}), 1)
    assert (run.truth.mover == -1).all()
    things = len(run.scene.things)
    assert (things > 0) == ("-moved" in name)
    assert run.truth.movers.shape == (60, things, 3)
    assert run.truth.scene["mover_kinds"] == ["thing"] * things
    np.testing.assert_array_equal(run.truth.static, run.recording.hit)


@pytest.mark.slow
@pytest.mark.parametrize("name", largest_slow(POPULATED))
@pytest.mark.parametrize(
    ("beams", "degrees", "noise", "max_range"), [(1440, 360, 0.05, 5.0), (181, 90, 0.01, 80.0)]
)
def test_every_world_with_extreme_sensors(name, beams, degrees, noise, max_range):
    laser = {"beams": beams, "fov": math.radians(degrees)}
    laser |= {"range_noise": noise, "max_range": max_range}
    run = simulate(scene_by_name(name, {"laser": laser, "robot": {"scans": 8}}), 1)
    assert run.recording.n_beams == 8 * beams
    ranges = np.hypot(*run.recording.points.T)
    assert ranges[run.recording.hit].max() < max_range
    assert run.recording.hit.any()
    np.testing.assert_allclose(ranges[~run.recording.hit], max_range, rtol=1e-6)


@pytest.mark.slow
def test_static_hits_lie_on_what_stands_still(world, end_points, wall_distance):
    xy, _ = end_points(world)
    static = np.flatnonzero(world.truth.static)
    some = static[:: max(1, len(static) // 2000)]
    assert wall_distance(xy[some], world.truth.walls).max() < 1e-4


def test_hits_on_movers_lie_on_that_mover(world, end_points):
    xy, scan = end_points(world)
    truth = world.truth
    hit = np.flatnonzero(truth.mover >= 0)
    x, y, heading = truth.movers[scan[hit], truth.mover[hit]].T
    c, s = np.cos(heading), np.sin(heading)
    dx, dy = xy[hit, 0] - x, xy[hit, 1] - y
    ahead, aside = np.abs(c * dx + s * dy), np.abs(c * dy - s * dx)
    kind = kinds(world)[truth.mover[hit]]
    assert np.hypot(ahead, aside)[kind == "person"].max() < 0.48
    # a leaf is a line through its middle
    assert aside[kind == "door"].max(initial=0.0) < 1e-4
    assert ahead[kind == "door"].max(initial=0.0) < 0.48 + 1e-4
    for name, (length, width), spread in (
        ("car", (4.4, 1.8), (5.6 * 1.06, 2.0 * 1.06)),
        ("forklift", (2.4, 1.2), (2.4 * 1.06, 1.2 * 1.06)),
    ):
        u, v = ahead[kind == name], aside[kind == name]
        assert u.max(initial=0.0) < spread[0] / 2 + 1e-4
        assert v.max(initial=0.0) < spread[1] / 2 + 1e-4
        # on the outline, not within it
        assert np.all((u > 0.94 * length / 2 - 1e-4) | (v > 0.94 * width / 2 - 1e-4))


def test_whoever_moves_is_not_labelled_static(world):
    truth = world.truth
    np.testing.assert_array_equal(world.recording.hit, truth.static | (truth.mover >= 0))
    moved = np.ptp(truth.movers, axis=0).max(axis=1) > 1e-6
    assert truth.movers.shape[1] == len(kinds(world))
    met = np.unique(truth.mover[truth.mover >= 0])
    assert moved[met].all()
    still = len(truth.walls) - len(world.scene.walls) - len(world.scene.glass)
    stays = kinds(world)[~moved]
    assert still == np.sum(stays == "door") + 4 * np.sum((stays == "car") | (stays == "forklift"))


def test_the_robot_meets_nobody(world):
    robot, radius = world.truth.T_world_base[:, :2, 2], world.scene.robot.radius
    off = np.hypot(*np.moveaxis(world.truth.movers[..., :2] - robot[:, None], -1, 0))
    kind = kinds(world)
    least = {"person": radius + 0.25, "door": 0.0, "car": radius + 0.9, "forklift": radius + 0.6}
    for k, name in enumerate(kind.tolist()):
        assert off[:, k].min() > least[name], name


@pytest.mark.slow
def test_rounds_lead_through_every_corridor_and_home():
    run = simulate(scene_by_name("rounds-empty", {"laser": {"beams": 8}}), 1)
    xy = run.truth.T_world_base[:, :2, 2]
    X, Y = (1.4, 48.2, 113.0, 195.8), (1.4, 34.2, 81.0)  # m, the corridors' middles
    middles = [((a + b) / 2, y) for a, b in pairwise(X) for y in Y]
    middles += [(x, (a + b) / 2) for a, b in pairwise(Y) for x in X]
    for middle in middles:
        assert np.hypot(*(xy - middle).T).min() < 0.3, middle
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(xy, axis=0).T))])
    home = along[(np.hypot(*(xy - xy[0]).T) < 0.3) & (along > 10.0)]
    # the first loop is closed after one round of it
    assert home[0] == pytest.approx(2 * (X[1] - X[0] + Y[1] - Y[0]), abs=5.0)
    assert 1200.0 < home[-1] < 1500.0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["office-moved", "street-moved", "warehouse-moved"])
def test_moved_things_are_seen_wherever_they_stay(name, wall_distance):
    run = simulate(scene_by_name(name), 3)
    seconds = 1e-9 * (run.recording.stamp_ns - run.recording.stamp_ns[0])
    when = np.repeat(seconds, np.diff(run.recording.offset))
    first = int(np.argmax(kinds(run) == "thing"))
    for number, thing in enumerate(run.scene.things, start=first):
        hits = when[run.truth.mover == number]
        for stay in thing.stays:
            end = np.inf if stay.until is None else stay.until
            assert np.count_nonzero((hits >= stay.since) & (hits < end)) > 50
            # and they stand in no wall
            corners = place_faces(thing, stay)[:, :2]
            assert wall_distance(corners, run.truth.walls).min() > 0.02


def test_crowns_reach_above_the_road_and_over_who_passes():
    scene = scene_by_name("crossing")
    ground = Ground(np.zeros(2), np.reshape(scene.pavements, (-1, 4)), scene.ground.kerb)
    solids = make_static_world(scene, ground).solids
    crowns = solids.form == ELLIPSOID
    x, y, _, foot = solids.pose[0, crowns].T
    assert crowns.sum() >= 15
    assert (np.abs(y) - solids.half[crowns, 1] < OUTER).sum() >= 8
    assert (np.abs(x) - solids.half[crowns, 0] < OUTER - 0.9).sum() >= 4  # above the cars
    assert (solids.z[crowns, 0] + foot > 2.2).all()
    trunks = solids.form == CYLINDER
    np.testing.assert_allclose(solids.pose[0, trunks, :2], np.stack([x, y], axis=-1))
    assert (solids.form == BOX).sum() > 10 * 6  # parked cars


def test_an_outline_is_a_thing_if_it_closes_and_is_no_room():
    def shifted(segments):
        return [tuple(v + 3.0 for v in s) for s in segments]

    square = box(0.5, 1.0, 1.0, 2.0)
    room = [tuple(9.0 * v for v in s) for s in square]
    loops, lines = trace_loops([*square, *room, *shifted(square)[:3]])
    assert len(loops) == 1
    assert loops[0][:2] == (0.5, 1.0)
    assert loops[0].heading == pytest.approx(np.pi / 2)
    assert (loops[0].length, loops[0].width, loops[0].sides) == (2.0, 1.0, 4)
    assert len(lines) == 7
