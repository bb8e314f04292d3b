"""Surfel map and occupancy HMM: kernel against twin on small rooms."""

from dataclasses import replace
from itertools import pairwise
from math import inf

import numpy as np
import pytest
import reference
from reference.observation import HIT, SURE
from scipy.special import ndtr
from surfel_maps import fit_both, order, together

from stillmap import _core
from stillmap.em.observations import HmmClasses

CLASSES = HmmClasses(view_rho=(0.65,)).grid()


@pytest.fixture(
    scope="module",
    params=[(2, 0, 0.1, 24, 70), (2, 1, 0.07, 24, 70), (3, 2, 0.4, 16, 150)],
    ids=["2D-0", "2D-1", "3D"],
)
def room(request, a_room):
    dimension, seed, resolution, scans, beams = request.param
    return a_room(seed, dimension, resolution, scans, beams)


def assert_same_surfels(core, plain):
    of_core, of_plain = order(core), order(plain)
    assert core.size == plain.size == len(of_core) > 50
    cells, means, normals, off_plane, prominence, beams = (a[of_core] for a in core.surfels())
    expected = tuple(a[of_plain] for a in plain.surfels())
    np.testing.assert_array_equal(cells, expected[0])
    np.testing.assert_array_equal(beams, expected[5])
    np.testing.assert_allclose(prominence, expected[4], rtol=1e-12)
    assert prominence.max() == 1  # cells with the most returns in their window
    assert prominence.min() < 0.5
    np.testing.assert_allclose(means, expected[1], atol=1e-6)
    flat = expected[2].any(axis=1)
    assert 0.4 < flat.mean() < 1
    np.testing.assert_array_equal(normals.any(axis=1), flat)
    side = np.where(np.einsum("kd,kd->k", normals, expected[2]) < 0, -1.0, 1.0)
    np.testing.assert_allclose(normals * side[:, None], expected[2], atol=1e-4)
    np.testing.assert_allclose(off_plane * side, expected[3], atol=1e-4)
    assert np.abs(expected[3]).max() > 0.2 * core.resolution
    assert core.noise_std == pytest.approx(plain.noise_std, rel=1e-3)


def test_surfels(room):
    core, plain = room.surface(_core), room.surface(reference)
    assert_same_surfels(core, plain)
    assert 0.005 < plain.noise_std < 0.6 * room.beams.resolution


@pytest.mark.parametrize(("noise", "least"), [(0.07, 0.04), (0.1, 0.06)])
def test_noise_widens_the_window(a_room, noise, least):
    loud = a_room(5, 2, 0.05, 24, 120, noise=noise)
    core, plain = loud.surface(_core), loud.surface(reference)
    assert_same_surfels(core, plain)
    assert plain.noise_std > least  # a window of two cells to each side would see less


def see_both_faces(apart, noise, y_other=1.5, dated=None):
    """Surfel maps (of the kernel, plain) of a thin wall along x, of clutter and of plain walls.

    One face is seen from y = -1, the other one from `y_other`; `dated`: time bins, given x. So much
    is on plain walls that windows stay small.
    """
    rng = np.random.default_rng(4)
    x = rng.uniform(-2.0, 2.0, 3000)
    face = np.where(rng.random(len(x)) < 0.5, 0.033, 0.033 + apart)
    sensor = np.column_stack([x, np.where(face < 0.1, -1.0, y_other)])
    y = face + noise * rng.standard_normal(len(x)) - sensor[:, 1]
    points = np.column_stack([np.zeros(len(x)), y]).astype(np.float32)
    clutter = rng.uniform(-8.0, -6.0, (400, 2))
    plain = np.column_stack([rng.uniform(-6.0, 6.0, 5000), 5.0 + noise * rng.standard_normal(5000)])
    others = np.concatenate([clutter, plain]).astype(np.float32)
    T = np.tile(np.eye(3), (len(x) + len(others), 1, 1))
    T[: len(x), :2, 2] = sensor
    beams = np.concatenate([points, others]), np.ones(len(T), bool), np.arange(len(T) + 1), T
    time_bin = None
    if dated is not None:
        time_bin = np.concatenate([dated(x), np.zeros(len(others))]).astype(np.int64)
    return fit_both("SurfelMap2D", 0.05, *beams, time_bin)


