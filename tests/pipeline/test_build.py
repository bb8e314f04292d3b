"""What `build` returns belongs together: map, labels, poses, numbers."""

import dataclasses
import math
import operator

import numpy as np
import pytest
from choices import ESTIMATORS, RESOLUTION, options, with_any_estimator
from threadpoolctl import threadpool_info, threadpool_limits

import stillmap
from stillmap import em
from stillmap.io.trajectory import read_tum
from stillmap.tracking.motion_evidence import apply_motion_evidence


def end_cells(recording, poses, origin, resolution, beams):
    """(row, column) of the end points of these beams, straight from geometry."""
    ends = recording.end_points(np.flatnonzero(beams), poses)
    first = np.round(np.array(origin[:2]) / resolution)
    column, row = (np.floor(ends / resolution) - first).astype(int).T
    return row, column


def part(whole, m):
    """What the sums alpha, beta of a map are where a smaller one lies."""
    offset = np.subtract(m.origin[:2], whole.origin[:2]) / m.resolution
    column, row = np.round(offset).astype(int)
    height, width = m.alpha.shape
    cells = np.s_[row : row + height, column : column + width]
    return whole.alpha[cells], whole.beta[cells]


def expected_labels(recording, poses, alpha, beta, origin, resolution, prior):
    """(6), (8) once more, from plain arrays."""
    e = np.full(recording.n_beams, np.nan)
    usable = np.isfinite(recording.points).all(axis=1)
    e[usable] = prior
    hit = recording.hit
    cells = end_cells(recording, poses, origin, resolution, hit)
    a, b = alpha[cells], beta[cells]
    assert np.all(a + b > 0)  # every hit has been counted where it ends
    m = a / (a + b)
    e[hit] = prior * m / (prior * m + (1 - prior) * (1 - m))
    return e


def with_unusable(recording):
    points, hit = recording.points.copy(), recording.hit.copy()
    points[100:110], hit[100:110] = np.nan, False
    return dataclasses.replace(recording, points=points, hit=hit)


@pytest.mark.parametrize("prior", [0.9, 0.6])
@pytest.mark.parametrize("fixed", [False, True])
def test_the_printed_labels_follow_from_the_map(room, prior, fixed):
    recording = with_unusable(room.recording)
    poses = room.truth.T_world_base if fixed else None
    chosen = options("paper", max_iterations=3, prior=prior)
    result = stillmap.build(recording, chosen, poses=poses)
    m = result.map
    grid = m.alpha, m.beta, m.origin, m.resolution
    expected = expected_labels(recording, result.poses, *grid, prior)
    assert result.p_static.dtype == np.float32
    np.testing.assert_allclose(result.p_static, expected, atol=1e-6)
    assert np.isnan(result.p_static[100:110]).all()
    assert np.ptp(result.p_static[recording.hit]) > 0.5


@pytest.mark.parametrize("fixed", [False, True])
def test_the_map_follows_from_the_labels(room, fixed):
    recording = with_unusable(room.recording)
    poses = room.truth.T_world_base if fixed else None
    result = stillmap.build(recording, options(max_iterations=2), poses=poses)
    m, e, hit = result.map, result.p_static, recording.hit
    cells = end_cells(recording, result.poses, m.origin, m.resolution, hit)
    alpha = np.zeros(m.alpha.shape)
    np.add.at(alpha, cells, e[hit].astype(float))
    np.testing.assert_allclose(m.alpha, alpha, atol=1e-4)
    # whatever ends in one cell is as static as the thing in it
    lowest, highest = np.full(alpha.shape, np.inf), np.full(alpha.shape, -np.inf)
    np.minimum.at(lowest, cells, e[hit])
    np.maximum.at(highest, cells, e[hit])
    np.testing.assert_array_equal(lowest[cells], highest[cells])
    # a cell is occupied by it, or else as free as it looks
    free = 0.2 / 0.8 * np.exp(-m.beta)
    free = free / (1 + free)
    ceiling = highest[cells] + (1 - highest[cells]) * free[cells]
    assert (m.p_occupied[cells] <= ceiling + 1e-6).all()
    assert (m.p_occupied[cells] >= free[cells] - 1e-6).all()
    assert (m.p_occupied[cells] > 0.45).mean() > 0.5  # walls may lie between two cells
    passed = (alpha == 0) & ~np.isnan(m.p_occupied)
    assert passed.mean() > 0.2
    np.testing.assert_allclose(m.p_occupied[passed], free[passed], atol=1e-6)
    assert np.isnan(e[100:110]).all()
    assert np.ptp(e[hit]) > 0.5
    assert result.mapping.changes == []
    poses, chosen = result.mapping.near.poses, result.options.em
    again, courses = em.final_e_step(recording, poses, m.resolution, chosen, threads=2)
    noise_std = courses.surfel_map.noise_std
    given_tracks, _ = apply_motion_evidence(result.deskewed, poses, again.p_static, noise_std)
    np.testing.assert_array_equal(given_tracks, e)
    assert again.learned == {k: v for k, v in result.learned.items() if k != "changing"}
    assert 0.0 < result.learned["changing"] < 1.0


