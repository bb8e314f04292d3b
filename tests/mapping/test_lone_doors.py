"""Doors that were seen in one position only: doorways, leaves at them, and whether they moved."""

import dataclasses
import functools
import json
import math

import numpy as np
import pytest
from rooms import drive, shown

import stillmap
from stillmap.core.config import override
from stillmap.mapping.doors import Door, DoorState
from stillmap.pipeline.options import Options
from stillmap.sim.walls import box

S = 10**9


def door(*states):
    stamps = [DoorState(position, since * S, until * S) for position, since, until in states]
    none = np.empty((0, 2), np.int64)
    return Door((0.0, 0.0), 0.9, 0.0, 1.5, none, none, none, tuple(stamps))


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
    walls = *box(0.5, 0.5, 9, 5), *partition, *leaf
    route = ((-2.0, -0.9), (1.0, -0.9), (1.0, 2.0), (-2.0, 2.0))
    laser = {"beams": 361, "range_noise": 0.01, "fov": 2 * np.pi}
    robot = {"scans": 120, "scan_rate": 4.0, "speed": 0.5}
    return drive(np.random.default_rng(3), walls, route, laser=laser, robot=robot)


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


@pytest.mark.parametrize(
    ("leaf", "state", "since", "position"),
    [(FREE, "shut", None, "open"), ((), "open", SHUT_FROM, "shut")],
)
def test_it_is_left_out_where_all_doors_are_to_be_otherwise(leaf, state, since, position):
    result, _ = built(leaf, state, since)
    (found,) = result.doors
    assert (shown(result, getattr(found, f"{position}_cells")) < 0.5).all()


def test_a_leaf_that_was_shut_all_the_time_stays_as_it_is():
    result, recording = built((), shut_from=0)
    assert all(len(one.states) == 1 for one in result.doors)
    assert np.median(result.p_static[on_leaf(result, recording)]) > 0.5


def test_a_door_found_once_has_one_position():
    shut = dataclasses.replace(door(("shut", 5, 5)), opened=math.nan)
    assert shut.position_in("last") == shut.position_in("majority") == "shut"
    assert shut.position_in("open") == "open"
