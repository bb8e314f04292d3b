"""Whether what was followed moved."""

import dataclasses

import numpy as np
import pytest
from made_up_street import Car, Part, street

from stillmap.models.alone import p_dynamic_at
from stillmap.models.frames import Way
from stillmap.models.movers import Shape, shape_of
from stillmap.models.options import MoverOptions
from stillmap.models.own import Moves
from stillmap.models.sources import Sources
from stillmap.models.wholes import followed_of
from stillmap.surface.mesh import Mesh

OPTIONS = MoverOptions()
STANDS = Car((8.0, 0.0), (0.0, 0.0), (0.6, 2.0, 1.5))


def _shape(sources: Sources, options: MoverOptions = OPTIONS) -> Shape | None:
    moves = Moves.of(sources)
    followed = followed_of(sources, moves, options)
    return shape_of(followed, sources, moves, options, [np.zeros(0)] * len(followed))


def _partly(sources: Sources, share: float) -> Sources:
    """The same, but what ended on the box in `share` of its width is static, and nobody's."""
    (one,) = sources.objects
    y = sources.seen.end_points(one.beams, sources.poses)[:, 1]
    static = one.beams[y < -1.0 + 2.0 * share]
    p_static = sources.p_static.copy()
    p_static[static] = 0.95
    rest = dataclasses.replace(one, beams=np.setdiff1d(one.beams, static))
    return dataclasses.replace(sources, p_static=p_static, objects=[rest])


def test_what_is_dynamic_all_over_has_a_model() -> None:
    assert _shape(street([STANDS], [Part(0)])) is not None


def test_a_part_of_what_stands_still_has_none() -> None:
    sources = _partly(street([STANDS], [Part(0)]), 0.9)
    assert _shape(sources) is None
    assert _shape(sources, MoverOptions(dynamic=0.05)) is not None


def test_static_things_farther_away_do_not_matter() -> None:
    beside = Car((8.0, 1.5), (0.0, 0.0), (0.6, 0.4, 1.5))
    sources = street([STANDS, beside], [Part(0)])
    every = np.arange(sources.seen.n_beams)
    met = np.abs(sources.seen.end_points(every, sources.poses)[:, 1] - 1.5) < 0.25
    p_static = np.where(met, np.float32(0.95), sources.p_static)
    sources = dataclasses.replace(sources, p_static=p_static)
    assert _shape(sources) is not None
    assert _shape(sources, MoverOptions(about=1.0, dynamic=0.9)) is None


@pytest.mark.parametrize("reach", [0.05, 0.2])
def test_the_mean_is_that_of_beams_near_the_surface_and_above_the_ground(reach: float) -> None:
    sources = street([STANDS], [Part(0)])
    (one,), (thing,) = sources.objects, sources.things
    rng = np.random.default_rng(3)
    p_static = rng.random(len(sources.p_static)).astype(np.float32)
    sources = dataclasses.replace(sources, p_static=p_static)
    way = Way.of_track(thing)
    T = way.T_map_object(0.0)
    x = ((sources.seen.end_points(one.beams[:1], sources.poses)[0] - T[:3, 3]) @ T[:3, :3])[0]
    corners = np.array([[x, -0.4, 0.0], [x, 0.4, 0.0], [x, 0.4, 0.9], [x, -0.4, 0.9]])
    mesh = Mesh(corners, np.array([[0, 2, 1], [0, 3, 2]], np.int32))
    found = p_dynamic_at(mesh, way, (0.0, 0.05), sources, reach)
    first = np.arange(sources.seen.offset[1])
    at = (sources.seen.end_points(first, sources.poses) - T[:3, 3]) @ T[:3, :3]
    off = np.abs(at) - np.array([np.inf, 0.4, 0.9])
    outside = np.linalg.norm(np.maximum(off[:, 1:], 0.0), axis=1)
    surely = (np.abs(at[:, 0] - x) < 0.01) & (at[:, 2] > 0.1)
    inner, outer = surely & (outside < 0.9 * reach - 0.01), surely & (outside < reach)
    means = [1.0 - p_static[first[some]].mean(dtype=np.float64) for some in (inner, outer)]
    assert min(means) - 0.02 <= found <= max(means) + 0.02
    assert inner.sum() > 20


def test_where_all_is_the_grounds_nothing_is_known() -> None:
    sources = street([STANDS], [Part(0)])
    flat = Mesh(np.array([[0.0, 0, 0], [0.5, 0, 0], [0, 0.5, 0.05]]), np.array([[0, 1, 2]], "i4"))
    way = Way.of_track(sources.things[0])
    assert np.isnan(p_dynamic_at(flat, way, (0.0, 0.05), sources, 0.04))