def compare_normals(core, plain):
    """(N, 2) normals of the surfels of the face at y = 0.033, 0 where there is none."""
    of_core, of_plain = order(core), order(plain)
    normals, expected = core.surfels()[2][of_core], plain.surfels()[2][of_plain]
    np.testing.assert_array_equal(normals.any(axis=1), expected.any(axis=1))
    np.testing.assert_allclose(np.abs(normals), np.abs(expected), atol=1e-4)
    return normals[core.surfels()[0][of_core][:, 1] == 0]


@pytest.mark.parametrize(("apart", "noise"), [(0.11, 0.008), (0.13, 0.015), (0.1, 0.04)])
def test_both_faces_of_a_thin_wall(apart, noise):
    """A window of five cells holds both; without noise as wide, each of them has a normal."""
    normals = compare_normals(*see_both_faces(apart, noise))
    has_normal = normals.any(axis=1)
    if noise < 0.03:
        assert has_normal.mean() > 0.9
        assert (np.abs(normals[has_normal, 1]) > 0.9).mean() > 0.95


@pytest.mark.parametrize(
    ("dated", "least", "most"),
    [
        (lambda x: np.arange(len(x)) % 100, 0.9, 1.0),  # in view all the time
        (lambda x: 10.0 * (x + 2.0), 0.0, 0.1),  # feet of somebody who walks by
        (None, 0.0, 0.1),
    ],
)
def test_two_faces_that_are_seen_from_one_side(dated, least, most):
    """They are those of a wall if all of their cells are hit for about as long."""
    normals = compare_normals(*see_both_faces(0.11, 0.008, y_other=-1.0, dated=dated))
    assert least <= normals.any(axis=1).mean() <= most


def test_associate_beams(room, a_room):
    core, plain = room.surface(_core), room.surface(reference)
    other = a_room(9, room.beams.dimension, room.beams.resolution, 8, 60).beams
    for beams in (room.beams, other):
        found = core.associate_beams(*beams.arguments)
        expected = plain.associate_beams(*beams.arguments)
        cells = [s.surfels()[0] for s in (core, plain)]
        assert found.dtype == expected.dtype == np.int32
        np.testing.assert_array_equal(found < 0, expected < 0)
        some = found >= 0
        np.testing.assert_array_equal(cells[0][found[some]], cells[1][expected[some]])
        assert found.tobytes() == core.associate_beams(*beams.arguments, 3).tobytes()
    assert (expected >= 0).any()
    assert (expected[other.hit] < 0).any()
    np.testing.assert_array_equal(core.associate_beams(*room.beams.arguments) >= 0, room.beams.hit)


def reliability(hmm):
    """Observation of each surfel: HIT, 0 for none, else the reliability of the miss.

    One class with rho = a = 1/2: a hit has probability 1/4, seeing through 1 - R / 4.
    """
    _, log_best = hmm.likelihood()
    p = np.exp(log_best) / 4
    return np.where(p < 0.5, HIT, np.round(4 * (1 - p), 6))


