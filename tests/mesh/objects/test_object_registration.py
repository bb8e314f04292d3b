"""Surfaces of what moves: one look, several laid over each other, and whether it moved."""

import dataclasses

import numpy as np
import pytest
from made_up_street import Car, Part, reconstruct_one, street

from stillmap.mesh import reconstruction
from stillmap.mesh.inputs import MeshInputs
from stillmap.mesh.partial_scans import (
    PartialScan,
    PartialSurface,
    motion_transform,
    register_surfaces,
    surface_distance,
    triangulate_partial_scan,
)
from stillmap.mesh.reconstruction import ObjectShape, reconstruct_object
from stillmap.mesh.returns import DynamicReturns, collect_tracks
from stillmap.mesh.triangle_mesh import Mesh

LATER = (-0.4, -0.2, 0.0, 0.2, 0.4)


def _corner(rng: np.random.Generator, n: int = 15) -> Mesh:
    """The rear and a side of a car, with noise, seen from behind to its left."""
    u, v = (a.ravel() for a in np.meshgrid(np.linspace(-1, 1, n), np.linspace(0, 1, n)))
    u, v = u + rng.uniform(-0.05, 0.05, n * n), v + rng.uniform(-0.05, 0.05, n * n)
    rear = np.stack([np.full(n * n, -2.0), -0.9 * u, 1.4 * v], axis=1)
    side = np.stack([2.0 * u, np.full(n * n, 0.9), 1.4 * v], axis=1)
    points = np.concatenate([rear, side])
    k = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    # each half counter-clockwise from outside
    one = np.concatenate([np.stack([k, k + 1, k + n], 1), np.stack([k + 1, k + n + 1, k + n], 1)])
    faces = np.concatenate([one, one[:, ::-1] + n * n])
    mesh = Mesh(points + rng.normal(0.0, 0.01, points.shape), faces.astype(np.int32))
    towards = np.array([-8.0, 6.0, 1.0]) - mesh.centers
    wrong = (mesh.normals() * towards).sum(axis=1) < 0.0
    return Mesh(mesh.vertices, np.where(wrong[:, None], mesh.faces[:, ::-1], mesh.faces))


def _looks(seed: int, wrong: np.ndarray, sensor: tuple[float, ...], side=False, turn=0.0, n=15):
    """Looks at it, or at its side alone, by a track that is wrong by a motion, or turned."""
    rng, out = np.random.default_rng(seed), []
    askew, _ = motion_transform(np.array([0.0, 0.0, 0.0, turn, 0.0, 0.0]), 1.0)
    for later in LATER:
        mesh, (R, t) = _corner(rng, n), motion_transform(wrong, later)
        mesh = mesh.select(mesh.centers[:, 1] > 0.8) if side else mesh
        seen = Mesh((mesh.vertices @ askew.T - t) @ R, mesh.faces)
        out.append(PartialSurface.from_mesh(seen, np.array(sensor), later))
    return out


@pytest.mark.parametrize("seed", range(3))
def test_a_wrong_velocity_is_found(seed: int) -> None:
    wrong = np.array([0.8, -0.3, 0.02, 0.06, 0.5, -0.4])
    sweeps = _looks(seed, wrong, (-8.0, 6.0, 1.0))
    motion = register_surfaces(sweeps, 2)
    np.testing.assert_allclose(motion[:2], wrong[:2], atol=0.06)
    assert motion[3] == pytest.approx(wrong[3], abs=0.02)
    moved = [one.transform(motion) for one in sweeps]
    assert max(surface_distance(one, sweeps[2]) for one in sweeps) > 0.1
    assert max(surface_distance(one, moved[2]) for one in moved) < 0.03


@pytest.mark.parametrize("turn", [0.1, -0.1])
@pytest.mark.parametrize("wrong", [(-0.5, -0.6), (0.0, 0.6), (0.3, -1.0)])
def test_a_side_that_is_askew_is_not_moved_along_itself(wrong, turn) -> None:
    motion = np.array([*wrong, 0.0, 0.0, 0.0, 0.0])
    sweeps = _looks(0, motion, (0.5, 4.0, 1.0), side=True, turn=turn, n=25)
    np.testing.assert_allclose(register_surfaces(sweeps, 2)[:2], wrong, atol=0.03)


def test_where_nothing_tells_the_track_counts() -> None:
    wrong = np.array([0.0, -0.2, 0.0, 0.0, 0.0, 0.0])
    motion = register_surfaces(_looks(0, wrong, (0.0, 6.0, 1.0), side=True), 2)
    assert abs(motion[0]) < 0.05
    assert motion[1] == pytest.approx(-0.2, abs=0.03)


CAR = Car((7.0, -3.5), (5.0, 0.0))
WRONG = Part(0, drift=(0.6, 0.2))


def _off(shape: ObjectShape) -> np.ndarray:
    """How far the vertices of a model lie off the two sides of the car that are seen."""
    T = shape.frame.T_map_object(shape.seconds)
    there = shape.mesh.vertices @ T[:3, :3].T + T[:3, 3]
    rear = CAR.start[0] + CAR.velocity[0] * shape.seconds - 0.5 * CAR.size[0]
    side = CAR.start[1] + 0.5 * CAR.size[1]
    return np.minimum(np.abs(there[:, 0] - rear), np.abs(there[:, 1] - side))


