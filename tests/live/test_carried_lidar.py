"""A lidar that is carried while it maps: lost until it recognizes a place, and apart until then."""

import json
from dataclasses import replace

import numpy as np
import pytest
from live_runs import simulate_sweeps

import stillmap
from stillmap.core import se2
from stillmap.live.mapper import LiveMapper
from stillmap.live.replay import iter_beams
from stillmap.live.sweep_loop_closer import _find_untied, find_alike, view_from_above
from stillmap.sim import scene_by_name, simulate
from stillmap.slam.types import LoopClosure

BEFORE, FROM, TO = 110, 40, 85  # sweeps until it is put back; then those from there on


def follow(*parts):
    """Sweeps one after another, ten a second."""
    every = [beams for part in parts for beams in part]
    return [replace(beams, stamp_ns=10**8 * k) for k, beams in enumerate(every)]


@pytest.fixture(scope="module")
def back():
    """A lidar that is put back to where it was: updates, map sizes, poses, true poses, mapper."""
    lidar = {"channels": 16, "columns": 360}
    changes = {"lidar": lidar, "robot": {"scans": BEFORE, "speed": 2.0}}
    simulation = simulate(scene_by_name("hall", changes), 2)
    beams, true = list(iter_beams(simulation.recording)), simulation.truth.T_world_base
    updates, sizes = [], []
    with LiveMapper({"threads": 1}) as mapper:
        for one in follow(beams, beams[FROM:TO]):
            updates.append(mapper.push(one))
            sizes.append(len(mapper.cells.cells))
        yield updates, sizes, mapper.poses, np.concatenate([true, true[FROM:TO]]), mapper


def errors(poses, true):
    """m off, in the frame of the first sweep."""
    return np.linalg.norm((se2.inverse(true[0]) @ true - poses)[:, :3, 3], axis=1)


@pytest.mark.slow
def test_it_is_lost_until_it_recognizes_the_place(back):
    updates, sizes, poses, true, mapper = back
    doubts = [update.doubts for update in updates]
    carried = next(k for k, one in enumerate(doubts) if "carried" in one)
    assert BEFORE < carried < BEFORE + 8
    found = next(k for k in range(carried, len(doubts)) if "lost" not in doubts[k])
    assert all("lost" in one for one in doubts[carried:found])
    assert not any(doubts[found:])
    off = errors(np.array([update.pose for update in updates]), true)
    assert off[carried] > 5.0
    assert off[found:].max() < 0.3
    # poses in hindsight: those that contradicted the map are unknown
    off = errors(poses, true)
    unknown = np.flatnonzero(np.isnan(off))
    assert BEFORE - 6 < unknown[0] <= unknown[-1] < BEFORE + 8
    assert np.nanmax(off) < 0.3
    # what is seen until then is apart; and there is one hall in the end, not two
    assert sizes[carried] < 0.5 * sizes[carried - 1]
    assert sizes[found] > sizes[carried - 1]
    assert max(mapper.map.p_occupied.shape) * mapper.map.resolution < 60.0
    assert len(mapper.path) > 12


@pytest.mark.slow
def test_where_it_has_never_been_it_stays_lost(tmp_path):
    hall, corridor = (
        list(iter_beams(simulate_sweeps(scene, 40).recording)) for scene in ("hall", "corridor")
    )
    with LiveMapper({"threads": 1}) as mapper:
        doubts = [mapper.push(one).doubts for one in follow(hall, corridor)]
        assert sum("carried" in one for one in doubts) == 1
        assert "lost" in doubts[-1]
        assert mapper.map.p_occupied.size > 0
        known = np.isfinite(mapper.poses).all(axis=(1, 2))
        mapper.save(tmp_path / "out")
    assert known[:35].all()
    assert not known[40:].any()
    assert len(stillmap.load(tmp_path / "out").poses) == known.sum()
    assert len(stillmap.load(tmp_path / "out/live/submaps/1").poses) > 30
    record = json.loads((tmp_path / "out/run.json").read_text())
    assert record["input"]["lost_scans"] == (~known).sum()


def test_stretches_are_tied_by_two_loops():
    def loops(*ends):
        return [LoopClosure(a, b, np.eye(4), np.eye(6), 1.0) for a, b in ends]

    carried = [10, 20]  # 0: 0 to 9, 1: 10 to 19, 2: from 20 on
    assert _find_untied(carried, []) == (10, 20)
    assert _find_untied(carried, loops((1, 2), (1, 12), (11, 12))) == (10, 20)
    assert _find_untied(carried, loops((1, 12), (2, 13))) == (20,)
    assert _find_untied(carried, loops((11, 22), (12, 23))) == (10, 20)
    assert _find_untied(carried, loops((11, 22), (12, 23), (3, 14), (4, 15))) == ()
    wrong = [one.reject("explains too little") for one in loops((1, 12))]
    assert _find_untied(carried, [*loops((2, 13)), *wrong]) == (10, 20)


def make_place(rng):
    """Points of walls and boxes around."""
    angles = np.repeat(rng.uniform(-np.pi, np.pi, 40), 50) + rng.uniform(-0.2, 0.2, 2000)
    distance = np.repeat(rng.uniform(2.0, 30.0, 40), 50)
    height = np.repeat(rng.uniform(0.2, 4.0, 40), 50) * rng.uniform(0.0, 1.0, 2000)
    return np.stack([distance * np.cos(angles), distance * np.sin(angles), height], axis=1)


def turned(points, yaw):
    """The points as seen by a robot that is turned by yaw."""
    c, s = np.cos(yaw), np.sin(yaw)
    return points @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def test_a_place_is_found_again_from_another_heading():
    rng = np.random.default_rng(0)
    places = [make_place(rng) for _ in range(20)]
    earlier = np.array([view_from_above(points) for points in places])
    for number, yaw in ((3, 0.0), (7, 1.1), (12, 2.0), (19, 4.5)):
        again = turned(places[number][::2], yaw) + rng.normal(0.0, 0.1, (1000, 3))
        best, *others = find_alike(view_from_above(again), earlier, 3)
        assert best.number == number
        assert abs(np.angle(np.exp(1j * (best.yaw - yaw)))) < 0.12
        assert len(others) == 2
        assert best.similarity > 1.3 * others[0].similarity
