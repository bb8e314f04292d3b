"""Causal forward filters: kernel against twin, and what they say of simple worlds."""

import numpy as np
import pytest
import reference

from stillmap import _core

CLASSES = {
    "rho": [0.998, 0.95, 0.04, 0.04, 0.15],
    "tau": [25.0, 25.0, 0.5, 12.0, 3.0],
    "weights": [0.45, 0.45, 0.04, 0.04, 0.02],
    "n_static": 2,
    "p_detection": 0.97,
    "bin_seconds": 0.5,
    "lateral_std": 0.4,
    "hit_radius": 1.0,
    "max_log_ratio": 20.0,
}


PIXEL = (0.3, 0.25)  # rad


def make(kernels, dimension, resolution=0.1, **changes):
    kind = getattr(kernels, {2: "OccupancyFilter2D", 3: "SweepFilter3D"}[dimension])
    return kind(resolution, **{**CLASSES, **changes})


def add_scans(filter_, room, bins):
    """All scans of a room one by one, in time bins that rise and once go back."""
    points, hit, offset, T = room.arguments
    for t, time_bin in enumerate(bins):
        beams = slice(offset[t], offset[t + 1])
        count = offset[t + 1] - offset[t]
        scan = points[beams], hit[beams]
        rest = np.array([0, count]), T[t : t + 1]
        if points.shape[1] == 3:
            filter_.add(*scan, *rest, pixel=PIXEL, time_bin=time_bin, tag=t // 3)
            continue
        margin = np.linspace(0.5, 3.0, count).astype(np.float32)
        filter_.add(*scan, margin, *rest, time_bin=time_bin, tag=t // 3)


@pytest.fixture(params=[2, 3])
def scans(request, a_room):
    dimension = request.param
    room = a_room(dimension, dimension, 0.1 if dimension == 2 else 0.4, 14, 60).beams
    bins = [0, 0, 1, 2, 5, 5, 4, 6, 90, 91, 92, 92, 93, 200]
    both = [make(kernels, dimension, room.resolution) for kernels in (_core, reference)]
    for one in both:
        add_scans(one, room, bins[: len(room.T_map_sensor)])
    return room, *both


def known(core):
    """{cell: P(standing)} of a kernel's filter; in 3D of the cells in which beams ended."""
    if isinstance(core, _core.SweepFilter3D):
        cells, p = core.known_cells()
        return dict(zip(map(tuple, cells.tolist()), p.tolist(), strict=True))
    return in_tile(*core.dense())


def in_tile(first, p):
    """{cell: P(standing)} of an array that begins at a cell."""
    at = np.argwhere(~np.isnan(p))
    cells = map(tuple, (at[:, ::-1] + first).tolist())
    return dict(zip(cells, p[tuple(at.T)].tolist(), strict=True))


def assert_same_standing(found, expected):
    values = np.array([[found[cell], expected[cell]] for cell in found.keys() & expected.keys()])
    np.testing.assert_allclose(values[:, 0], values[:, 1], atol=2e-3)
    return values[:, 1]


def test_agrees_with_the_twin(scans):
    room, core, plain = scans
    points, hit, offset, T = room.arguments
    assert core.size == plain.size > 50
    found, expected = known(core), plain.p_standing()
    both = found.keys() & expected.keys()  # some are passed by the threshold, up to rounding
    assert len(both) > 0.99 * len(found.keys() | expected.keys())
    assert assert_same_standing(found, expected).std() > 0.05
    labels = core.label(points, hit, offset, T, 0.9)
    np.testing.assert_allclose(labels, plain.label(points, hit, offset, T, 0.9), atol=2e-3)
    np.testing.assert_array_equal(np.isnan(labels), np.isnan(points).any(axis=1))


def test_changed_blocks_are_told_once(scans):
    room, core, _ = scans
    changed = core.changed_count
    parts = [core.take_changed_blocks(3) for _ in range(-(-changed // 3))]
    blocks, tiles = (np.concatenate(one) for one in zip(*parts, strict=True))
    assert len(blocks) == len(tiles) == changed > 3
    assert {tuple(b) for b in blocks.tolist()} == {tuple(b) for b in core.block_cells.tolist()}
    assert len(np.unique(blocks, axis=0)) == len(blocks)
    told = {}
    for first, tile in zip(blocks, tiles, strict=True):
        told |= in_tile(first, tile)
    assert told == known(core)
    assert len(core.take_changed_blocks(100)[0]) == core.changed_count == 0
    add_scans(core, room, [300])
    assert 0 < core.changed_count <= len(blocks)


def fan(distance, count=30):
    """A fan of beams from the origin that end at a distance."""
    angles = np.linspace(-0.3, 0.3, count)
    points = (distance * np.stack([np.cos(angles), np.sin(angles)], axis=1)).astype(np.float32)
    return points, np.ones(count, bool), np.array([0, count]), np.eye(3)[None]


def look(filter_, distance, time_bin):
    """Labels of a fan of beams that is added."""
    points, *rest = fan(distance)
    margin = np.full(len(points), 1.0, np.float32)
    filter_.add(points, rest[0], margin, *rest[1:], time_bin=time_bin, tag=0)
    return filter_.label(points, *rest, 0.9)


def test_what_appears_in_free_space_moves_and_the_wall_behind_does_not():
    core = make(_core, 2)
    for time_bin in range(8):
        assert look(core, 4.0, time_bin).min() > 0.8
    assert look(core, 2.0, 8).max() < 0.2
    assert look(core, 4.0, 9).min() > 0.9


def test_what_stood_for_long_and_has_left_is_soon_no_longer_shown():
    core = make(_core, 2)
    for time_bin in range(400):
        look(core, 2.0, time_bin)
    assert look(core, 2.0, 400).min() > 0.99
    for time_bin in range(401, 420):
        look(core, 4.0, time_bin)
    p = known(core)
    assert max(p.get((20 + i, j), 0.0) for i in (-1, 0, 1) for j in (-1, 0, 1)) < 0.1


def patch(distance):
    """A patch of a wall at a distance along x, seen from the origin."""
    y, z = np.meshgrid(np.linspace(-1.0, 1.0, 81), np.linspace(-1.0, 1.0, 81))
    points = np.stack([np.ones_like(y), y, z], axis=-1).reshape(-1, 3) * distance
    every = np.ones(len(points), bool)
    return points.astype(np.float32), every, np.array([0, len(points)]), np.eye(4)[None]


def sweep(filter_, distance, time_bin):
    """Labels of a sweep of a patch that is added."""
    filter_.add(*patch(distance), pixel=(0.03, 0.03), time_bin=time_bin, tag=0)
    return filter_.label(*patch(distance), 0.9)


def test_labels_and_sweeps_do_not_depend_on_the_threads():
    cores = [make(_core, 3, 0.02) for _ in range(2)]
    for time_bin in range(12):
        args, labels = patch(2.0 if time_bin == 4 else 4.0), []
        for core, threads in zip(cores, (1, 3), strict=True):
            kept = {"pixel": (0.03, 0.03), "time_bin": time_bin, "tag": 0}
            core.add(*args, **kept, threads=threads)
            labels.append(core.label(*args, 0.9, threads=threads))
        np.testing.assert_array_equal(*labels)
    assert known(cores[0]) == known(cores[1])
    assert np.concatenate(labels).size > 10_000


def test_a_sweep_moves_with_its_map():
    core = make(_core, 3)
    for time_bin in range(4):
        sweep(core, 4.0, time_bin)
    T = np.eye(4)
    T[:3, 3] = 1.0, -0.5, 0.2
    moved = move(core, T[None])
    assert moved.size == core.size
    back = np.linalg.inv(T)
    np.testing.assert_allclose(*(np.sort(list(known(f).values())) for f in (moved, core)), atol=0)
    again = move(moved, back[None])
    assert np.mean(sweep(again, 2.0, 4) < 0.2) > 0.95  # the views have moved along


def move(core, motion, step=1):
    """A filter that takes over another, `step` blocks at a time."""
    out, first = core.sibling(), 0
    while first < core.block_count:
        first = out.take_over(core, motion, first, step)
    return out


def test_moved_cells_take_their_evidence_along():
    core = make(_core, 2)
    for time_bin in range(10):
        look(core, 2.0, time_bin)
    T = np.eye(3)
    T[:2, 2] = 1.0, -0.5
    moved = move(core, T[None])
    shift = np.array([10, -5])
    expected = {tuple((np.array(c) + shift).tolist()): p for c, p in known(core).items()}
    assert known(moved) == pytest.approx(expected)
    assert moved.size == core.size


def test_maps_that_meet_have_the_last_views_of_both():
    earlier, later = make(_core, 3), make(_core, 3)
    for time_bin in range(40):
        sweep(earlier, 3.0, time_bin)
        sweep(later, 4.0, 40 + time_bin)
    both = earlier.sibling()
    for one in (earlier, later):
        both.take_over(one, np.eye(4)[None], 0, one.block_count)
    assert both.size == earlier.size + later.size
    for filter_ in (both, later):
        assert np.mean(sweep(filter_, 2.0, 80) < 0.2) > 0.95
    near = [{cell: p for cell, p in known(one).items() if cell[0] < 22} for one in (both, later)]
    assert len(near[0]) > 100
    assert near[0] == near[1]


def test_what_another_map_knows_counts_at_once():
    core = make(_core, 2)
    wall = np.array([[40, row] for row in range(-20, 20)])
    free = np.array([[column, row] for column in range(2, 38) for row in range(-20, 20)])
    core.prime(np.concatenate([wall, free]), np.arange(len(wall) + len(free)) < len(wall), 8.0)
    p = known(core)
    assert p[40, -20] > 0.95
    assert p[20, -20] == 0.0
    assert look(core, 2.0, 0).max() < 0.05  # in free space
    assert np.median(look(core, 4.05, 1)) > 0.99
    with pytest.raises(ValueError, match="occupied"):
        core.prime(wall, np.ones(1, bool), 8.0)


def test_sweeps_go_on_from_what_another_map_knows(a_room):
    room = a_room(3, 3, 0.4, 14, 60).beams
    points, hit, offset, T = room.arguments
    of_beams = np.repeat(T, np.diff(offset), axis=0)
    ends = np.einsum("nij,nj->ni", of_beams[:, :3, :3], points) + of_beams[:, :3, 3]
    usable = ends[hit & np.isfinite(ends).all(axis=1)]
    cells = np.unique(np.floor(usable / room.resolution).astype(np.int64), axis=0)
    both = [make(kernels, 3, room.resolution) for kernels in (_core, reference)]
    for one in both:
        one.prime(np.ascontiguousarray(cells[::2]), np.arange(len(cells[::2])) % 2 == 0, 8.0)
        add_scans(one, room, np.arange(len(T)))
    found, expected = known(both[0]), both[1].p_standing()
    assert found.keys() == expected.keys()
    assert_same_standing(found, expected)