@pytest.mark.parametrize(
    "changes",
    [{}, {"use_normals": False}, {"margin": 0.25}, {"use_normals": False, "lateral_std": 0.01}],
)
def test_observations(room, changes):
    surfaces = room.surface(_core), room.surface(reference)
    seen = hits = partly = silent = 0
    for t in range(0, len(room.time_bin), 2):
        found = []
        for kernels, surface in zip((_core, reference), surfaces, strict=True):
            hmm = room.hmm(kernels, surface, [0.5], [1.0], p_detection=0.5, **changes)
            hmm.add(*room.scans(t, t + 2), np.array([7, 7]))
            found.append(reliability(hmm)[order(surface)])
        core, plain = found
        np.testing.assert_array_equal(core == HIT, plain == HIT)
        assert_same_reliability(core, plain)
        hits += (plain == HIT).sum()
        seen += (plain == 1.0).sum()
        partly += ((plain > 0.05) & (plain < 0.9)).sum()
        silent += (plain == 0.0).sum()
    assert min(hits, silent) > 20
    assert partly + seen > 10
    assert seen > 5 or "lateral_std" not in changes


@pytest.fixture(scope="module")
def swallowed(room):
    """The room with runs of beams without a return, through walls and beyond."""
    beams = room.beams
    hit, points = beams.hit.copy(), beams.points.copy()
    for start in beams.offset[:-1]:
        row = slice(start + 20, start + 26)
        hit[row] = False
        points[row] *= 1.8
    return replace(room, beams=beams.with_(hit=hit, points=points))


def test_count_no_return_beams(room, swallowed):
    counts = []
    for kernels in (_core, reference):
        hmm = room.hmm(kernels, room.surface(kernels), *CLASSES)
        counts.append(
            [hmm.count_no_return_beams(*some.beams.arguments) for some in (room, swallowed)]
        )
    assert counts[0] == counts[1]
    (few, few_through), (more, through) = counts[0]
    assert more >= few + 3 * len(room.time_bin)
    assert 20 < through - few_through < more


def assert_same_reliability(core, plain):
    """Values near the thresholds may be on either side of them."""
    edge = (np.abs(plain - SURE) < 0.012) | (np.abs(plain) < 0.03) & (np.abs(core) < 0.03)
    sure = (plain == 1.0) & (core > SURE - 0.012)
    np.testing.assert_allclose(core[~(edge | sure)], plain[~(edge | sure)], atol=0.012)


@pytest.mark.parametrize("trusted", [0.0, 0.4, 1.0])
def test_trust_beyond_solid(room, swallowed, trusted):
    points, hit, offset, T = swallowed.scans(4, 14)
    points = np.where(hit[:, None], np.float32(np.nan), points)  # no returns
    found = {}
    for kernels in (_core, reference):
        surface = room.surface(kernels)
        for how in (trusted, 1.0):
            hmm = room.hmm(kernels, surface, [0.5], [1.0], p_detection=0.5)
            hmm.set_trust_beyond_solid(how)
            hmm.add(points, hit, offset, T, np.full(10, 7))
            found[kernels, how] = reliability(hmm)[order(surface)]
    core, plain, all_the_way = found[_core, trusted], found[reference, trusted], found[_core, 1.0]
    assert_same_reliability(core, plain)
    assert (all_the_way - core >= -1e-9).all()
    assert ((all_the_way - core).max() > 0.05) == (trusted < 1.0)


@pytest.mark.parametrize("moves", [None, 0.2, 0.7])
def test_likelihood(room, moves):
    rho, tau = [0.998, 0.6, 0.05, 0.15, 0.5, 0.8], [25.0, 5.0, 0.5, 45.0, inf, 9.0]
    turn = [inf] * 4 + [0.1, 0.7]
    found = []
    for kernels in (_core, reference):
        surface = room.surface(kernels)
        hmm = room.hmm(kernels, surface, rho, tau, turn)
        place = None
        if moves is not None:  # robot positions differ from sensor positions
            steps = np.random.default_rng(1).normal(size=(len(room.time_bin), surface.dimension))
            place = moves * surface.resolution * steps.cumsum(axis=0)
        hmm.add(*room.beams.arguments, room.time_bin, positions=place)
        relative, log_best = hmm.likelihood()
        assert relative.dtype == np.float32
        assert relative.max(axis=1) == pytest.approx(1.0)
        values = np.log(np.maximum(relative, 1e-30)) + log_best[:, None]
        found.append(values[order(surface)])
    core, plain = found
    error = np.abs(core - plain)
    assert np.quantile(error, 0.9) < 0.03
    assert error.max() < 0.3  # a few observations near the thresholds
    assert np.abs(np.diff(plain, axis=1)).max() > 5


