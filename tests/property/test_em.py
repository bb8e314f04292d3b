"""What must hold for EM with fixed poses in any world."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import reference
from hypothesis import given, settings
from hypothesis import strategies as st

from stillmap import _core

both = pytest.mark.parametrize("kernels", [reference, _core])
worlds_of = settings(max_examples=40, deadline=None, derandomize=True, database=None)
priors = st.sampled_from([0.1, 0.3, 0.5, 0.7, 0.8, 0.95])


@dataclass(frozen=True)
class World:
    """A few beams close together, so that they meet in the cells (of one metre)."""

    points: Any
    hit: Any
    offset: Any
    T_map_sensor: Any
    e: Any

    @property
    def beams(self) -> tuple[Any, ...]:
        return self.points, self.hit, self.offset, self.T_map_sensor

    @property
    def usable(self) -> Any:
        return np.isfinite(self.points).all(axis=1)

    def grid(self, kernels: Any) -> Any:
        grid = self.empty_grid(kernels)
        kernels.add_beams(grid, self.points, self.hit, self.e, self.offset, self.T_map_sensor)
        return grid

    def empty_grid(self, kernels: Any) -> Any:
        return (kernels.OccupancyGrid2D if self.points.shape[1] == 2 else kernels.OccupancyGrid3D)(
            1.0
        )

    def cells(self) -> Any:
        """(K, D) all cells anywhere near."""
        axes = [np.arange(-9, 9)] * self.points.shape[1]
        return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, len(axes))

    def scans(self, first: int, last: int) -> "World":
        a, b = self.offset[first], self.offset[last]
        offset = self.offset[first : last + 1] - a
        T = self.T_map_sensor[first:last]
        return World(self.points[a:b], self.hit[a:b], offset, T, self.e[a:b])


@st.composite
def worlds(draw: Any, dimensions: tuple[int, ...] = (2, 2, 3)) -> World:
    D = draw(st.sampled_from(dimensions))
    sizes = draw(st.lists(st.integers(0, 8), min_size=1, max_size=4))
    M = sum(sizes)
    # halves of cells make corners and borders frequent, the rest makes everything else
    coordinate = st.one_of(st.integers(-5, 5).map(lambda x: x / 2), st.floats(-2.5, 2.5, width=16))
    triples = st.lists(coordinate, min_size=D, max_size=D)
    points = np.array(draw(st.lists(triples, min_size=M, max_size=M)), np.float32).reshape(M, D)
    kinds = np.array(draw(st.lists(st.sampled_from("hhhm-"), min_size=M, max_size=M)), str)
    points[kinds == "-"] = np.nan
    T = np.tile(np.eye(D + 1), (len(sizes), 1, 1))
    T[:, :D, D] = draw(st.lists(triples, min_size=len(sizes), max_size=len(sizes)))
    turns = draw(st.lists(st.floats(-3, 3, width=16), min_size=len(sizes), max_size=len(sizes)))
    T[:, 0, 0], T[:, 0, 1] = np.cos(turns), -np.sin(turns)
    T[:, 1, 0], T[:, 1, 1] = np.sin(turns), np.cos(turns)
    e = draw(st.lists(st.floats(0, 1, width=32), min_size=M, max_size=M))
    offset = np.array([0, *np.cumsum(sizes)], np.int64)
    return World(points, kinds == "h", offset, T, np.array(e, np.float32))


@both
@given(world=worlds(), prior=priors)
@worlds_of
def test_bound_never_decreases(kernels, world, prior):
    history = reference.em_fixed_poses(*world.beams, prior, 1.0, 5, kernels)
    bounds = [b for step in history for b in (step.bound_after_m, step.bound)]
    for before, after in pairwise(bounds):
        assert after >= before - 1e-5


@both
@given(world=worlds(), prior=priors)
@worlds_of
def test_bound_touches_the_log_evidence(kernels, world, prior):
    # after the E-step: sum of l_j ln(1 - m_j), and of ln(p m + (1 - p)(1 - m)) over the hits
    step = reference.em_fixed_poses(*world.beams, prior, 1.0, 2, kernels)[-1]
    evidence = 0.0
    for _, passed, end in walks(world, kernels):
        m = occupancy_of(step.grid, np.array([cell for cell, _ in passed] or [[0] * len(end)]))
        lengths = np.array([length for _, length in passed] or [0.0])
        evidence += (lengths * np.log(np.maximum(1 - m, 1e-12))).sum()
    for n, _, end in walks(world, kernels):
        if world.hit[n]:
            m = occupancy_of(step.grid, np.array([end]))[0]
            evidence += np.log(prior * m + (1 - prior) * (1 - m))
    assert step.bound == pytest.approx(evidence, abs=1e-4)


def walks(world: World, kernels: Any) -> Any:
    """(beam, [(cell, length)] before its end cell, end cell) of each usable beam."""
    D = world.points.shape[1]
    for t, T in enumerate(world.T_map_sensor):
        for n in range(world.offset[t], world.offset[t + 1]):
            if world.usable[n]:
                end = T[:D, :D] @ world.points[n].astype(float) + T[:D, D]
                cells, lengths = kernels.traverse(T[:D, D].copy(), end, 1.0)
                passed = list(zip(cells[:-1].tolist(), lengths[:-1].tolist(), strict=True))
                yield n, passed, cells[-1].tolist()


def occupancy_of(grid: Any, cells: Any) -> Any:
    alpha, beta = grid.alpha_beta(cells.astype(np.int64)).T
    return np.nan_to_num(reference.occupancy(alpha, beta))


@both
@given(world=worlds())
@worlds_of
def test_counts_are_conserved(kernels, world):
    first, alpha, beta = world.grid(kernels).dense()
    hits = world.hit & world.usable
    passed = sum(length for _, cells, _ in walks(world, kernels) for _, length in cells)
    assert alpha.sum() == pytest.approx(world.e[hits].sum(dtype=float), abs=1e-5)
    assert alpha.sum() + beta.sum() == pytest.approx(passed + hits.sum(), abs=1e-4)
    assert (alpha >= 0).all()
    assert (beta >= 0).all()
    assert len(first) == alpha.ndim == beta.ndim


@both
@given(world=worlds(), prior=priors)
@worlds_of
def test_probabilities_are_probabilities_and_unknown_stays_unknown(kernels, world, prior):
    cells = world.cells()
    known = world.grid(kernels).alpha_beta(cells).sum(axis=1) > 0
    for step in reference.em_fixed_poses(*world.beams, prior, 1.0, 4, kernels):
        alpha, beta = step.grid.alpha_beta(cells).T
        m = reference.occupancy(alpha, beta)
        assert (np.isnan(m) == ~known).all()
        assert ((m[known] >= 0) & (m[known] <= 1)).all()
        assert (np.isnan(step.e) == ~world.usable).all()
        usable = step.e[world.usable]
        assert ((usable >= 0) & (usable <= 1)).all()
        assert (step.e[world.usable & ~world.hit] == np.float32(prior)).all()


@both
@given(world=worlds(), prior=priors)
@worlds_of
def test_cells_never_touched_are_not_known(kernels, world, prior):
    touched = set()
    for n, passed, end in walks(world, kernels):
        touched |= {tuple(cell) for cell, length in passed if length > 1e-6}
        touched |= {tuple(end)} if world.hit[n] else set()
    cells = world.cells()
    counts = reference.m_step_map(
        world.points, world.hit, np.full(len(world.hit), prior, np.float32),
        world.offset, world.T_map_sensor, 1.0, kernels,
    ).alpha_beta(cells)  # fmt: skip
    known = {tuple(cell) for cell in cells[counts.sum(axis=1) > 1e-6].tolist()}
    assert known == touched


@both
@given(world=worlds(), split=st.integers(0, 4))
@worlds_of
def test_merged_grids_are_the_grid_of_all(kernels, world, split):
    T = len(world.T_map_sensor)
    split = min(split, T)
    parts = [world.scans(0, split), world.scans(split, T)]
    whole, cells = world.grid(kernels), world.cells()
    for first, second in (parts, parts[::-1]):
        merged = first.grid(kernels)
        merged.merge(second.grid(kernels))
        if kernels is _core:  # integer sums: to the bit
            assert (merged.alpha_beta(cells) == whole.alpha_beta(cells)).all()
        np.testing.assert_allclose(merged.alpha_beta(cells), whole.alpha_beta(cells), atol=1e-12)
        if world.points.shape[1] == 2:
            points = np.linspace(-2, 2, 12).reshape(6, 2).astype(np.float32)
            probes = points, np.ones(6, np.float32), np.eye(3), 0.7, 2, 0.01, 0.1
            costs = [kernels.registration_cost(grid, *probes) for grid in (merged, whole)]
            assert costs[0] == pytest.approx(costs[1], abs=1e-9)


@both
@given(world=worlds())
@worlds_of
def test_more_static_beams_never_lower_the_occupancy(kernels, world):
    cells = world.cells()
    before = occupancy_of(world.grid(kernels), cells)
    sure = World(*world.beams, np.sqrt(world.e))
    assert (occupancy_of(sure.grid(kernels), cells) >= before - 1e-6).all()
