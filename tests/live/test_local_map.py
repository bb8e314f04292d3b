"""The local map of live mapping: scans labelled again and removed, all at once or a part."""

from dataclasses import replace

import numpy as np
import pytest

import stillmap
from stillmap.core import se2
from stillmap.live.local_map import LocalMap, MappedScan
from stillmap.live.scan import to_beams

ANGLES = np.linspace(-2.0, 2.0, 90)


def mapped(n, spacing=0.5):
    """The n-th of some scans along a line."""
    beams = to_beams(stillmap.Scan(0.1 * n, np.full(len(ANGLES), 4.0), ANGLES))
    every = np.ones(len(ANGLES), np.float32)
    return MappedScan(beams, every, se2.matrix(spacing * n, 0.0, 0.0), spacing * n)


def counts(local_map):
    """Sum of the evidence of all cells."""
    grid = local_map.grid
    cells = grid.block_cells[:, None] + np.argwhere(np.ones((32, 32)))
    return grid.alpha_beta(cells.reshape(-1, 2)).sum(axis=0).tolist()


def test_new_labels_are_those_of_a_scan_that_is_added_anew():
    rng = np.random.default_rng(3)
    angles = np.linspace(-2.0, 2.0, 300)
    ranges = np.where(rng.random(300) < 0.1, np.inf, 4.0 / np.cos(0.3 * angles))
    mount = 0.2, 0.1, 0.3
    beams = to_beams(stillmap.Scan(0.0, ranges, angles, max_range=20.0, sensor_pose=mount))
    e, later = rng.random((2, 300), dtype=np.float32)
    later[:100], e[150:] = e[:100], 1.0
    scan = MappedScan(beams, e, se2.matrix(1.3, -0.4, 0.7), 0.0)
    maps = LocalMap(0.05), LocalMap(0.05)
    maps[0].add(scan)
    maps[0].tend(10**9, 0.0, lambda _: later, 1)
    maps[1].add(replace(scan, e=later))
    assert counts(maps[0]) != counts(LocalMap(0.05))
    for cells in (maps[0].grid.block_cells, maps[1].grid.block_cells):
        every = (cells[:, None] + np.argwhere(np.ones((32, 32)))).reshape(-1, 2)
        np.testing.assert_array_equal(*(one.grid.alpha_beta(every) for one in maps))


def test_scans_of_long_ago_leave():
    local_map, last = LocalMap(0.1), LocalMap(0.1)
    for n in range(60):
        assert local_map.add(mapped(n))
        if n >= 10:
            last.add(mapped(n))
    local_map.tend(0, 30.0, None, 99)
    assert counts(local_map) == pytest.approx(counts(last))


def test_work_that_is_due_is_spread_over_scans_until_it_is_late():
    local_map, labelled = LocalMap(0.1), []

    def label(scan):
        labelled.append(scan.beams.stamp_ns)
        return scan.e

    for n in range(5):
        local_map.add(mapped(n))
    local_map.tend(1_400_000_000, 0.0, label, 1)
    # due since 0.4 and 0.3 s: late; since 0.2 s: as many as may be
    assert labelled == [0, 100_000_000, 200_000_000][: len(labelled)]
    assert len(labelled) == 2
    local_map.tend(1_400_000_000, 0.0, label, 1)
    assert labelled[2:] == [200_000_000]
    local_map.tend(1_400_000_000, 0.0, label, 9)
    assert labelled[3:] == [300_000_000, 400_000_000]
