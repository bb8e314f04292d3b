"""Doors that were seen in one position only: doorways, leaves at them, and whether they moved."""

import dataclasses
import functools
import json
import math

import numpy as np
import pytest

import stillmap
from stillmap import _core
from stillmap.core.config import override
from stillmap.mapping.door_states import list_runs
from stillmap.mapping.doors import Door, DoorState
from stillmap.mapping.doorways import find_doorways
from stillmap.mapping.lone_doors import compute_p_moved
from stillmap.mapping.lone_leaves import find_open_leaf, is_thin
from stillmap.mapping.shut_leaves import estimate_p_door, estimate_shut_share, find_shut_leaf
from stillmap.pipeline.options import Options
from stillmap.sim import CrowdOptions, LaserOptions, RobotOptions, Scene, simulate
from stillmap.sim.walls import box

RESOLUTION = 0.05
S = 10**9
GAP = 19  # cells, of the doorway


def row(start, angle, length):
    """Cells of a straight row, rising."""
    t = np.arange(0.0, length, 0.4)[:, None]
    along = np.array([math.cos(math.radians(angle)), math.sin(math.radians(angle))])
    return np.unique(np.round(np.array(start) + t * along).astype(np.int64), axis=0)


def wall(gap=GAP):
    """Along x, with a doorway from x = 40 on."""
    return [row((0, 0), 0, 41), row((40 + gap, 0), 0, 40)]


def cells(*rows):
    return np.unique(np.concatenate(rows), axis=0)


def leaf(angle=100.0, length=GAP, at=(40.0, 3.0)):
    """Hinged at the left end, behind a wall of 0.15 m."""
    return [row(at, angle, length), row((40, 0), 90, 4)]


@pytest.mark.parametrize("angle", [0.0, 31.0, 75.0])
def test_a_gap_as_wide_as_a_door_in_a_wall_of_any_direction(angle):
    c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
    begin = np.array([c, s]) * (40 + GAP)
    (found,) = find_doorways(cells(row((0, 0), angle, 41), row(begin, angle, 40)), RESOLUTION)
    np.testing.assert_allclose(found.ends, [[40 * c, 40 * s], begin], atol=1.5)


@pytest.mark.parametrize("gap", [5, 40])
def test_other_gaps_are_no_doorways(gap):
    assert not find_doorways(cells(*wall(gap)), RESOLUTION)


def test_no_surface_has_no_doorways():
    assert not find_doorways(np.empty((0, 2), np.int64), RESOLUTION)


def find_leaf(*more):
    surface = cells(*wall(), *more)
    (doorway,) = find_doorways(surface, RESOLUTION)
    return find_open_leaf(doorway, surface)


@pytest.mark.parametrize("angle", [75.0, 90.0, 110.0])
def test_an_open_leaf_from_one_end_of_a_doorway(angle):
    found = find_leaf(*leaf(angle))
    assert found.length == pytest.approx(GAP, abs=3)
    assert math.degrees(math.acos(found.leaf @ [1, 0])) == pytest.approx(angle, abs=5)
    np.testing.assert_allclose(found.shut, [1, 0], atol=0.01)
    of_leaf = leaf(angle)[0]
    assert {tuple(cell) for cell in found.cells.tolist()} <= {tuple(c) for c in of_leaf.tolist()}


@pytest.mark.parametrize(
    "more",
    [
        [],  # no leaf
        leaf(length=0.25 * GAP),
        leaf(length=2.0 * GAP),
        [*leaf(), row((46, 8), 0, 8)],  # it could not have swung
        [*leaf(90.0), row((36, 21), 0, 5), row((36, 3), 90, 19)],  # the side of a box
        [*leaf(90.0), row((40, -20), 90, 20)],  # a wall that crosses
    ],
)
def test_what_is_no_leaf(more):
    assert find_leaf(*more) is None


