"""Things that are moved and a door that swings, from the recording to the result."""

import functools
import operator

import numpy as np
import pytest
from rooms import shown

import stillmap
from stillmap import em
from stillmap.core.config import override
from stillmap.core.square_box import cell_keys
from stillmap.mapping.changed_objects import find_shown_cells, pool_states
from stillmap.pipeline.options import Options
from stillmap.results.map_server import CHANGED, changed_cells
from stillmap.sim import Scene, simulate
from stillmap.sim.options import CrowdOptions, DoorOptions, LaserOptions, RobotOptions
from stillmap.sim.scene import Door, Stay, Thing
from stillmap.sim.walls import box
from stillmap.tracking.motion_evidence import apply_motion_evidence

HINGE, WIDTH = (2.0, 0.9), 0.9
CRATE = tuple(box(0, 0, 0.9, 0.6))
AWAY, HERE, GONE = Stay(-2.0, 1.6, until=90.0), Stay(0.2, 2.1, 0.3, since=90.0), 60.0


@functools.cache
def world():
    """Two rooms and a door between them that is open for 10 to 20 s; two crates, three people.

    One crate is moved after 90 s, the other taken away after a minute.
    """
    partition = ((2.0, -3.0, 2.0, 0.0), (2.0, 0.9, 2.0, 3.0))
    things = (Thing(CRATE, (AWAY, HERE)), Thing(CRATE, (Stay(-2.6, -2.0, until=GONE),)))
    scene = Scene(
        "two rooms",
        walls=(*box(0.5, 0, 9, 6), *partition),
        route=((-0.6, -0.8), (-0.4, -0.8)),
        leaves=(Door(HINGE, WIDTH, -np.pi / 2, -np.pi),),
        doors=DoorOptions(min_open=10.0, max_open=20.0, min_closed=10.0, max_closed=20.0),
        things=things,
        crowd=CrowdOptions(people=2),
        laser=LaserOptions(beams=241, range_noise=0.01, fov=2 * np.pi),
        robot=RobotOptions(scans=300, scan_rate=2.0, speed=0.002),
    )
    return simulate(scene, np.random.default_rng(3))


@functools.cache
def built(state="last", threads=1, changes=True):
    loop = {"max_iterations": 2, "change_detection": changes}
    chosen = {"threads": threads, "output": {"map_state": state}, "em": loop}
    options = override(Options(), chosen)
    return stillmap.build(world().recording, options, poses=world().truth.T_world_base)


def near(change, stay):
    return np.hypot(change.x - stay.x, change.y - stay.y) < 0.6


def seconds(change):
    start = world().recording.stamp_ns[0]
    return 1e-9 * (change.before_ns - start), 1e-9 * (change.stamp_ns - start)


def only(kind, stay):
    (one,) = [one for one in built().mapping.changes if one.kind == kind and near(one, stay)]
    return one


def test_what_was_moved_left_one_place_and_came_to_another():
    for kind, stay in (("left", AWAY), ("came", HERE)):
        before, after = seconds(only(kind, stay))
        assert 88.0 <= before < after <= 92.0
    taken = only("left", Stay(-2.6, -2.0))
    assert seconds(taken)[1] == pytest.approx(GONE, abs=2.0)
    assert len([one for one in built().mapping.changes if one.kind in ("came", "left")]) == 3


def test_the_map_is_that_of_its_state():
    left, came = only("left", AWAY), only("came", HERE)
    most = built("majority")
    assert (shown(built(), came.cells) > 0.65).mean() > 0.5
    assert (shown(built(), left.cells) < 0.2).mean() > 0.9
    assert (shown(most, came.cells) < 0.2).mean() > 0.9
    assert (shown(most, left.cells) > 0.65).mean() > 0.5
    listed = ([(one.kind, one.stamp_ns) for one in r.mapping.changes] for r in (most, built()))
    assert operator.eq(*listed)
    for one in built().mapping.changes:
        if one.kind in ("came", "left"):  # in one state: corners that hold hardly any stay free
            shares = [(shown(result, one.cells) > 0.5).mean() for result in (most, built())]
            assert all(min(share, 1.0 - share) < 0.15 for share in shares)


def test_labels_are_those_of_the_map_shown():
    truth, recording = world().truth, world().recording
    seconds = 1e-9 * (recording.stamp_ns - recording.stamp_ns[0])
    when = np.repeat(seconds, np.diff(recording.offset))
    crate = (truth.mover == truth.scene["mover_kinds"].index("thing")) & recording.hit
    for state, before, after in (("last", 0.0, 1.0), ("majority", 1.0, 0.0)):
        p = built(state).p_static
        assert np.median(p[crate & (when < 90)]) == pytest.approx(before, abs=0.2)
        assert np.median(p[crate & (when > 90)]) == pytest.approx(after, abs=0.2)


