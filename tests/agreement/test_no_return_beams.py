"""Beams without a return: kernel against twin, and by hand."""

import numpy as np
import pytest
import reference

from stillmap import _core


@pytest.fixture(scope="module", params=[(2, 0.15, 120), (3, 0.4, 160)], ids=["2D", "3D"])
def lossy(request, a_room):
    """A room where some beams have no return, alone and in runs, and end behind the wall."""
    dimension, resolution, beams = request.param
    room = a_room(3, dimension, resolution, 16, beams)
    rng = np.random.default_rng(3)
    b = room.beams
    lost = rng.random(len(b.hit)) < 0.1
    for start in rng.integers(0, len(lost), 12):
        lost[start : start + rng.integers(2, 9)] = True
    points = np.where(lost[:, None], np.float32(1.6) * b.points, b.points).astype(np.float32)
    points[rng.random(len(lost)) < 0.03] = np.nan
    usable = np.isfinite(points).all(axis=1)
    return room, b.with_(points=points, hit=b.hit & ~lost & usable)


def parts(kernels, beams, stops, end_margin, threads=1):
    """Grids of the trusted part and of the remainder."""
    grids = beams.empty_grid(kernels), beams.empty_grid(kernels)
    kernels.add_no_return_beams(*grids, *beams.arguments, stops, end_margin, threads)
    return grids


def cells_of(*grids):
    return np.unique(np.array([cell for grid in grids for cell in grid.alpha], np.int64), axis=0)


@pytest.mark.parametrize("end_margin", [0.0, 0.3, np.inf])
@pytest.mark.parametrize("stopped", [False, True])
def test_add_no_return_beams(lossy, stopped, end_margin):
    room, beams = lossy
    hmm = room.hmm(_core, room.surface(_core), [0.5], [1.0])
    stops = hmm.solid_cells() if stopped else np.zeros((0, beams.dimension), np.int64)
    assert stops.dtype == np.int64
    assert (len(stops) > 20) == stopped
    everything = beams.grid(reference)
    cells = cells_of(everything)
    shares = []
    found = (parts(k, beams, stops, end_margin) for k in (_core, reference))
    for core, plain in zip(*found, strict=True):
        a, b = core.alpha_beta(cells), plain.alpha_beta(cells)
        assert (a[:, 0] == 0).all()
        # cells left at the limit may fall on either side
        assert (np.abs(a - b)[:, 1] > 1e-5).mean() < 2e-3
        shares.append(b[:, 1].sum() / sum(everything.beta.values()))
    assert 0.1 < sum(shares) < 0.7
    assert shares[1] > 0.03
    assert (shares[0] > 0.01) == (end_margin < np.inf)


def test_solid_cells(lossy):
    room, _ = lossy
    found = [room.hmm(k, room.surface(k), [0.5], [1.0]).solid_cells() for k in (_core, reference)]
    assert set(map(tuple, found[0])) == set(map(tuple, found[1]))
    assert len(found[0]) > 20
    round_ones = room.hmm(_core, room.surface(_core), [0.5], [1.0], use_normals=False)
    assert round_ones.solid_cells().shape == (0, room.beams.dimension)


@pytest.mark.parametrize("threads", [1, 3])
def test_parts_sum_up_exactly(lossy, threads):
    room, beams = lossy
    stops = room.hmm(_core, room.surface(_core), [0.5], [1.0]).solid_cells()
    hits = np.where(beams.hit[:, None], beams.points, np.float32(np.nan)).astype(np.float32)
    grid = beams.with_(points=hits).grid(_core)
    for part in parts(_core, beams, stops, 0.3, threads):
        grid.merge(part)
    for a, b in zip(grid.dense(), beams.grid(_core).dense(), strict=True):
        np.testing.assert_array_equal(a, b)


def test_short_runs_are_not_trusted():
    # runs of two and four, and of three cut by the end of a scan
    T = np.tile(np.eye(3), (4, 1, 1))
    T[:, 1, 2] = 0.5, 2.5, 4.5, 4.5
    offset = np.array([0, 3, 7, 9, 10])
    hit = np.array([1, 0, 0, 0, 0, 0, 0, 0, 0, 0], bool)
    points = np.tile(np.array([[4.5, 0.0]], np.float32), (10, 1))
    stops = np.array([[3, 2]])
    cells = [np.array([[x, y] for x in range(5)]) for y in (0, 2, 4)]
    for kernels in (_core, reference):
        grids = kernels.OccupancyGrid2D(1.0), kernels.OccupancyGrid2D(1.0)
        kernels.add_no_return_beams(*grids, points, hit, offset, T, stops, 0.4)
        for grid, expected in zip(
            grids,
            (
                ([0, 0, 0, 0, 0], [4, 4, 4, 0, 0], [0, 0, 0, 0, 0]),
                ([2, 2, 2, 2, 0], [0, 0, 0, 4, 0], [3, 3, 3, 3, 0]),
            ),
            strict=True,
        ):
            found = [grid.alpha_beta(row)[:, 1].tolist() for row in cells]
            assert found == [pytest.approx(row) for row in expected]
