"""Scans whose place in the map is not known are kept apart from it."""

import json
from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from live_runs import distances_to_walls

import stillmap
from stillmap.core import se2
from stillmap.live.mapper import LiveMapper
from stillmap.live.replay import iter_beams
from stillmap.results.eval.trajectory import align
from stillmap.sim import scene_by_name, simulate

BEFORE, ELSEWHERE, AGAIN = 120, 170, 230  # scans, until it is carried on


@pytest.fixture(scope="module")
def worlds():
    changes = {"crowd": {"people": 0}, "robot": {"scans": 130}}
    return [simulate(scene_by_name(name, changes), 1) for name in ("hall", "corridor")]


def push_all(mapper, worlds, scans):
    """Push scans (world, number); the robot is carried where they do not follow each other."""
    beams = [list(iter_beams(world.recording)) for world in worlds]
    odometry, given, doubts = [world.recording.T_odom_base for world in worlds], np.eye(3), []
    for number, (world, k) in enumerate(scans):
        if number and scans[number - 1] == (world, k - 1):
            given = given @ se2.inverse(odometry[world][k - 1]) @ odometry[world][k]
        one = replace(beams[world][k], stamp_ns=200_000_000 * number)
        doubts.append(mapper.push(one, given).doubts)
    return doubts


@pytest.fixture(scope="module")
def run(worlds, tmp_path_factory):
    """A robot that is carried out of the hall, back again, and away: poses in hindsight, true ones
    relative to the hall, doubts, and the folder of the result."""
    hall = [(0, k) for k in range(BEFORE)]
    there = [(1, k) for k in range(ELSEWHERE - BEFORE)]
    back = [(0, k) for k in range(40, 40 + AGAIN - ELSEWHERE)]
    scans = [*hall, *there, *back, *[(1, k) for k in range(60, 110)]]
    folder = tmp_path_factory.mktemp("lost") / "out"
    with LiveMapper({"threads": 1}) as mapper:
        doubts = push_all(mapper, worlds, scans)
        poses = mapper.poses
        mapper.save(folder)
    true = np.array([worlds[world].truth.T_world_base[k] for world, k in scans])
    return poses, true, doubts, folder


@pytest.mark.slow
def test_poses_elsewhere_are_not_known(run):
    poses, true, doubts, _ = run
    known = np.isfinite(poses).all(axis=(1, 2))
    assert known[: BEFORE - 5].all()
    assert known[ELSEWHERE + 25 : AGAIN - 5].all()
    assert not known[BEFORE:ELSEWHERE].any()
    assert not known[AGAIN:].any()
    off = (align(true[: BEFORE - 5], poses[: BEFORE - 5]) @ true - poses)[known, :2, 2]
    assert np.hypot(*off.T).max() < 0.1
    assert "lost" in doubts[ELSEWHERE - 1]
    assert not doubts[AGAIN - 1]
    assert "lost" in doubts[-1]


@pytest.mark.slow
def test_the_saved_map_has_the_known_ones_and_tells_what_was_left_out(run, worlds):
    poses, _, _, folder = run
    known = np.isfinite(poses).all(axis=(1, 2))
    saved = stillmap.load(folder)
    np.testing.assert_allclose(saved.poses, poses[known], atol=1e-6)
    assert len(np.load(folder / "live/beams/p_static.npy")) == len(saved.p_static)
    T = worlds[0].truth.T_world_base[0] @ se2.inverse(poses[0])
    assert np.mean(distances_to_walls(saved.map, worlds[0].truth, T) > 0.2) < 0.01
    record, lost = json.loads((folder / "run.json").read_text()), np.flatnonzero(~known)
    assert record["input"]["lost_scans"] == len(lost)
    (text,) = [text for text in record["warnings"] if "left out" in text]
    assert text.startswith(f"{len(lost)} scans, first at {0.2 * lost[0]:.1f} s")
    assert "live/submaps" in text


@pytest.mark.slow
def test_other_places_have_maps_of_their_own(run):
    poses, true, _, folder = run
    lengths = []
    for number in (1, 2):
        saved = stillmap.load(folder / "live/submaps" / str(number))
        given = np.loadtxt(folder / f"live/submaps/{number}/live/trajectory.tum")
        assert len(given) == len(saved.poses)
        first = round(given[0, 0] / 0.2)
        lengths.append(len(saved.poses))
        expected = true[first : first + lengths[-1]]
        off = align(expected, saved.poses) @ expected - saved.poses
        assert np.hypot(*off[:, :2, 2].T).max() < 0.2
    assert min(lengths) >= 20
    assert (
        sum(lengths) < np.isnan(poses[:, 0, 0]).sum()
    )  # those that contradicted the map are in none
    assert not (folder / "live/submaps/3").exists()


@pytest.mark.slow
def test_a_robot_that_was_never_found_makes_a_map_of_its_own(worlds, run, tmp_path):
    *_, known = run
    with LiveMapper({"threads": 1}, place=known, mode="extend") as mapper:
        for beams in islice(iter_beams(worlds[0].recording), 5):
            few = np.arange(len(beams.points)) < 8  # which could be anywhere
            points = np.where(few[:, None], beams.points, np.float32(np.nan))
            assert "lost" in mapper.push(replace(beams, points=points, hit=beams.hit & few)).doubts
        assert np.isnan(mapper.poses).all()
        mapper.save(tmp_path / "out")
    saved = stillmap.load(tmp_path / "out")
    assert len(saved.poses) == 5
    np.testing.assert_allclose(saved.poses[0], np.eye(3), atol=1e-6)
    occupied = [np.sum(one.map.p_occupied > 0.65) for one in (saved, stillmap.load(known))]
    assert occupied[0] < 0.9 * occupied[1]  # the known map is not in it
    record = json.loads((tmp_path / "out/run.json").read_text())
    assert any("never found" in text for text in record["warnings"])
