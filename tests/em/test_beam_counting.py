"""The hit ratio: hits against passes, one half at the threshold."""

import numpy as np
import pytest
from made_up import Ball, Wall, watch
from recordings import of_one_sensor

from stillmap import _core, em
from stillmap.core import se2
from stillmap.em import beam_counting
from stillmap.em.beam_counting import hit_ratio_e_step


def lane(hits, passes):
    """Hits in cell 3 of a lane of cells of one metre, and beams that pass through it."""
    n = hits + passes
    points = np.zeros((n, 2), np.float32)
    points[:, 0] = [3.0] * hits + [6.0] * passes
    return of_one_sensor(np.zeros(1, np.int64), np.array([0, n]), points, np.arange(n) < hits)


def counted(recording):
    poses = se2.matrix([0.5], 0.5, 0.0)
    grid = _core.OccupancyGrid2D(1.0)
    em.add_recording(grid, recording, poses, None)
    return grid, hit_ratio_e_step(recording, poses, grid)


@pytest.mark.parametrize(("hits", "passes"), [(1, 3), (2, 3), (5, 5), (1, 0), (1, 19)])
@pytest.mark.parametrize("threshold", [0.1, 0.25, 0.4, 0.6])
def test_half_at_the_threshold(hits, passes, threshold, monkeypatch):
    monkeypatch.setattr(beam_counting, "MIN_HIT_RATIO", threshold)
    grid, found = counted(lane(hits, passes))
    ratio = hits / (hits + passes)
    odds = ratio / max(1 - ratio, 1e-300) * (1 - threshold) / threshold
    expected = odds / (1 + odds)
    assert found.p_static[:hits] == pytest.approx(expected, abs=1e-6)
    m = em.make_occupancy_map(grid, found.occupied)
    row, column = -round(m.origin[1]), 3 - round(m.origin[0])
    assert m.p_occupied[row, column] == float(ratio >= threshold)
    assert found.occupied.cells.tolist() == [[3, 0]]


def test_monotone_in_the_hit_ratio():
    seen = watch([Wall((1, 0), 4.05), Ball(2.0, 0.0, 3, 5), Ball(2.0, 1.0, 5, 15)], 20)
    p = seen.e_step(estimator="hit-ratio").p_static
    briefly, longer, always = (np.median(seen.of(p, k)) for k in (1, 2, 0))
    assert briefly < 0.5 < longer < always
    assert (p[~seen.recording.hit] == np.float32(0.75)).all()


def test_one_iteration_from_all_static():
    options, recording = em.EmOptions(), lane(2, 1)
    for estimator, iterations, p in (
        ("hit-ratio", 1, 1.0),
        ("stillmap", 6, 0.9),
        ("paper", 6, 0.9),
    ):
        assert em.max_iterations(estimator, options) == iterations
        assert (em.initial_p_static(recording, estimator, options) == np.float32(p)).all()


def test_cells_in_blocks_far_apart():
    recording, grid = lane(3, 1), _core.OccupancyGrid2D(1.0)
    for far in (0.0, 2e6, -1e6):  # dense, that is 4 million rows
        em.add_recording(grid, recording, se2.matrix([0.5], far + 0.5, 0.0), None)
    found = beam_counting.threshold_hit_ratio(grid)
    assert found.cells.tolist() == [[3, -1_000_000], [3, 0], [3, 2_000_000]]
    assert found.p_occupied.tolist() == [1.0, 1.0, 1.0]
