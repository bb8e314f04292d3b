"""The default estimator on cases that can be judged by hand."""

from dataclasses import replace

import numpy as np
import pytest
from made_up import RESOLUTION, ROOM, Ball, Wall, Watched, cone, fan, passing, watch
from rooms import ROOM as WALLS
from rooms import ROUTE, drive

from stillmap import em
from stillmap.core import chunks
from stillmap.em import occupancy_hmm
from stillmap.results.eval.labels import assign_equal_width_bins, compute_calibration_error

BALL = len(ROOM)  # the number of the first ball


@pytest.fixture(scope="module")
def busy() -> Watched:
    """A room for a minute and a half: one walks past, one stands for 20 s and leaves."""
    return watch([*ROOM, *passing(30), Ball(2.5, 1.0, 40, 60)], seconds=90)


@pytest.fixture(scope="module")
def known(busy):
    return busy.e_step()


def test_walls_are_static_and_who_walks_or_stands_for_a_while_is_dynamic(busy, known):
    walls = busy.of(known.p_static, 0, 1, 2)
    assert np.median(walls) > 0.99
    assert np.quantile(walls, 0.02) > 0.9
    walker = busy.of(known.p_static, *range(BALL, BALL + 5))
    stands = busy.of(known.p_static, BALL + 5)
    assert len(walker) > 30
    assert walker.max() < 0.1
    assert len(stands) > 100
    assert np.median(stands) < 0.05
    assert np.quantile(stands, 0.95) < 0.3
    for since, until in ((0, 25), (65, 90)):  # at the start, at the end
        seen = watch([*ROOM, *passing(30), Ball(2.5, 1.0, since, until)], seconds=90)
        assert np.median(seen.of(seen.e_step().p_static, BALL + 5)) < 0.2


def test_fitted_parameters(busy, known):
    hit = busy.what >= 0
    cells = np.floor(busy.recording.points[hit] / RESOLUTION).astype(int)
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    movers = np.bincount(cell, busy.what[hit] >= BALL) / np.bincount(cell)
    assert known.learned["p_static"] == pytest.approx(1 - movers.mean(), abs=0.03)
    assert 0.005 < known.learned["scatter"] < 0.03
    for name in ("static_occupied", "mover_occupied", "mover_seconds"):
        assert sum(row["share"] for row in known.learned[name]) == pytest.approx(1, abs=1e-4)


def test_a_single_observation_has_the_prior():
    # in the last scan the sensor turns round, and sees another wall and somebody
    u = fan()
    behind = [Wall((-1, 0), 5.0), Ball(-2.0, 1.0, 0, 90)]
    seen = watch([*ROOM, *passing(30), *behind], 60, lambda t: u if t < 59 else -u)
    found = seen.e_step()
    once = seen.of(found.p_static, BALL + 5, BALL + 6)
    assert len(once) > 20
    assert once == pytest.approx(found.learned["p_static"], abs=1e-6)
    assert np.ptp(found.p_static) > 0.9


def test_labels_of_maximum_range_and_unusable_beams(busy):
    r = busy.recording
    points, hit = r.points.copy(), r.hit.copy()
    points[50:60], hit[50:60] = np.nan, False
    hit[100:110] = False
    changed = replace(busy, recording=replace(r, points=points, hit=hit))
    found = changed.e_step()
    assert found.p_static.dtype == np.float32
    assert np.isnan(found.p_static[50:60]).all()
    assert found.p_static[100:110] == pytest.approx(found.learned["p_static"])
    assert np.isfinite(found.p_static).sum() == len(hit) - 10


@pytest.mark.parametrize("slant", [70, 80, 85])
def test_slanted_walls_are_static(slant):
    # each beam passes close by all of the wall before the place where it ends
    distance = 6 * np.cos(np.radians(slant))  # this far away under the slant
    u = fan(161, width=2 * (90 - slant + 6))
    walls = [Wall((0, 1), distance), Wall((1, 0), 14.0)]
    movers = [Ball(3.0, -0.1, 30, 33)]
    seen = watch([*walls, *movers], 60, u, noise=0.02)
    e = seen.of(seen.e_step().p_static, 0)
    assert len(e) > 500
    assert np.quantile(e, 0.05) > 0.9


def test_corners_are_static():
    # the end of a wall: beside it beams go on, within a cell of its last end points
    seen = watch([Wall((1, 0), 2.0, width=0.53), *ROOM, *passing(30)], 60, fan(361))
    e = seen.of(seen.e_step().p_static, 0)
    assert np.quantile(e, 0.05) > 0.8


def test_beams_of_one_time_bin_are_one_observation(busy, known):
    r = busy.recording
    twice = replace(
        r, points=np.repeat(r.points, 2, axis=0), hit=np.repeat(r.hit, 2), offset=2 * r.offset
    )
    found = replace(busy, recording=twice).e_step()
    np.testing.assert_allclose(found.p_static[::2], known.p_static, atol=0.005)
    np.testing.assert_array_equal(found.p_static[::2], found.p_static[1::2])