def test_the_labels_written_follow_from_the_map_written(room, tmp_path):
    result = stillmap.build(room.recording, options("paper", max_iterations=2, prior=0.8))
    result.save(tmp_path / "out")
    arrays = np.load(tmp_path / "out/map.npz")
    _, T = read_tum(tmp_path / "out/trajectory.tum")
    poses = T[:, [0, 1, 3]][:, :, [0, 1, 3]]
    grid = (arrays[name] for name in ("alpha", "beta", "origin", "resolution"))
    expected = expected_labels(room.recording, poses, *grid, 0.8)
    written = np.load(tmp_path / "out/beams/p_static.npy")
    # a trajectory of nine digits may move one end point in a thousand across an edge
    off = np.abs(written - expected) > 1e-6
    assert off.mean() < 1e-3
    np.testing.assert_array_equal(np.load(tmp_path / "out/beams/hit.npy"), room.recording.hit)


@pytest.fixture(scope="module", params=ESTIMATORS)
def mapped(room, request):
    return stillmap.build(room.recording, options(request.param, max_iterations=2))


def test_the_looks_that_the_map_rests_on(room, mapped, tmp_path):
    result, estimator = mapped, mapped.options.estimator
    found, known = result.evidence, ~np.isnan(result.map.p_occupied)
    assert found.observations.shape == known.shape
    # to the cell: what is known has been looked at, and nothing else has
    np.testing.assert_array_equal(found.observations > 0, known)
    np.testing.assert_array_equal(found.thinly_observed, known & (found.unobstructed < 3))
    assert (found.unobstructed <= found.observations).all()
    assert 0.01 < found.thinly_observed[known].mean() < 0.5
    assert "evidence" in result.stages
    if estimator == "stillmap":  # the others call too few of the beams dynamic at first
        assert (found.unobstructed < found.observations).any()
    counts = []
    for threads in (1, 3):
        chosen = dataclasses.replace(options(estimator, max_iterations=1), threads=threads)
        again = stillmap.build(room.recording, chosen, poses=result.poses)
        counts.append(again.evidence.unobstructed)
    np.testing.assert_array_equal(*counts)
    result.save(tmp_path / "out")
    written = np.load(tmp_path / "out/map.npz")
    np.testing.assert_array_equal(written["clear_looks"], found.unobstructed)


def test_unknown_stays_nan(mapped):
    m, estimator = mapped.map, mapped.options.estimator
    unknown = np.isnan(m.p_occupied)
    crossed = m.alpha + m.beta > 0
    assert not crossed.all()
    assert unknown[~crossed].all()
    known = ~unknown
    assert 0 <= m.p_occupied[known].min() <= m.p_occupied[known].max() <= 1
    if estimator != "stillmap":
        np.testing.assert_array_equal(known, crossed)
    if estimator == "paper":
        expected = m.alpha[known] / (m.alpha + m.beta)[known]
        np.testing.assert_allclose(m.p_occupied[known], expected, atol=1e-6)


