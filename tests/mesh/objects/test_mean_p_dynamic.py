"""Whether what was followed moved."""

import dataclasses

import numpy as np
import pytest
from made_up_street import Car, Part, street

from stillmap.mesh import reconstruction
from stillmap.mesh.inputs import MeshInputs
from stillmap.mesh.reconstruction import ObjectShape, reconstruct_object
from stillmap.mesh.returns import DynamicReturns, collect_tracks

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
