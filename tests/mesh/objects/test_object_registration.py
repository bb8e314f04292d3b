"""Looks at one rigid thing, laid over each other."""

import numpy as np
import pytest
from made_up_street import Car, Part, by_several, street

from stillmap.mesh.inputs import MeshInputs
from stillmap.mesh.objects import reconstruction, registration
from stillmap.mesh.objects.merging import collect_tracks, merge_tracks
from stillmap.mesh.objects.reconstruction import ObjectShape, reconstruct_object, straighten_track
from stillmap.mesh.objects.registration import (
    PartialScan,
    PartialSurface,
    motion_transform,
    register_surfaces,
    surface_distance,
    triangulate_partial_scan,
)
from stillmap.mesh.objects.segmentation import DynamicReturns
from stillmap.mesh.objects.sweep_surface import ObjectBeams
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


def _seen(rng: np.random.Generator, wrong: np.ndarray) -> list[PartialSurface]:
    """Looks at it by a track that is wrong by a motion."""
    out = []
    for later in LATER:
        mesh, (R, t) = _corner(rng), motion_transform(wrong, later)
        out.append(
            PartialSurface.from_mesh(
                Mesh((mesh.vertices - t) @ R, mesh.faces), np.array([-8.0, 6.0, 1.0]), later
            )
        )
    return out


@pytest.mark.parametrize("seed", range(3))
def test_a_wrong_velocity_is_found(seed: int) -> None:
    rng = np.random.default_rng(seed)
    wrong = np.array([0.8, -0.3, 0.02, 0.06, 0.5, -0.4])
    sweeps = _seen(rng, wrong)
    motion = register_surfaces(sweeps, 2)
    np.testing.assert_allclose(motion[:2], wrong[:2], atol=0.06)
    assert motion[3] == pytest.approx(wrong[3], abs=0.02)
    moved = [one.transform(motion) for one in sweeps]
    before = [surface_distance(one, sweeps[2]) for one in sweeps]
    after = [surface_distance(one, moved[2]) for one in moved]
    assert max(before) > 0.1
    assert max(after) < 0.03
    assert after[2] == 0.0


@pytest.mark.parametrize("turn", [0.1, -0.1])
@pytest.mark.parametrize("wrong", [(-0.5, -0.6), (0.0, 0.6), (0.3, -1.0)])
def test_a_side_that_is_askew_is_not_moved_along_itself(
    wrong: tuple[float, float], turn: float
) -> None:
    rng = np.random.default_rng(0)
    askew, _ = motion_transform(np.array([0.0, 0.0, 0.0, turn, 0.0, 0.0]), 1.0)
    motion = np.array([*wrong, 0.0, 0.0, 0.0, 0.0])
    sweeps = []
    for later in LATER:
        mesh, (R, t) = _corner(rng, 25), motion_transform(motion, later)
        side = mesh.select(mesh.centers[:, 1] > 0.8)
        seen = Mesh((side.vertices @ askew.T - t) @ R, side.faces)
        sweeps.append(PartialSurface.from_mesh(seen, np.array([0.5, 4.0, 1.0]), later))
    np.testing.assert_allclose(register_surfaces(sweeps, 2)[:2], wrong, atol=0.03)


def test_where_nothing_tells_the_track_counts() -> None:
    sweeps = []
    for k, later in enumerate(LATER):
        mesh = _corner(np.random.default_rng(k))
        side = mesh.select(mesh.centers[:, 1] > 0.8)
        moved = side.vertices + np.array([0.0, 0.2 * later, 0.0])
        sweeps.append(
            PartialSurface.from_mesh(Mesh(moved, side.faces), np.array([0.0, 6.0, 1.0]), later)
        )
    motion = register_surfaces(sweeps, 2)
    assert abs(motion[0]) < 0.05
    assert motion[1] == pytest.approx(-0.2, abs=0.03)


def test_few_points_say_nothing() -> None:
    rng = np.random.default_rng(5)
    few = Mesh(rng.normal(size=(5, 3)), np.array([[0, 1, 2], [2, 3, 4]], np.int32))
    sweeps = [PartialSurface.from_mesh(few, np.zeros(3), later) for later in (-0.1, 0.0)]
    np.testing.assert_array_equal(register_surfaces(sweeps, 1), 0.0)
    assert np.isnan(surface_distance(sweeps[0], sweeps[1]))
    nothing = Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    assert np.isnan(
        surface_distance(sweeps[0], PartialSurface.from_mesh(nothing, np.zeros(3), 0.0))
    )


def test_a_patch_knows_how_far_away_its_planes_are() -> None:
    patch = _seen(np.random.default_rng(6), np.zeros(6))[2].to_patch()
    rear = np.flatnonzero(patch.points[:, 0] < -1.9)
    assert np.median(patch.standoff[rear]) == pytest.approx(6.0, abs=0.2)
    np.testing.assert_array_equal(patch.origin, np.tile([-8.0, 6.0, 1.0], (len(patch.points), 1)))


CAR = Car((7.0, -3.5), (5.0, 0.0))
WRONG = Part(0, drift=(0.6, 0.2))