def test_what_a_lost_beam_alone_crossed_is_unknown(room):
    # beams get lost one at a time, and seem to go on behind the walls
    r, poses = room.recording, room.truth.T_world_base
    lost = r.hit & (np.random.default_rng(0).random(r.n_beams) < 0.3)
    lost[1::2] = False
    points, hit = r.points.copy(), r.hit & ~lost
    points[lost] *= (7.0 / np.linalg.norm(points[lost], axis=1))[:, None]
    points[~r.hit] = np.nan
    lossy = dataclasses.replace(r, points=points, hit=hit)
    points = np.where(hit[:, None], points, np.float32(np.nan))
    without = dataclasses.replace(lossy, points=points)
    m, bare = (
        stillmap.build(recording, options(max_iterations=1), poses=poses).map
        for recording in (lossy, without)
    )
    known = ~np.isnan(m.p_occupied)
    assert known.sum() == (~np.isnan(bare.p_occupied)).sum()
    np.testing.assert_array_equal(m.alpha[m.alpha > 0], bare.alpha[bare.alpha > 0])
    # the map is no larger than what is known
    assert known.any(axis=0)[[0, -1]].all()
    assert known.any(axis=1)[[0, -1]].all()
    # the sums are those of (10): all beams are in them
    raw = stillmap.build(lossy, options("paper", max_iterations=1, prior=0.5), poses=poses).map
    assert (raw.beta > 0).sum() > 1.2 * known.sum()
    np.testing.assert_allclose(m.alpha + m.beta, np.add(*part(raw, m)), atol=1e-5)
    assert (np.isnan(raw.p_occupied) == (raw.alpha + raw.beta == 0)).all()


@with_any_estimator
def test_unknown_is_what_no_beam_saw(room, estimator):
    # the case of 0.9 x 0.6 m in the room: its inside was never seen, the floor beside it was
    poses = room.truth.T_world_base
    m = stillmap.build(room.recording, options(estimator, max_iterations=1), poses=poses).map
    cells = np.round((np.array([[1.5, 1.6], [0.0, 0.0]]) - m.origin[:2]) / RESOLUTION).astype(int)
    inside, floor = (m.p_occupied[row, column] for column, row in cells)
    assert np.isnan(inside)
    assert floor < 0.1


def test_the_raw_map_counts_every_hit_as_static(room, mapped):
    result, raw, hit = mapped, mapped.raw_map, room.recording.hit
    counts = np.zeros(raw.alpha.shape)
    cells = end_cells(room.recording, result.poses, raw.origin, raw.resolution, hit)
    np.add.at(counts, cells, 1.0)
    np.testing.assert_array_equal(raw.alpha, counts)
    assert raw.alpha.sum() == hit.sum()
    # its beta is the way that beams went through: no dynamic hit is in it
    alpha, beta = part(raw, result.map)
    if result.options.estimator != "hit-ratio":
        assert beta.sum() < result.map.beta.sum()
    np.testing.assert_allclose(result.map.alpha + result.map.beta, alpha + beta, atol=1e-4)


@pytest.mark.parametrize("estimator", ["stillmap", "paper"])
def test_movers_are_told_from_walls(room, estimator):
    result = stillmap.build(room.recording, options(estimator, max_iterations=4))
    e, r, m = result.p_static, room.recording, result.map
    movers = room.truth.mover >= 0
    assert e[movers].mean() < 0.4
    assert e[room.truth.static].mean() > 0.8
    walls = np.zeros(m.alpha.shape, bool)
    walls[end_cells(r, result.poses, m.origin, m.resolution, r.hit & ~movers)] = True
    theirs = end_cells(r, result.poses, m.origin, m.resolution, movers)
    alone = ~walls[theirs]
    assert alone.mean() > 0.8
    assert (m.p_occupied[theirs] > 0.5)[alone].mean() < 0.15
    assert (m.p_occupied[walls] > 0.4).mean() > 0.5
    left = m.alpha[theirs][alone].sum() / part(result.raw_map, m)[0][theirs][alone].sum()
    assert left < {"stillmap": 0.15, "paper": 0.4}[estimator]


