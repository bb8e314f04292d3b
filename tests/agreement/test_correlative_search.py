"""Branch and bound finds the best lattice pose of the brute-force twin."""

import numpy as np
import pytest
import reference
from marks import slow_params
from reference.likelihood_field import retract

from stillmap import _core

FLOOR, GAIN = 0.05, 0.2
# rounding may differ by one raster step for two beams
TIED = 2 * GAIN * np.log((1 + FLOOR) / FLOOR) / 255


class World:
    """A map of three scans in a slanted room, and a fourth one to register."""

    def __init__(self, a_room, seed, beams=60):
        self.beams = a_room(seed, 2, 0.1, 4, 150).beams
        b, self.seed = self.beams, seed
        self.T = b.T_map_sensor[3]
        mapped = b.with_(hit=b.hit & (np.arange(len(b.hit)) < b.offset[3]))
        self.core, self.plain = mapped.grid(_core), mapped.grid(reference)
        last = slice(b.offset[3], b.offset[4])
        seen = b.hit[last] & np.isfinite(b.points[last]).all(axis=1)
        self.points = np.ascontiguousarray(b.points[last][seen][:beams])
        self.weights = np.random.default_rng(seed).uniform(0, 1, beams).astype(np.float32)
        self.weights[::7] = 0
        self.sigma = b.resolution

    def prior(self, translation, rotation):
        """A random pose in the window around the true one."""
        half_widths = np.array([translation, translation, rotation])
        return retract(self.T, half_widths * np.random.default_rng(self.seed).uniform(-1, 1, 3))

    def options(self, window):
        sizes = {"window_translation": window[0], "window_rotation": window[1], "search_range": 2.0}
        return {"sigma": self.sigma, "floor": FLOOR, "information_scale": GAIN, **sizes}

    def core_found(self, T_prior, information, window, starts=1, iterations=0):
        more = {"radius": 2, "unknown": 0.05, "max_iterations": iterations}
        given = self.points, self.weights, T_prior, information
        options = {**self.options(window), **more, "max_candidates": starts}
        return _core.register_scan(self.core, *given, **options)

    def lattice(self, T_prior, information, window):
        given = self.points, self.weights, T_prior, information
        return reference.search_lattice(self.plain, *given, **self.options(window))


def information(kind, seed):
    """Inverse covariances of a prior: (3, 3)."""
    A = np.random.default_rng(seed).normal(size=(3, 3))
    return {
        "none": np.zeros((3, 3)),
        "even": np.diag([20.0] * 3),
        "one way only": np.diag([50.0, 0.0, 0.0]),
        "correlated": 5 * A @ A.T,
        # correlated rotation and translation, as after a curve; little lateral motion
        "narrow": 400 * np.outer(A[0], A[0]) + np.eye(3),
        "singular": 100 * np.outer(A[0], A[0]),
    }[kind]


def assert_finds_the_best(world, kind, window):
    T_prior, Lambda = world.prior(*window), information(kind, world.seed)
    T, _, _, _, _, tried, _ = world.core_found(T_prior, Lambda, window)
    lattice = world.lattice(T_prior, Lambda, window)
    off, index = lattice.index_of(T)
    assert np.abs(off).max() < 1e-6
    best = lattice.scores.max()
    assert lattice.scores[index] >= best - TIED
    # the others are worse
    assert best > np.median(lattice.scores) + 0.5
    return lattice, tried


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, *slow_params(2)])
@pytest.mark.parametrize(
    "kind", ["none", "even", "one way only", "correlated", "narrow", "singular"]
)
@pytest.mark.parametrize("window", [(0.3, 0.4), (0.45, 0.2), (0.37, 0.0), (0.0, 0.4), (1.0, 1.0)])
def test_best_lattice_pose(a_room, window, kind, seed):
    assert_finds_the_best(World(a_room, seed), kind, window)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["even", *slow_params("correlated")])
def test_branch_and_bound_prunes(a_room, kind):
    lattice, tried = assert_finds_the_best(World(a_room, 4, 40), kind, (3.0, np.pi))
    assert lattice.scores.size > 4e4
    assert tried < 0.2 * lattice.scores.size


@pytest.mark.parametrize("seed", range(3))
def test_more_candidates_are_never_worse(a_room, seed):
    world, window = World(a_room, seed), (0.5, 0.5)
    T_prior, Lambda = world.prior(*window), information("correlated", seed)
    for iterations in (0, 20):
        given = T_prior, Lambda, window
        costs = [world.core_found(*given, starts, iterations)[2] for starts in (1, 3, 10)]
        assert costs[0] >= costs[1] >= costs[2]


def test_the_raster_by_hand():
    # one end point in cell (2, 0) of a metre, passed cells 0 and 1: m = 1 there, sigma 1 m
    grid = reference.OccupancyGrid2D(1.0)
    T = np.eye(3)[None].copy()
    T[0, :2, 2] = 0.5
    hit = np.ones(1, bool), np.ones(1, np.float32), np.array([0, 1])
    reference.add_beams(grid, np.array([[2.0, 0.0]]), *hit, T)
    lattice = reference.search_lattice(
        grid, np.array([[2.0, 0.0]]), np.ones(1), T[0], np.diag([2.0, 2.0, 0.0]), sigma=2 / 3,
        floor=1.0, information_scale=1.0, window_translation=2.0, window_rotation=0.0,
        search_range=9.0,
    )  # fmt: skip
    assert lattice.step == 1.0
    assert lattice.scores.shape == (1, 5, 5)
    for x, y in ((0, 0), (1, 0), (2, 0), (-1, 2)):
        d = x**2 + y**2
        F = np.exp(-d / 2)
        score = lattice.scores[0, 2 + x, 2 + y]
        assert score == pytest.approx(np.log(1 + F) - d, abs=1.5 * np.log(2) / 255)
