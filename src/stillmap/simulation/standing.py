"""What stands in a world, in 3D: told from its plan, where everything is lines."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.simulation import shapes
from stillmap.simulation.ground import Ground
from stillmap.simulation.lidar_options import HeightOptions
from stillmap.simulation.scene import Scene, Segment
from stillmap.simulation.solids import Faces, Part, Solids, assembled

Float = NDArray[np.float64]

_LARGEST = 6.0  # m, a loop that is longer is a room or a house
_MOST_SIDES = 16
_BELOW = -0.5  # m, how deep walls go, so that no beam gets below them


class Loop(NamedTuple):
    """A closed outline: x, y of its middle, heading, length along and width across it, sides."""

    x: float
    y: float
    heading: float
    length: float
    width: float
    sides: int


def standing(scene: Scene, ground: Ground) -> tuple[Faces, Solids]:
    """Walls, lintels and kerbs as faces; columns, furniture, trees and parked cars as solids."""
    loops, lines = outlines(scene.walls)
    top = scene.heights.top
    lintels = [door.leaf(door.closed) for door in scene.leaves if scene.heights.doors < top]
    kerbs = [side for x0, y0, x1, y1 in scene.pavements for side in _sides(x0, y0, x1, y1)]
    z = [(_BELOW, top)] * (len(lines) + len(scene.glass))
    z += [(scene.heights.doors, top)] * len(lintels) + [(_BELOW, ground.kerb)] * len(kerbs)
    ends = [*lines, *scene.glass, *lintels, *kerbs]
    is_glass = np.zeros(len(ends), bool)
    is_glass[len(lines) : len(lines) + len(scene.glass)] = True
    faces = Faces(np.reshape(ends, (-1, 4)).astype(float), np.reshape(z, (-1, 2)), is_glass)
    parts = [(k, -1, p) for k, one in enumerate(loops) for p in parts_of(one, scene.heights)]
    poses = np.reshape([one[:3] for one in loops], (1, -1, 3)).astype(float)
    return faces, assembled(parts).at(poses, ground.height(poses[..., 0], poses[..., 1]))


def parts_of(loop: Loop, heights: HeightOptions) -> list[Part]:
    """What a closed outline is, in 3D, about its middle and heading."""
    if loop.sides == 4:
        return shapes.boxed(loop.length, loop.width, heights)
    return shapes.round_thing(loop.length / 2, heights)


def outlines(walls: Sequence[Segment]) -> tuple[list[Loop], list[Segment]]:
    """The closed outlines of things in a plan, and the lines that are left."""
    loops: list[Loop] = []
    lines: list[Segment] = []
    for chain in _chains(walls):
        loop = _loop(chain)
        if loop is None:
            lines += chain
        else:
            loops.append(loop)
    return loops, lines


def _chains(walls: Sequence[Segment]) -> Iterator[list[Segment]]:
    """Segments that follow one another, up to where an outline closes."""
    chain: list[Segment] = []
    for segment in walls:
        if chain and not np.allclose(chain[-1][2:], segment[:2], rtol=0.0, atol=1e-6):
            yield chain
            chain = []
        chain.append(segment)
        if np.allclose(chain[0][:2], segment[2:], rtol=0.0, atol=1e-6):
            yield chain
            chain = []
    if chain:
        yield chain


def _loop(chain: list[Segment]) -> Loop | None:
    """The outline of a thing; None: the chain is not closed, or it is a room or a house."""
    starts, ends = np.array(chain)[:, :2], np.array(chain)[:, 2:]
    if not 4 <= len(chain) <= _MOST_SIDES or not np.allclose(starts[0], ends[-1], atol=1e-6):
        return None
    sides, middle = ends - starts, starts.mean(axis=0)
    length, width = np.hypot(*sides[0]), np.hypot(*sides[1])
    if len(chain) > 4:
        length = width = 2 * np.hypot(*(starts - middle).T).mean()
    elif abs(sides[0] @ sides[1]) > 1e-6 * max(length * width, 1e-9):
        return None
    if max(length, width) > _LARGEST:
        return None
    along = sides[0] if length >= width else sides[1]
    heading = float(np.arctan2(along[1], along[0]))
    length, width = max(length, width), min(length, width)
    x, y = middle.tolist()
    return Loop(x, y, heading, float(length), float(width), len(chain))


def _sides(x0: float, y0: float, x1: float, y1: float) -> list[Segment]:
    return [(x0, y0, x1, y0), (x1, y0, x1, y1), (x1, y1, x0, y1), (x0, y1, x0, y0)]