@pytest.mark.parametrize("estimator", ["stillmap", "paper"])
def test_the_history_is_complete(room, estimator):
    chosen = options(estimator, max_iterations=3, tolerance=0.0, label_tolerance=0.0, patience=9)
    result = stillmap.build(room.recording, chosen)
    assert [it.number for it in result.iterations] == [1, 2, 3]
    for it in result.iterations:
        assert math.isfinite(it.bound)
        assert math.isfinite(it.expected_log_likelihood)
        assert it.bound >= it.expected_log_likelihood  # an entropy is not negative
        assert 0.0 <= it.changed_share <= 1.0
        assert it.seconds > 0.0
    assert result.iterations[0].changed_share > result.iterations[-1].changed_share
    assert {"m_step", "e_step", "maps"} <= set(result.stages)
    assert all(stage["peak_memory_bytes"] > 1e6 for stage in result.stages.values())
    assert result.options.em.max_iterations == 3
    compared = "held_out_log_likelihood" if estimator == "stillmap" else "bound"
    best = max(result.iterations, key=lambda it: getattr(it, compared))
    assert result.best_iteration == best.number
    last = len(result.iterations)
    assert [s.number for s in result.snapshots] == sorted({1, 2, result.best_iteration, last})


@pytest.mark.parametrize("estimator", ["stillmap", "paper"])
def test_fixed_poses_are_kept_and_the_bound_never_falls(room, estimator):
    poses = room.truth.T_world_base
    bounds = []
    for it in stillmap.iterate(room.recording, options(estimator, max_iterations=8), poses=poses):
        np.testing.assert_array_equal(it.estimate.poses, poses)
        bounds.append(it.estimate.bound)
    gains = np.diff(bounds)
    assert len(gains) == 7
    assert (gains >= -1e-6 * np.abs(bounds[:-1])).all()
    if estimator == "stillmap":  # looks only at where beams ended: poses are all that matters
        assert len(set(bounds)) == 1
        return
    assert bounds[-1] > bounds[0] + 10.0
    assert gains[-1] < 0.1 * gains[0]


def test_one_e_step_of_all_ones_is_the_raw_map(room):
    # a prior of almost 1 leaves nothing to be dynamic in the first iteration
    sure = options("paper", prior=1 - 1e-7)
    first = next(stillmap.iterate(room.recording, sure, poses=room.truth.T_world_base))
    chosen = options(max_iterations=1)
    result = stillmap.build(room.recording, chosen, poses=room.truth.T_world_base)
    alpha, beta = part(first.occupancy, result.raw_map)
    np.testing.assert_allclose(alpha, result.raw_map.alpha, atol=1e-4)
    np.testing.assert_allclose(beta, result.raw_map.beta, atol=1e-4)


def same(a, b):
    names = ("poses", "estimate.m_step.covariance", "p_static", "map.alpha", "map.beta")
    get = operator.attrgetter(*names, "map.p_occupied", "raw_map.alpha", "raw_map.beta")
    for x, y in zip(get(a), get(b), strict=True):
        assert x.tobytes() == y.tobytes()
    assert [it.bound for it in a.iterations] == [it.bound for it in b.iterations]
    assert a.best_iteration == b.best_iteration


@pytest.mark.slow
@with_any_estimator
@pytest.mark.parametrize("fixed", [False, True])
def test_the_same_to_the_bit_with_any_number_of_threads(room, fixed, estimator):
    poses = room.truth.T_world_base if fixed else None
    chosen = options(estimator, max_iterations=2)
    results = [
        stillmap.build(room.recording, dataclasses.replace(chosen, threads=threads), poses=poses)
        for threads in (1, 1, 2, 3, 0)
    ]
    for other in results[1:]:
        same(results[0], other)


def test_the_order_of_memory_does_not_matter(room):
    # as from a memory map: arrays that cannot be written to
    names = ("points", "hit", "offset", "sensor")
    frozen = {name: getattr(room.recording, name).copy() for name in names}
    for array in frozen.values():
        array.setflags(write=False)
    read_only = dataclasses.replace(room.recording, **frozen)
    chosen = options(max_iterations=2)
    same(*(stillmap.build(recording, chosen) for recording in (room.recording, read_only)))


def test_linear_algebra_has_one_thread_while_a_job_is_done(room):
    seen = set()

    def look(*_):
        seen.update(one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas")

    with threadpool_limits(2, "blas"):
        stillmap.build(room.recording, options("stillmap", max_iterations=1), progress=look)
    assert seen == {1}
