"""Whether what was followed moved."""

import dataclasses

import numpy as np
import pytest
from made_up_street import Car, Part, street

from stillmap.mesh import reconstruction
from stillmap.mesh.inputs import MeshInputs
from stillmap.mesh.merging import collect_tracks
from stillmap.mesh.reconstruction import ObjectShape, mean_p_dynamic, reconstruct_object
from stillmap.mesh.segmentation import DynamicReturns
from stillmap.mesh.tracked_boxes import ObjectFrame
from stillmap.mesh.triangle_mesh import Mesh

STANDS = Car((8.0, 0.0), (0.0, 0.0), (0.6, 2.0, 1.5))


def _shape(sources: MeshInputs) -> ObjectShape | None:
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
    assert _shape(street([STANDS], [Part(0)])) is not None


def test_a_part_of_what_stands_still_has_none(monkeypatch: pytest.MonkeyPatch) -> None:
    sources = _partly(street([STANDS], [Part(0)]), 0.9)
    assert _shape(sources) is None
    monkeypatch.setattr(reconstruction, "_MIN_P_DYNAMIC", 0.05)
    assert _shape(sources) is not None


def _face(height: float) -> tuple[MeshInputs, Mesh, ObjectFrame]:
    """The front of the box, up to a height, in its own frame."""
    sources = street([STANDS], [Part(0)])
    way = ObjectFrame.from_track(sources.boxes[0])
    x, y = -0.3, 0.4
    corners = np.array([[x, -y, 0.0], [x, y, 0.0], [x, y, height], [x, -y, height]])
    return sources, Mesh(corners, np.array([[0, 2, 1], [0, 3, 2]], np.int32)), way


def _set(sources: MeshInputs, which: np.ndarray, p: float) -> MeshInputs:
    p_static = np.where(which, np.float32(p), np.float32(0.0))
    return dataclasses.replace(sources, p_static=p_static)


def _local(sources: MeshInputs, way: ObjectFrame) -> np.ndarray:
    T = way.T_map_object(0.0)
    every = np.arange(sources.deskewed.n_beams)
    return np.asarray((sources.deskewed.end_points(every, sources.poses) - T[:3, 3]) @ T[:3, :3])


@pytest.mark.parametrize("reach", [0.05, 0.2])
def test_the_mean_is_that_of_beams_near_the_surface(reach: float) -> None:
    sources, mesh, way = _face(0.9)
    at = _local(sources, way)
    outside = np.maximum(np.abs(at[:, 1]) - 0.4, np.maximum(at[:, 2] - 0.9, 0.0))
    near = (np.abs(at[:, 0] + 0.3) < 0.01) & (outside < 0.8 * reach) & (at[:, 2] > 0.1)
    far = (np.abs(at[:, 0] + 0.3) > reach) | (outside > reach)
    assert near.sum() > 100
    span = (0.0, 0.05)
    assert mean_p_dynamic(mesh, way, span, _set(sources, far, 1.0), reach) == 1.0
    found = mean_p_dynamic(mesh, way, span, _set(sources, near, 0.25), reach)
    assert found == pytest.approx(0.75, abs=0.06)
    assert found > 0.7499


def test_the_ground_does_not_count() -> None:
    sources, mesh, way = _face(0.9)
    low = _local(sources, way)[:, 2] < 0.1
    assert (low & (np.abs(_local(sources, way)[:, 1]) < 0.4)).sum() > 10
    assert mean_p_dynamic(mesh, way, (0.0, 0.05), _set(sources, low, 1.0), 0.2) == 1.0
    _, flat, _ = _face(0.04)
    assert np.isnan(mean_p_dynamic(flat, way, (0.0, 0.05), sources, 0.05))
