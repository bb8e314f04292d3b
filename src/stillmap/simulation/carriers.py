"""Everything that moves, or might have, in 3D: solids carried along by the plan's poses."""

import math

import numpy as np
from numpy.typing import NDArray

from stillmap.simulation import shapes
from stillmap.simulation.ground import Ground
from stillmap.simulation.motion import Motion
from stillmap.simulation.scene import Scene
from stillmap.simulation.solids import BOX, Part, Solids, assembled
from stillmap.simulation.standing import Loop, outlines, parts_of
from stillmap.simulation.sweep import Moment

Float = NDArray[np.float64]

_TALL = (1.7, 0.09)  # m, mean and standard deviation of how tall people are
_TALLEST = 2.0  # m
_THIN = 0.02  # m, faces of things that are no closed outlines


class Carried:
    """People, doors, vehicles and things of a scene.

    Those that never moved have no mover's number: nobody could tell that they might have.

    Args:
        scene: the world.
        motion: where everything is at each scan.
        ground: what it stands on.
        rng: how tall people are.

    Attributes:
        tall: (P,) metres, how high each mover reaches above its foot.
    """

    def __init__(
        self, scene: Scene, motion: Motion, ground: Ground, rng: np.random.Generator
    ) -> None:
        self._motion, self._ground = motion, ground
        persons, Q = motion.kinds.count("person"), len(motion.people.mover)
        self._persons = persons
        # NaN of things is nowhere; headings of vehicles go round and round
        others = motion.poses[:, persons:].copy()
        solid = np.array([kind != "thing" for kind in motion.kinds[persons:]], bool)
        others[:, solid, 2] = np.unwrap(others[:, solid, 2], axis=0)
        self._others, self._is_thing = others, ~solid
        parts: list[tuple[int, int, Part]] = []
        self.tall = np.zeros(len(motion.kinds))
        self.tall[:persons] = np.minimum(
            _TALL[0] + _TALL[1] * rng.standard_normal(persons), _TALLEST
        )
        for q, person in enumerate(motion.people.mover.tolist()):
            half = tuple(motion.people.semi_axes[q].tolist())
            figure = shapes.leg if q < 2 * Q // 3 else shapes.torso_and_head
            parts += [(q, person, part) for part in figure(half, self.tall[person])]
        for number, kind in enumerate(motion.kinds[persons:], start=persons):
            mover = number if motion.moved[number] else -1
            own = _parts_of(scene, motion, number, kind)
            parts += [(Q + number - persons, mover, part) for part in own]
            self.tall[number] = max(part.z[1] for part in own)
        self._assembly = assembled(parts)

    def at(self, moment: Moment, scan: int) -> Solids:
        """Where they are at the n times of a moment within one scan."""
        people, others = self._motion.people, moment.at(self._others)
        # things do not fly from place to place
        others[:, self._is_thing] = self._others[scan, self._is_thing]
        walking = np.concatenate(
            [moment.at(people.xy), moment.at(people.heading)[..., None]], axis=-1
        )
        poses = np.concatenate([walking, others], axis=1)
        foot = self._ground.height(poses[..., 0], poses[..., 1])
        return self._assembly.at(poses, foot)


def _parts_of(scene: Scene, motion: Motion, number: int, kind: str) -> list[Part]:
    """The parts of a door, a vehicle or a thing."""
    length, width = motion.sizes[number].tolist()
    if kind == "door":
        return shapes.door(length, min(scene.heights.doors, scene.heights.top))
    if kind != "thing":
        return shapes.vehicle(length, width, kind)
    loops, lines = outlines(scene.things[number - motion.kinds.index("thing")].faces)
    parts = [_placed(part, loop) for loop in loops for part in parts_of(loop, scene.heights)]
    for x0, y0, x1, y1 in lines:
        long, turn = math.hypot(x1 - x0, y1 - y0), math.atan2(y1 - y0, x1 - x0)
        half, z = (long / 2, _THIN / 2), (0.0, scene.heights.furniture)
        parts.append(Part(BOX, (x0 + x1) / 2, (y0 + y1) / 2, half, z, turn))
    return parts


def _placed(part: Part, loop: Loop) -> Part:
    """A part about the middle of a loop, as one about the middle of the whole."""
    c, s = math.cos(loop.heading), math.sin(loop.heading)
    ahead = loop.x + c * part.ahead - s * part.aside
    aside = loop.y + s * part.ahead + c * part.aside
    return part._replace(ahead=ahead, aside=aside, turn=loop.heading + part.turn)
