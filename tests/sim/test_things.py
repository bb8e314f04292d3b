"""Things that are moved, brought and taken away, and a robot that stands overnight."""

import numpy as np
import pytest

from stillmap.core.config import override
from stillmap.sim import Scene, load_truth, scene_by_name, simulate, write_simulation
from stillmap.sim.dynamics import faces_at_all_places, place_faces
from stillmap.sim.planner import compute_segment_distance
from stillmap.sim.scene import Stay, Thing
from stillmap.sim.walls import box

CRATE = tuple(box(0, 0, 1.0, 0.6))
MOVED = Thing(CRATE, (Stay(2.0, 1.0, until=20.05), Stay(-2.0, 1.0, 0.5, since=20.05)))
TAKEN = Thing(CRATE, (Stay(0.0, 3.0, until=30.0),))
BROUGHT = Thing(CRATE, (Stay(3.0, 3.0, since=10.0),))
LEFT_ALONE = Thing(CRATE, (Stay(-3.0, 3.0),))
THINGS = (MOVED, TAKEN, BROUGHT, LEFT_ALONE)
NOBODY = {"crowd": {"people": 0}}


def yard(things=THINGS, speed=0.001, **changes):
    """A robot that creeps along in the middle of a yard of 10 m, for 40 s."""
    walls = tuple(box(0, 0, 10, 10))
    scene = Scene(name="yard", walls=walls, route=((0.0, -3.0), (0.5, -3.0)), things=things)
    usual = {
        "robot": {"scans": 200, "speed": speed},
        "laser": {"beams": 181, "fov": 2 * np.pi, "range_noise": 0.0, "no_return_share": 0.0},
        **NOBODY,
    }
    merged = {key: {**usual.get(key, {}), **changes.get(key, {})} for key in {*usual, *changes}}
    return simulate(override(scene, merged), 2)


def seconds_of(run):
    stamps = run.recording.stamp_ns
    return np.asarray(1e-9 * (stamps - stamps[0]))


def test_a_thing_is_where_it_stays_and_else_nowhere():
    run = yard()
    seconds, movers = seconds_of(run), run.truth.movers
    assert run.truth.scene["mover_kinds"] == ["thing"] * 4
    before = seconds < 20.05
    np.testing.assert_array_equal(movers[before, 0], [[2.0, 1.0, 0.0]] * before.sum())
    np.testing.assert_array_equal(movers[~before, 0], [[-2.0, 1.0, 0.5]] * (~before).sum())
    np.testing.assert_array_equal(np.isnan(movers[:, 1, 0]), seconds >= 30.0)
    np.testing.assert_array_equal(np.isnan(movers[:, 2, 0]), seconds < 10.0)
    assert not np.isnan(movers[:, 3]).any()


@pytest.mark.parametrize("sweep_time", [0.0, 0.2])
def test_beams_meet_a_thing_only_where_it_stands(end_points, sweep_time):
    run = yard(laser={"sweep_time": sweep_time})
    xy, scan = end_points(run)
    truth, seconds = run.truth, seconds_of(run)
    for number, thing in enumerate((MOVED, TAKEN, BROUGHT)):
        hits = truth.mover == number
        assert hits.any()
        for stay in thing.stays:
            there = (seconds >= stay.since) & (seconds < (stay.until or np.inf))
            faces = place_faces(thing, stay)
            mine = xy[hits & there[scan]]
            off = np.min([compute_segment_distance(mine, face) for face in faces], axis=0)
            assert off.max() < 1e-3
            # nothing of it elsewhere: nobody sees it on the way
            assert not np.isnan(truth.movers[scan[hits], number, 0]).any()
            # and where it was, beams go on to the wall
            gone = xy[~there[scan]]
            inside = np.abs(gone - (stay.x, stay.y)) < (0.2, 0.2)
            assert not inside.all(axis=1).any()
    assert not truth.static[truth.mover >= 0].any()