@pytest.mark.parametrize("threads", [1, 2, 5, 100])
@pytest.mark.parametrize("cuts", [[], [3], [1, 2, 7, 8, 15]])
@pytest.mark.parametrize("dated", [False, True])
def test_surfels_with_any_number_of_threads(room, threads, cuts, dated):
    surfaces = [type(room.surface(_core))(room.beams.resolution) for _ in range(2)]
    for surface, pieces, many in zip(surfaces, ([], cuts), (1, threads), strict=True):
        for first, last in pairwise([0, *pieces, len(room.time_bin)]):
            bins = room.time_bin[first:last] if dated else None
            surface.add_end_points(*room.scans(first, last), bins, many)
        surface.fit()
    whole, shared = surfaces
    assert whole.noise_std == shared.noise_std
    for a, b in zip(whole.surfels(), shared.surfels(), strict=True):
        assert a.tobytes() == b.tobytes()
    assert len(whole.hit_spans) == (whole.size if dated else 0)
    assert whole.hit_spans.tobytes() == shared.hit_spans.tobytes()


@pytest.mark.parametrize("threads", [1, 2, 5])
@pytest.mark.parametrize("cuts", [[], [3], [1, 2, 7, 8, 15]])
def test_threads_and_chunks_give_the_same_bits(room, threads, cuts):
    surface = room.surface(_core)
    whole = room.hmm(_core, surface, *CLASSES, 0.97)
    whole.add(*room.beams.arguments, room.time_bin)
    pieces = room.hmm(_core, surface, *CLASSES, 0.97)
    whole_bins = np.searchsorted(room.time_bin, room.time_bin[cuts]).tolist()
    for first, last in pairwise([0, *whole_bins, len(room.time_bin)]):
        pieces.add(*room.scans(first, last), room.time_bin[first:last], threads)
    for a, b in zip(whole.likelihood(), pieces.likelihood(), strict=True):
        assert a.tobytes() == b.tobytes()


def test_short_runs_are_not_observed():
    # runs of two beams without a return are skipped, runs of three within a scan are used
    surfaces = fit_both("SurfelMap2D", 0.1, *together([[1.05, 0.05]]))
    T, none = np.tile(np.eye(3), (2, 1, 1)), np.array([[4, 0.2]], np.float32)
    for hits, cut, unusable, expected in (
        ([1, 0, 0, 1], 4, None, False),
        ([1, 0, 0, 0, 1], 5, None, True),
        ([1, 1, 0, 0, 0], 5, None, True),
        ([0, 0, 0], 2, None, False),
        ([0, 0, 0, 0], 4, 2, False),
    ):
        hit, offset = np.array(hits, bool), np.array([0, cut, len(hits)])
        points = np.where(hit[:, None], np.float32([-1, 0]), none).astype(np.float32)
        if unusable is not None:
            points[unusable] = np.nan
        for kernels, s in zip((_core, reference), surfaces, strict=True):
            lengths = {"lateral_std": 0.01, "margin": 0.1, "hit_radius": 0.05, "end_margin": 0.3}
            model = {"rho": [0.5], "tau": [1.0], "p_detection": 0.5, "bin_seconds": 1.0}
            hmm = kernels.OccupancyHmm2D(s, **model, **lengths)
            hmm.add(points, hit, offset, T, np.array([3, 3]))
            assert bool(reliability(hmm)[0]) == expected, hits


def test_normal_distribution_function():
    x = np.concatenate([np.linspace(-9.0, 9.0, 5001), [-np.inf, np.inf, np.nan, 0.0]])
    np.testing.assert_allclose(_core.normal_cdf(x), ndtr(x), rtol=1e-12)