def _shape(sources: MeshInputs) -> ObjectShape:
    moves = DynamicReturns.collect(sources)
    followed = collect_tracks(moves)
    (whole,) = merge_tracks(followed, moves)
    shape = reconstruct_object(whole, moves, [np.zeros(0)] * len(whole))
    assert shape is not None
    return shape


def _off(shape: ObjectShape) -> np.ndarray:
    """How far the vertices of a model lie off the two sides of the car that are seen."""
    T = shape.frame.T_map_object(shape.seconds)
    there = shape.mesh.vertices @ T[:3, :3].T + T[:3, 3]
    rear = CAR.start[0] + CAR.velocity[0] * shape.seconds - 0.5 * CAR.size[0]
    side = CAR.start[1] + 0.5 * CAR.size[1]
    return np.minimum(np.abs(there[:, 0] - rear), np.abs(there[:, 1] - side))


def test_several_looks_are_better_than_one(monkeypatch: pytest.MonkeyPatch) -> None:
    sources = street([CAR], [WRONG], scans=9, noise=0.03)
    shape = _shape(sources)
    monkeypatch.setattr(reconstruction, "MERGE_WINDOW", 0.0)
    alone = _shape(sources)
    assert not alone.rigid
    assert shape.rigid
    assert shape.span[1] - shape.span[0] >= 0.4
    assert shape.mesh.areas().sum() > 0.8 * alone.mesh.areas().sum()
    assert _off(shape).mean() < 0.8 * _off(alone).mean()
    # the way is the car's, not that of its track
    T = [shape.frame.T_map_object(shape.seconds + later)[:3, 3] for later in (0.0, 0.4)]
    np.testing.assert_allclose((T[1] - T[0])[:2] / 0.4, CAR.velocity, atol=0.25)


def test_looks_that_do_not_lie_over_each_other_leave_the_best_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sources = street([CAR], [WRONG], scans=9, noise=0.03)
    monkeypatch.setattr(reconstruction, "_MAX_VIEW_OFFSET", 0.001)
    shape = _shape(sources)
    assert not shape.rigid


def test_people_are_seen_at_once() -> None:
    person = Car((5.0, 0.0), (1.0, 0.3), (0.4, 0.5, 1.7))
    assert not _shape(street([person], [Part(0)])).rigid


def test_going_on_evenly() -> None:
    thing = street([CAR], [WRONG]).boxes[0]
    even = straighten_track(thing, 0.25, 0.5)
    at = np.array([0.0, 0.25, 0.7])
    np.testing.assert_allclose(even.box.center_at(at), thing.box.center_at(at), atol=1e-9)
    np.testing.assert_array_equal(even.box.heading[0], thing.box.heading[2])
    assert even.bottom.tolist() == [thing.bottom[2]] * 2


def test_the_side_of_a_car_is_bridged_where_people_are_not() -> None:
    """A side at a flat angle: beams lie 0.1 m apart across, and more than 0.6 m along."""
    turn, rise = (a.ravel() for a in np.meshgrid(np.arange(4) * 0.01, np.arange(-3, 4) * 0.01))
    looking = np.stack([np.ones(len(turn)), turn - 0.2, rise], axis=1)
    points = looking * (2.0 / (0.2 - turn))[:, None]  # the plane y = -2
    zero = np.zeros((len(points), 3))
    none = ObjectBeams(np.zeros((0, 3)), np.zeros((0, 3)))
    look = PartialScan(ObjectBeams(points, zero), none, (0.0, 0.0))
    assert len(triangulate_partial_scan(look, True, 3.0)) == 36
    assert len(triangulate_partial_scan(look, False, 3.0)) < 36
    assert len(triangulate_partial_scan(look, True, 0.3)) < 36


def test_looks_of_several_lidars_follow_one_another() -> None:
    # each sees one half of it, the second one earlier
    sources = by_several(street([Car((14.0, 0.0), (-6.0, 0.0))], [Part(0)], noise=0.01), 2)
    shape = _shape(sources)
    assert shape.rigid
    assert len(shape.frame.seconds) > 8
    assert (np.diff(shape.frame.seconds) >= 0.0).all()


@pytest.mark.parametrize(
    ("constants", "any_model"),
    [
        ({}, True),
        ({"_MIN_AREA": 0.0, "MIN_COMPONENT_AREA": 1000.0}, False),  # no surface
        ({"_MIN_AREA": 50.0}, False),
        ({"_MIN_HEIGHT": 0.8}, True),
        ({"_MIN_HEIGHT": 2.0}, False),  # a car is not so high
    ],
)
def test_without_enough_of_a_surface_there_is_no_model(
    constants: dict[str, float], any_model: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (reconstruction, registration):
        for name in constants.keys() & vars(module).keys():
            monkeypatch.setattr(module, name, constants[name])
    sources = street([Car((8.0, -2.0), (6.0, 0.0))], [Part(0)])
    moves = DynamicReturns.collect(sources)
    (whole,) = merge_tracks(collect_tracks(moves), moves)
    assert (reconstruct_object(whole, moves, [np.zeros(0)]) is not None) == any_model