@pytest.mark.parametrize(
    ("roughness", "share_behind", "is_leaf"),
    [(1.0, 1.0, True), (1.0, 0.5, False), (0.8, 0.5, True), (0.4, 0.1, False), (1.3, 1.0, False)],
)
def test_a_rough_leaf_must_be_thin(roughness, share_behind, is_leaf):
    one = find_leaf(*leaf(90.0))._replace(roughness=roughness)
    counts = _core.OccupancyGrid2D(RESOLUTION, moments=False)
    t = np.arange(one.length + 1.0)
    passed = []
    for side, share in ((1.0, 1.0), (-1.0, share_behind)):
        across = side * one.shut
        upto = t[: round(0.3 * len(t) + share * 0.7 * len(t))]
        passed += [one.hinge + upto[:, None] * one.leaf + k * across for k in (3.0, 4.0, 5.0)]
    ends = RESOLUTION * (np.concatenate(passed) + 0.5)
    for _ in range(3):
        add_passes(counts, ends)
    assert is_thin(one, counts) == is_leaf


def add_passes(counts, points):
    """Beams of a cell and a half that pass cells from left to right and end in the next ones."""
    T = np.tile(np.eye(3), (len(points), 1, 1))
    T[:, :2, 2] = points - [0.6 * RESOLUTION, 0.0]
    beams = np.tile(np.float32([1.5 * RESOLUTION, 0.0]), (len(points), 1))
    offset = np.arange(len(points) + 1)
    is_hit = np.zeros(len(points), bool)
    _core.add_beams(counts, beams, is_hit, np.ones(len(points), np.float32), offset, T, 1)


def filled(depth, beyond=0):
    edges = [row((x, 0), 90, depth + 1) for x in (40, 40 + GAP)]
    back = row((41 - beyond, depth), 0, GAP - 1 + 2 * beyond)
    surface = cells(*wall(), back, *edges)
    (doorway,) = find_doorways(surface, RESOLUTION)
    return find_shut_leaf(doorway, surface)


def test_what_fills_a_doorway_behind_its_face():
    found = filled(4)
    assert found.length == pytest.approx(GAP, abs=1)
    assert set(found.cells[:, 1].tolist()) == {4}
    assert filled(4, beyond=8) is None  # a wall behind the gap
    assert filled(12) is None


def test_the_edge_of_a_wall_drawn_too_long_hides_a_part_of_the_leaf():
    edges = [row((x, 0), 90, 5) for x in (45, 40 + GAP)]
    leaf_row, longer_wall = row((40, 4), 0, GAP), row((40, 0), 0, 6)
    surface = cells(*wall(), leaf_row, longer_wall, *edges)
    (doorway,) = find_doorways(surface, RESOLUTION)
    found = find_shut_leaf(doorway, surface)
    assert found is not None
    assert found.cells[:, 0].min() <= 41
    assert 47 in found.cells[:, 0]


def door(*states):
    stamps = [DoorState(position, since * S, until * S) for position, since, until in states]
    none = np.empty((0, 2), np.int64)
    return Door((0.0, 0.0), 0.9, 0.0, 1.5, none, none, none, tuple(stamps))


SWINGS = door(*[("open" if k % 2 else "shut", 20 * k, 20 * k + 10) for k in range(10)])


def test_what_fills_a_doorway_is_a_door_where_doorways_have_doors():
    always_shut = np.full(8, 0.4)
    assert estimate_p_door(always_shut, 0).max() < 0.15
    assert estimate_p_door(always_shut, 7).min() > 0.3
    assert estimate_p_door(np.full(30, 0.4), 2).max() < 0.1
    assert estimate_p_door(np.full(1, 0.23), 0)[0] < 0.1
    assert len(estimate_p_door(np.zeros(0), 3)) == 0


def test_a_leaf_says_nothing_of_how_probable_its_own_looks_are():
    rates = np.geomspace(1e-5, 1.0, 61)
    one = np.array([(0, 300)], np.int64) * S
    (same,), _ = compute_p_moved([], [one], np.array([0, 300]) * S)
    assert same == pytest.approx(np.exp(-300.0 * rates).mean(), rel=1e-6)
    (with_swings,), _ = compute_p_moved([SWINGS], [one], np.array([0, 300]) * S)
    assert with_swings < 0.1 * same


