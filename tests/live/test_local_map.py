"""The local map of live mapping: scans labelled again and removed, all at once or a part."""

from dataclasses import replace

import numpy as np
import pytest

import stillmap
from stillmap.core import se2
from stillmap.live import local_map as module
from stillmap.live.local_map import LocalMap, MappedScan
from stillmap.live.scan import to_beams

ANGLES = np.linspace(-2.0, 2.0, 90)


def mapped(n, spacing=0.5):
    """The n-th of some scans along a line."""
    beams = to_beams(stillmap.Scan(0.1 * n, np.full(len(ANGLES), 4.0), ANGLES))
    every = np.ones(len(ANGLES), np.float32)
    return MappedScan(beams, every, se2.matrix(spacing * n, 0.0, 0.0), spacing * n)


def relabelled(scan):
    return np.full(len(scan.e), 0.25, np.float32)


def counts(local_map):
    """Sum of the evidence of all cells."""
    grid = local_map.grid
    cells = grid.block_cells[:, None] + np.argwhere(np.ones((32, 32)))
    return grid.alpha_beta(cells.reshape(-1, 2)).sum(axis=0).tolist()


@pytest.fixture
def ten():
    out = LocalMap(0.1)
    for n in range(10):
        assert out.add(mapped(n))
    return out


def test_parts_of_the_work_are_all_of_it(ten):
    other = LocalMap(0.1)
    for n in range(10):
        other.add(mapped(n))
    last = mapped(9).beams.stamp_ns
    assert ten.relabel(last, relabelled) == 10
    done = [other.relabel(last, relabelled, most=3) for _ in range(5)]
    assert done == [3, 3, 3, 1, 0]
    ten.remove_before(2.0)
    for _ in range(4):
        other.remove_before(2.0, most=1)
    assert counts(other) == pytest.approx(counts(ten))
    before = counts(other)
    other.remove_before(2.0, most=1)
    assert counts(other) == before


@pytest.mark.parametrize("rate", [40.0, 25.0])
def test_fast_scans_are_not_delayed_by_several_others(monkeypatch, rate):
    """Only one of them is added, labelled again or removed with each scan."""
    work = [[]]

    def count_calls(name):
        function = getattr(module, name)

        def call(*args, **kwargs):
            work[-1].append(name)
            return function(*args, **kwargs)

        monkeypatch.setattr(module, name, call)

    count_calls("add_scan")
    count_calls("relabel_scan")
    with stillmap.LiveMapper({"slam": {"loop_closure": False}}) as mapper:
        for n in range(round(8.0 * rate)):
            x = 0.5 * n / rate
            ends = np.stack([4.0 * np.cos(ANGLES) - 0.1 * x, 4.0 * np.sin(ANGLES)], axis=1)
            scan = stillmap.Scan(n / rate, np.linalg.norm(ends, axis=1), ANGLES)
            mapper.push(scan, (0.1 * x, 0.0, 0.0))
            work.append([])
    assert max(map(len, work)) == 1
    assert 5 < work.count(["add_scan"]) < len(work)
    assert work.count(["relabel_scan"]) > 5


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
    maps[0].relabel(0, lambda _: later)
    maps[1].add(replace(scan, e=later))
    assert counts(maps[0]) != counts(LocalMap(0.05))
    for cells in (maps[0].grid.block_cells, maps[1].grid.block_cells):
        every = (cells[:, None] + np.argwhere(np.ones((32, 32)))).reshape(-1, 2)
        np.testing.assert_array_equal(*(one.grid.alpha_beta(every) for one in maps))