def test_what_is_not_listed_stays_what_it_is_without_changes():
    result, without = built().mapping.near, built(changes=False).mapping.near
    scans, poses = result.deskewed, result.poses
    _, courses = em.final_e_step(scans, poses, result.map.resolution, result.options.em)
    cells = {tuple(cell) for one in result.changes for cell in one.cells.tolist()}
    beams = scans.points, scans.hit, scans.offset, scans.T_map_sensor(poses)
    element = courses.surfel_map.associate_beams(*beams)
    of_cells = np.array([tuple(cell) in cells for cell in courses.cells.tolist()])
    there = (element >= 0) & of_cells[element]
    assert 0.01 < there.mean() < 0.3
    pooled = pool_states(courses, result.changes, "last")
    shown = courses.p_in_map("last", pooled)[element]
    on_leaf = np.zeros(len(courses.cells), bool)
    (door,) = [change.door for change in result.changes if change.kind == "door"]
    for leaf in (door.open_cells, door.shut_cells):
        on_leaf |= np.isin(cell_keys(courses.cells), cell_keys(leaf))
    there |= (element >= 0) & on_leaf[element]
    shown[on_leaf[element]] = 0.0
    _, _, p_leaf = find_shown_cells(courses, result.changes, "last")
    shown *= 1.0 - p_leaf[element]
    noise_std = courses.surfel_map.noise_std
    others, _ = apply_motion_evidence(scans, poses, without.p_static, noise_std)
    np.testing.assert_array_equal(result.p_static, np.where(there, shown, others))
    assert (result.p_static != without.p_static).mean() > 0.01
    assert result.learned == {**without.learned, "changing": round(courses.changing_weight, 6)}
    assert without.changes == []
    assert "changing" not in without.learned


def test_a_crate_is_no_object_on_its_way_and_people_are():
    kinds = np.array([*world().truth.scene["mover_kinds"], "wall"])
    met = [kinds[world().truth.mover[one.beams]] for one in built().objects]
    assert sum((kind == "person").mean() > 0.9 for kind in met) > 3
    assert not any((kind == "thing").mean() > 0.5 for kind in met)


def swing():
    return next(one for one in built().mapping.changes if one.kind == "door")


def test_a_door_that_swings_is_one_place():
    (door,) = [one for one in built().mapping.changes if one.kind not in ("came", "left")]
    assert door.kind == "door"
    assert door.times >= 3
    assert seconds(door)[1] < door.last_ns * 1e-9
    np.testing.assert_allclose(door.door.hinge, HINGE, atol=0.2)
    assert door.door.length == pytest.approx(WIDTH, abs=0.2)


def test_a_door_is_open_and_shut_when_it_is():
    truth, recording = world().truth, world().recording
    leaf = truth.scene["mover_kinds"].index("door")
    turned = np.abs(np.angle(np.exp(1j * (truth.movers[:, leaf, 2] - -np.pi / 2))))
    is_shut, is_open = turned < 0.1, turned > np.pi / 2 - 0.1
    assert {one.position for one in swing().door.states} == {"open", "shut"}
    right = total = 0
    for position, since, until in swing().door.states:
        during = (recording.stamp_ns >= since) & (recording.stamp_ns <= until)
        right += (is_shut if position == "shut" else is_open)[during].sum()
        total += during.sum()
    assert total > 0.5 * recording.n_scans
    assert right > 0.9 * total
    away = np.angle(np.exp(1j * (swing().door.shut - -np.pi / 2)))
    assert abs(away) < 0.15


@pytest.mark.parametrize("state", ["last", "majority", "open", "shut"])
def test_the_leaf_is_shown_where_it_was_last_or_mostly_or_as_asked(state):
    door = swing().door
    leaf = {"open": door.open_cells, "shut": door.shut_cells}
    seconds = {"open": 0.0, "shut": 0.0}
    for one in door.states:
        seconds[one.position] += one.until_ns - one.since_ns
    usual = {"last": door.states[-1].position, "majority": max(seconds, key=seconds.get)}
    assert (shown(built(state), leaf.pop(usual.get(state, state))) > 0.5).mean() > 0.7
    (other,) = leaf.values()
    assert (shown(built(state), other) < 0.2).all()
    if state != "majority":
        assert (shown(built(state), only("came", HERE).cells) > 0.65).mean() > 0.5
        assert (shown(built(state), only("left", AWAY).cells) < 0.2).mean() > 0.9


def in_the_sector(margin):
    """Cells that the leaf sweeps over, so far from its edges."""
    r = built().map.resolution
    x, y = np.meshgrid(np.arange(-60, 120), np.arange(-60, 60))
    cells = np.column_stack([x.ravel(), y.ravel()])
    off = (cells + 0.5) * r - HINGE
    far = np.hypot(*off.T) < WIDTH - margin
    return cells[far & (off[:, 0] < -margin) & (off[:, 1] < -margin)]


@pytest.mark.parametrize("state", ["last", "majority"])
def test_where_a_door_swings_the_map_is_free_and_marked(state):
    result = built(state)
    cells = in_the_sector(0.1)
    assert len(cells) > 120
    layer = changed_cells(result.map, result.mapping.changes)
    first = np.round(np.array(result.map.origin[:2]) / result.map.resolution).astype(int)
    column, row = (cells - first).T
    assert (layer[row, column] == CHANGED["door"]).mean() > 0.95
    assert (shown(result, cells) < 0.2).mean() > 0.97


def test_threads_change_no_bit():
    one, other = built(), built(threads=2)
    assert one.p_static.tobytes() == other.p_static.tobytes()
    assert one.map.p_occupied.tobytes() == other.map.p_occupied.tobytes()
    for a, b in zip(one.mapping.changes, other.mapping.changes, strict=True):
        names = ("kind", "x", "y", "size", "before_ns", "stamp_ns", "last_ns", "times")
        assert operator.attrgetter(*names)(a) == operator.attrgetter(*names)(b)
        np.testing.assert_array_equal(a.cells, b.cells)
    assert one.stages["changes"]["seconds"] > 0.0