def test_a_leaf_that_would_have_been_seen_to_swing_is_no_door():
    watched, glanced_at = estimate_p_door(np.array([0.01, 0.5]), 3)
    assert watched < 0.05 < 0.3 < glanced_at


def test_how_long_doors_are_shut_is_learned_from_those_that_swing():
    assert estimate_shut_share([]) == pytest.approx(0.5)
    mostly_open = door(("open", 0, 5000), ("shut", 5010, 5020))
    assert estimate_shut_share([mostly_open]) < 0.05


def p_moved(doors, *looks, seconds=300):
    stamps = [np.array(one, np.int64) * S for one in looks]
    return compute_p_moved(doors, stamps, np.array([0, seconds]) * S)[1]


def test_a_leaf_seen_once_moved_where_doors_swing():
    seen = [(100 + k, 101 + k) for k in range(10)]
    assert p_moved([SWINGS], seen)[0] > 0.95
    assert p_moved([], seen)[0] < 0.6


def test_where_leaves_rest_all_the_time_they_did_not_move():
    always = [(k, k + 1) for k in range(0, 300)]
    some = [(100, 110), (250, 260)]
    assert p_moved([], always)[0] < 0.02
    assert p_moved([], always, always, always, some)[-1] < 0.25
    assert p_moved([], some)[0] > p_moved([], always, some)[1]


def test_a_gap_in_the_looks_hides_swings():
    assert p_moved([SWINGS], [(0, 100), (200, 300)])[0] > 0.7
    assert p_moved([SWINGS], [(0, 150), (151, 300)])[0] < 0.1


HINGE, OPENED = (0.5, 0.15), math.radians(100.0)
TIP = (HINGE[0] + 0.96 * math.cos(OPENED), HINGE[1] + 0.96 * math.sin(OPENED))
FREE = ((*HINGE, *TIP),)
SHUT_FROM = 55  # scan; the robot is in the room
BOX = tuple(box(0.0, 0.65, 1.0, 0.96))


@functools.cache
def built(leaf, state="last", shut_from=None):
    """A corridor and a room that the robot enters; what stands at the doorway between them.

    From scan `shut_from` on, if any, the door is shut.
    """
    sim = world(leaf)
    recording = sim.recording if shut_from is None else shut(sim, shut_from)
    chosen = {"threads": 1, "em": {"max_iterations": 1}, "output": {"map_state": state}}
    options = override(Options(), chosen)
    return stillmap.build(recording, options, poses=sim.truth.T_world_base), recording


def shut(sim, since):
    """Beams of the scans from `since` on end at the leaf that is shut in the doorway."""
    recording, poses = sim.recording, sim.truth.T_world_base
    scan = recording.scans_of(np.arange(recording.n_beams))
    start = recording.T_map_sensor(poses)[scan, :2, 2]
    way = recording.end_points(np.arange(recording.n_beams), poses) - start
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (HINGE[1] - start[:, 1]) / way[:, 1]
        x = start[:, 0] + share * way[:, 0]
    blocked = (scan >= since) & (share > 0.0) & (share < 1.0) & (x > HINGE[0]) & (x < 1.5)
    points = recording.points.copy()
    points[blocked] *= share[blocked, None].astype(np.float32)
    return dataclasses.replace(recording, points=points, hit=recording.hit | blocked)


def world(leaf):
    partition = ((-4.0, 0.0, 0.5, 0.0), (0.5, 0.0, *HINGE), (1.5, 0.0, 1.5, 0.15), (1.5, 0, 5.0, 0))
    scene = Scene(
        "corridor",
        walls=(*box(0.5, 0.5, 9, 5), *partition, *leaf),
        route=((-2.0, -0.9), (1.0, -0.9), (1.0, 2.0), (-2.0, 2.0)),
        crowd=CrowdOptions(people=0),
        laser=LaserOptions(beams=361, range_noise=0.01, fov=2 * np.pi),
        robot=RobotOptions(scans=120, scan_rate=4.0, speed=0.5),
    )
    return simulate(scene, np.random.default_rng(3))