def test_a_time_bin_may_span_scans(busy, known):
    r = busy.recording
    offset = np.unique(np.concatenate([r.offset, (r.offset[1:] + r.offset[:-1]) // 2]))
    split = replace(
        r,
        offset=offset,
        stamp_ns=np.repeat(r.stamp_ns, 2) + np.tile([0, 10**8], r.n_scans),
        sensor=np.zeros(2 * r.n_scans, np.int32),
    )
    found = replace(busy, recording=split).e_step()
    assert found.p_static.tobytes() == known.p_static.tobytes()
    assert found.likelihood == known.likelihood


@pytest.mark.parametrize(("beams", "threads"), [(1, 1), (5000, 3)])
def test_chunks_and_threads_change_no_bit(busy, known, monkeypatch, beams, threads):
    monkeypatch.setattr(chunks, "CHUNK_BEAMS", beams)
    found = occupancy_hmm.e_step(busy.recording, busy.poses, 0.1, em.EmOptions(), threads)
    assert found.p_static.tobytes() == known.p_static.tobytes()
    assert (found.likelihood, found.learned) == (known.likelihood, known.learned)


def test_invariant_to_stamp_and_map_origin(busy, known):
    # stamps and the place of the map are only conventions
    r = busy.recording
    later = replace(busy, recording=replace(r, stamp_ns=r.stamp_ns + 123 * 10**15))
    assert later.e_step().p_static.tobytes() == known.p_static.tobytes()
    moved = busy.poses
    moved[:, :2, 2] = 800.0, -1600.0  # whole cells
    found = occupancy_hmm.e_step(r, moved, 0.1, em.EmOptions())
    np.testing.assert_allclose(found.p_static, known.p_static, atol=0.02)


def test_the_bound_prefers_true_poses(busy, known):
    assert known.likelihood.bound > known.likelihood.expected
    rng = np.random.default_rng(0)
    shaken = busy.poses
    shaken[:, :2, 2] += rng.normal(scale=0.15, size=(len(shaken), 2))
    found = occupancy_hmm.e_step(busy.recording, shaken, 0.1, em.EmOptions())
    assert found.likelihood.bound < known.likelihood.bound


@pytest.mark.parametrize("dimension", [2, 3])
def test_without_hits_labels_are_the_prior(dimension):
    seen = watch([], 10, fan() if dimension == 2 else cone(5))
    found = seen.e_step(prior=0.8)
    np.testing.assert_array_equal(found.p_static, np.float32(0.8))
    assert np.isfinite([found.likelihood.bound, found.likelihood.expected]).all()
    assert len(found.occupied.cells) == 0
    # of what is hit once everything is as likely as before
    once = watch([Ball(2.0, 0.0, 0, 9, radius=0.01)], 1, fan(3, 40))
    assert once.recording.hit.sum() == 1
    assert once.e_step(prior=0.7).p_static[1] == pytest.approx(0.7, abs=1e-6)


@pytest.fixture(scope="module")
def crowd():
    """Three minutes in a room with four people, at poses that are known."""
    laser = {"beams": 180, "range_noise": 0.01, "max_range": 12.0}
    route = (*ROUTE, ROUTE[0])
    return drive(np.random.default_rng(7), WALLS, route, 4, laser=laser, robot={"scans": 500})


def test_labels_are_calibrated(crowd):
    r = crowd.recording
    found = occupancy_hmm.e_step(r, crowd.truth.T_world_base, 0.05, em.EmOptions())
    p, static = found.p_static[r.hit].astype(float), crowd.truth.static[r.hit]
    assert 0.01 < 1 - static.mean() < 0.4
    assert compute_calibration_error(p, static, assign_equal_width_bins(p)) < 0.01
    assert p[static].mean() > 0.97
    assert p[~static].mean() < 0.15


def test_walls_that_poses_put_in_several_places_do_not_make_all_else_dynamic():
    # a narrow view turns three times about eight walls, each time 0.4 m from where it was
    def turning(t):
        a = np.radians(6.0 * t)
        return fan(41, 60.0) @ np.array([[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]])

    walls = [Wall((np.cos(a), np.sin(a)), 4.0) for a in np.radians(np.arange(0, 360, 45))]
    seen = watch(walls, 180, turning)
    turn = 2.0 * (np.arange(seen.recording.n_scans) // 60)
    poses = seen.poses
    poses[:, :2, 2] = 0.4 * np.column_stack([np.cos(turn), np.sin(turn)])
    found = occupancy_hmm.e_step(seen.recording, poses, RESOLUTION, em.EmOptions())
    e = seen.of(found.p_static, *range(len(walls)))
    assert (e < 0.5).mean() < 0.5
    assert found.learned["p_static"] > 0.8