def test_several_looks_are_better_than_one(monkeypatch: pytest.MonkeyPatch) -> None:
    sources = street([CAR], [WRONG], scans=9, noise=0.03)
    shape = reconstruct_one(sources)
    monkeypatch.setattr(reconstruction, "MERGE_WINDOW", 0.0)
    alone = reconstruct_one(sources)
    assert not alone.rigid
    assert shape.rigid
    assert shape.span[1] - shape.span[0] >= 0.4
    assert shape.mesh.areas().sum() > 0.8 * alone.mesh.areas().sum()
    assert _off(shape).mean() < 0.8 * _off(alone).mean()
    # the way is the car's, not that of its track
    T = [shape.frame.T_map_object(shape.seconds + later)[:3, 3] for later in (0.0, 0.4)]
    np.testing.assert_allclose((T[1] - T[0])[:2] / 0.4, CAR.velocity, atol=0.25)


STANDS = Car((8.0, 0.0), (0.0, 0.0), (0.6, 2.0, 1.5))


def _model(sources: MeshInputs) -> ObjectShape | None:
    moves = DynamicReturns.collect(sources)
    followed = collect_tracks(moves)
    return reconstruct_object(followed, moves, [np.zeros(0)] * len(followed))


def _partly(sources: MeshInputs, share: float) -> MeshInputs:
    """The same, but what ended on the box in `share` of its width is static, and nobody's."""
    (one,) = sources.objects
    y = sources.deskewed.end_points(one.beams, sources.poses)[:, 1]
    static = one.beams[y < -1.0 + 2.0 * share]
    p_static = sources.p_static.copy()
    p_static[static] = 0.95
    rest = dataclasses.replace(one, beams=np.setdiff1d(one.beams, static))
    return dataclasses.replace(sources, p_static=p_static, objects=[rest])


def test_what_is_dynamic_all_over_has_a_model() -> None:
    assert _model(street([STANDS], [Part(0)])) is not None


def test_a_part_of_what_stands_still_has_none(monkeypatch: pytest.MonkeyPatch) -> None:
    sources = _partly(street([STANDS], [Part(0)]), 0.9)
    assert _model(sources) is None
    monkeypatch.setattr(reconstruction, "_MIN_P_DYNAMIC", 0.05)
    assert _model(sources) is not None


def _scan(hit_at: float = 3.0, step: float = 0.02, rows: int = 21) -> PartialScan:
    """A board 0.6 m wide and 1 m high before a wall at 6 m, seen from the origin."""
    angle = (np.arange(rows) - rows // 2) * step
    y, z = (a.ravel() for a in np.meshgrid(np.tan(angle), np.tan(angle)))
    looking = np.stack([np.ones(len(y)), y, z], axis=1)
    on = (np.abs(looking[:, 1] * hit_at) <= 0.3) & (np.abs(looking[:, 2] * hit_at) <= 0.5)
    points = looking * np.where(on, hit_at, 6.0)[:, None]
    return PartialScan(points, np.zeros_like(points), on, (0.0, 0.0))


def test_a_board_is_a_surface_that_faces_the_sensor() -> None:
    scan = _scan()
    mesh, board = triangulate_partial_scan(scan, False, 0.0), scan.points[scan.own]
    assert len(mesh.vertices) == len(board)
    np.testing.assert_allclose(mesh.vertices[:, 0], 3.0, atol=0.01)
    assert (mesh.normals()[:, 0] < -0.9).all()
    width, height = np.ptp(board[:, 1]), np.ptp(board[:, 2])
    assert mesh.areas().sum() == pytest.approx(width * height, rel=0.05)


def test_there_is_no_surface_where_beams_passed() -> None:
    scan = _scan()
    hole = scan.own & (np.linalg.norm(scan.points[:, 1:], axis=1) < 0.05)
    assert hole.sum() == 1
    points = np.where(hole[:, None], 2.0 * scan.points, scan.points)
    passed = triangulate_partial_scan(scan._replace(points=points, own=scan.own & ~hole), False, 0)
    known = PartialScan(*(part[~hole] for part in scan[:3]), scan.span)
    closed = triangulate_partial_scan(known, False, 0.0)
    assert np.linalg.norm(passed.centers[:, 1:], axis=1).min() > 0.05
    assert np.linalg.norm(closed.centers[:, 1:], axis=1).min() < 0.05


def test_steps_and_few_beams_are_no_surface() -> None:
    scan = _scan()
    far = scan.own & (scan.points[:, 1] > 0.0)
    step = scan._replace(points=np.where(far[:, None], scan.points * 1.5, scan.points))
    depth = triangulate_partial_scan(step, False, 0.0).corners[:, :, 0]
    assert len(depth)
    assert (np.ptp(depth, axis=1) < 0.5).all()
    few = np.flatnonzero(scan.own)[:3]
    straight = np.outer([1.0, 1.1, 1.2], [3.0, 0.0, 0.1])
    line = PartialScan(straight, np.zeros((3, 3)), np.ones(3, bool), (0.0, 0.0))
    two = PartialScan(scan.points[few[:2]], np.zeros((2, 3)), np.ones(2, bool), (0.0, 0.0))
    for scan in (line, two):
        assert len(triangulate_partial_scan(scan, False, 0.0)) == 0