def shown(result, cells):
    first = np.round(np.array(result.map.origin[:2]) / result.map.resolution).astype(int)
    column, row = (cells - first).T
    return result.map.p_occupied[row, column]


def test_an_open_door_is_named_and_shown_as_found(tmp_path):
    result, _ = built(FREE)
    (found,) = result.doors
    assert not result.changes
    assert np.hypot(found.hinge[0] - HINGE[0], found.hinge[1] - HINGE[1]) < 0.2
    assert [one.position for one in found.states] == ["open"]
    assert (shown(result, found.open_cells) > 0.5).mean() > 0.7
    result.save(tmp_path / "out")
    (told,) = json.loads((tmp_path / "out/run.json").read_text())["doors"]
    assert told["p_moved"] == pytest.approx(found.p_moved, abs=1e-4)
    assert told["states"][0]["position"] == "open"


def test_beams_on_it_are_static_as_far_as_it_may_have_moved():
    result, recording = built(FREE)
    ends = recording.end_points(np.arange(recording.n_beams), result.poses)
    middle = 0.5 * (np.array(HINGE) + TIP)
    on = recording.hit & (np.linalg.norm(ends - middle, axis=1) < 0.2)
    (found,) = result.doors
    assert 0.02 < found.p_moved < 0.6  # nobody saw a door move here
    assert np.median(result.p_static[on]) == pytest.approx(1.0 - found.p_moved, abs=0.05)


def test_it_is_left_out_where_all_doors_are_to_be_shut():
    result, _ = built(FREE, "shut")
    (found,) = result.doors
    assert (shown(result, found.open_cells) < 0.5).all()


def test_the_side_of_a_box_is_no_door():
    result, _ = built(BOX)
    assert not result.doors


def on_leaf(result, recording):
    ends = recording.end_points(np.arange(recording.n_beams), result.poses)
    inside = (np.abs(ends[:, 0] - 1.0) < 0.3) & (np.abs(ends[:, 1] - HINGE[1]) < 0.05)
    return recording.hit & inside


def test_a_leaf_that_beams_passed_before_is_a_door_that_moved():
    result, recording = built((), shut_from=SHUT_FROM)
    (found,) = result.doors
    before, after = found.states
    assert (before.position, after.position) == ("open", "shut")
    assert before.until_ns < recording.stamp_ns[SHUT_FROM] <= after.since_ns
    assert math.isnan(found.opened)
    assert found.p_moved > 0.9
    assert on_leaf(result, recording).sum() > 50
    assert np.median(result.p_static[on_leaf(result, recording)]) < 0.1
    assert (shown(result, found.shut_cells) > 0.5).mean() > 0.7  # it was seen shut last
    assert not result.objects


def test_it_is_left_out_where_all_doors_are_to_be_open():
    result, _ = built((), "open", shut_from=SHUT_FROM)
    (found,) = result.doors
    assert (shown(result, found.shut_cells) < 0.5).all()


def test_a_leaf_that_was_shut_all_the_time_stays_as_it_is():
    result, recording = built((), shut_from=0)
    assert all(len(one.states) == 1 for one in result.doors)
    assert np.median(result.p_static[on_leaf(result, recording)]) > 0.5


def seen_at(*seconds):
    return np.array(seconds, np.int64).reshape(-1, 2) * S


def test_states_of_a_leaf_in_the_order_of_time():
    runs = list_runs("shut", seen_at(1, 2, 4, 5, 20, 21), np.array([9, 11, 30]) * S)
    assert runs == (
        DoorState("shut", S, 5 * S),
        DoorState("open", 9 * S, 11 * S),
        DoorState("shut", 20 * S, 21 * S),
        DoorState("open", 30 * S, 30 * S),
    )
    assert list_runs("open", seen_at(1, 2), np.zeros(0, np.int64)) == (DoorState("open", S, 2 * S),)


def test_a_door_found_once_has_one_position():
    shut = dataclasses.replace(door(("shut", 5, 5)), opened=math.nan)
    assert shut.position_in("last") == shut.position_in("majority") == "shut"
    assert shut.position_in("open") == "open"