def test_what_is_there_at_the_end_lasts(tmp_path):
    run = yard()
    faces = [place_faces(thing, thing.stays[-1]) for thing in (MOVED, BROUGHT)]
    np.testing.assert_allclose(run.truth.lasting, np.concatenate(faces))
    assert not len(yard(robot={"scans": 1}).truth.lasting)  # nothing has changed yet
    write_simulation(run, tmp_path / "run")
    np.testing.assert_array_equal(load_truth(tmp_path / "run").lasting, run.truth.lasting)
    (tmp_path / "run/truth/lasting.npy").unlink()  # as where there are none
    assert load_truth(tmp_path / "run").lasting.shape == (0, 4)


def test_a_thing_that_never_changes_is_a_wall():
    run = yard()
    assert len(run.truth.walls) == 4 + 4
    np.testing.assert_allclose(run.truth.walls[4:], place_faces(LEFT_ALONE, LEFT_ALONE.stays[0]))
    assert not (run.truth.mover == 3).any()
    early = yard(robot={"scans": 40})
    # two have not changed yet, and one is not there yet
    assert len(early.truth.walls) == 4 + 3 * 4
    assert (early.truth.mover == -1).all()
    assert np.isnan(early.truth.movers[:, 2]).all()


def test_everybody_keeps_clear_of_every_place():
    """At both ends of its way a thing is in the way throughout, also while it is not there."""
    wide = tuple(box(0, 0, 9.0, 0.2))
    later = Thing(wide, (Stay(0.0, 0.0, since=1e6),))
    walls, route = tuple(box(0, 0, 10, 10)), ((0.0, -3.0), (0.0, 3.0))
    changes = {"crowd": {"people": 8}, "robot": {"scans": 400, "speed": 1.0}}
    for things in ((later,), (Thing(wide[:1], later.stays),)):
        scene = Scene(name="yard", walls=walls, route=route, things=things)
        run = simulate(override(scene, changes), 1)
        everybody = [run.truth.T_world_base[:, None, :2, 2], run.truth.movers[:, :8, :2]]
        for face in faces_at_all_places(things):
            for xy in everybody:
                assert compute_segment_distance(xy, face).min() > 0.2


def paused(pause, **changes):
    robot = {"scans": 300, "speed": 0.5, "pause_at": 20.0, "pause": pause}
    return simulate(scene_by_name("hall", {"robot": robot, "laser": {"beams": 60}, **changes}), 4)


def test_a_pause_is_a_leap_of_the_stamps_and_of_nothing_else():
    run = paused(28_800.0)
    gaps = np.diff(run.recording.stamp_ns)
    first = run.truth.scene["paused_at_scan"]
    assert first == 100
    assert gaps[first - 1] == pytest.approx(28_800.2e9)
    np.testing.assert_array_equal(np.delete(gaps, first - 1), 200_000_000)
    for poses in (run.truth.T_world_base, run.recording.T_odom_base):
        assert np.hypot(*np.diff(poses[:, :2, 2], axis=0).T).max() < 0.11


@pytest.mark.slow
def test_nothing_goes_on_evenly_through_a_pause():
    """The beams of the last scan before it meet people where they were then."""
    laser = {"beams": 60, "sweep_time": 0.2, "range_noise": 0.0}
    still, run = paused(0.0, laser=laser), paused(3600.0, laser=laser)
    ranges = [np.hypot(*r.recording.points.T).reshape(300, 60) for r in (still, run)]
    np.testing.assert_array_equal(ranges[0][:99], ranges[1][:99])
    off = np.abs(ranges[0][99] - ranges[1][99])
    assert np.mean(off > 0.1) < 0.1
    scan = np.repeat(np.arange(300), 60)
    hit = (run.truth.mover >= 0) & np.isin(scan, [99, 100])
    xy = run.recording.end_points(np.flatnonzero(hit), run.truth.T_world_base)
    centre = run.truth.movers[scan[hit], run.truth.mover[hit], :2]
    assert hit.any()
    assert np.hypot(*(xy - centre).T).max() < 0.48 + 0.2 * 1.6
