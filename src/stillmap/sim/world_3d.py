"""3D worlds from plans: closed outlines become solids, other lines walls; movers get solids."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from stillmap.core.array_types import Float
from stillmap.sim import geometry
from stillmap.sim.dynamics import Moment, Motion
from stillmap.sim.episode import Episode
from stillmap.sim.options import HeightOptions, LidarOptions
from stillmap.sim.scene import Scene, Segment
from stillmap.sim.walls import polyline

_MAX_SIZE = 6.0  # m, of a loop that is not a room or a house
_MAX_SIDES = 16
_WALL_BOTTOM = -0.5  # m, so that no beam passes below walls


class Loop(NamedTuple):
    """A closed outline: x, y of its center, heading, length, width, number of sides."""

    x: float
    y: float
    heading: float
    length: float
    width: float
    sides: int


def make_static_world(scene: Scene, ground: geometry.Ground) -> geometry.StaticSurfaces:
    """Walls, lintels and kerbs as faces; columns, furniture, trees and parked cars as solids."""
    loops, lines = trace_loops((*scene.walls, *scene.mirrors))
    top = scene.heights.top
    lintels = [door.leaf(door.closed) for door in scene.leaves if scene.heights.doors < top]
    corners = [((x0, y0), (x1, y0), (x1, y1), (x0, y1)) for x0, y0, x1, y1 in scene.pavements]
    kerbs = [side for pavement in corners for side in polyline(pavement, closed=True)]
    z = [(_WALL_BOTTOM, top)] * (len(lines) + len(scene.glass))
    z += [(scene.heights.doors, top)] * len(lintels) + [(_WALL_BOTTOM, ground.kerb)] * len(kerbs)
    ends = [*lines, *scene.glass, *lintels, *kerbs]
    is_glass = np.zeros(len(ends), bool)
    is_glass[len(lines) : len(lines) + len(scene.glass)] = True
    segments = np.reshape(ends, (-1, 4)).astype(float)
    faces = geometry.Faces(segments, np.reshape(z, (-1, 2)), is_glass)
    parts = [(k, -1, p) for k, loop in enumerate(loops) for p in make_parts(loop, scene.heights)]
    poses = np.reshape([loop[:3] for loop in loops], (1, -1, 3)).astype(float)
    solids = geometry.assemble(parts).at(poses, ground.height(poses[..., 0], poses[..., 1]))
    return geometry.StaticSurfaces(faces, solids, ground, scene.heights.ceiling)


def make_parts(loop: Loop, heights: HeightOptions) -> list[geometry.Part]:
    """3D parts of a closed outline, about its center and heading."""
    if loop.sides == 4:
        return geometry.make_box(loop.length, loop.width, heights)
    return geometry.make_round_object(loop.length / 2, heights)


def trace_loops(walls: Sequence[Segment]) -> tuple[list[Loop], list[Segment]]:
    """The closed outlines of objects in a plan, and the remaining lines."""
    traced = trace_chains(walls)
    lines = [segment for chain, loop in traced if loop is None for segment in chain]
    return [loop for _, loop in traced if loop is not None], lines


def trace_chains(walls: Sequence[Segment]) -> list[tuple[list[Segment], Loop | None]]:
    """The chains of a plan in order, each with the outline that it closes, if it closes one.

    A chain: consecutive segments, up to where an outline closes.
    """
    chains: list[list[Segment]] = [[]]
    for segment in walls:
        last = chains[-1]
        if last and (_meet(last[0][:2], last[-1][2:]) or not _meet(last[-1][2:], segment[:2])):
            chains.append([])
        chains[-1].append(segment)
    return [(chain, _loop(chain)) for chain in chains if chain]


def _meet(a: Sequence[float], b: Sequence[float]) -> bool:
    return np.allclose(a, b, rtol=0.0, atol=1e-6)


def _loop(chain: list[Segment]) -> Loop | None:
    """The outline of an object; None: the chain is not closed, or is a room or a house."""
    starts, ends = np.array(chain)[:, :2], np.array(chain)[:, 2:]
    if not 4 <= len(chain) <= _MAX_SIDES or not np.allclose(starts[0], ends[-1], atol=1e-6):
        return None
    sides, middle = ends - starts, starts.mean(axis=0)
    length, width = np.hypot(*sides[0]), np.hypot(*sides[1])
    if len(chain) > 4:
        length = width = 2 * np.hypot(*(starts - middle).T).mean()
    elif abs(sides[0] @ sides[1]) > 1e-6 * max(length * width, 1e-9):
        return None
    if max(length, width) > _MAX_SIZE:
        return None
    along = sides[0] if length >= width else sides[1]
    heading = float(np.arctan2(along[1], along[0]))
    length, width = max(length, width), min(length, width)
    x, y = middle.tolist()
    return Loop(x, y, heading, float(length), float(width), len(chain))


_TALL = (1.7, 0.09)  # m, mean and standard deviation of the height of people
_MAX_TALL = 2.0  # m
STANDING = -10  # and below: in place of a mover's number, that of an object that never moves
_THIN = 0.02  # m, thickness of faces that are not closed outlines


class MoverSolids:
    """Solids of the people, doors, vehicles and movable objects of a scene.

    Those that never moved have no mover number: -1, or `STANDING` less the index of the movable
    object.

    Args:
        scene: the world.
        motion: poses at each scan.
        ground: the ground.
        rng: of the heights of people.

    Attributes:
        tall: (P,) metres, height of each mover.
    """

    def __init__(
        self, scene: Scene, motion: Motion, ground: geometry.Ground, rng: np.random.Generator
    ) -> None:
        self._motion, self._ground = motion, ground
        persons, Q = motion.kinds.count("person"), len(motion.people.mover)
        # poses of absent objects are NaN; headings of vehicles are unwrapped
        others = motion.poses[:, persons:].copy()
        solid = np.array([kind != "thing" for kind in motion.kinds[persons:]], bool)
        others[:, solid, 2] = np.unwrap(others[:, solid, 2], axis=0)
        self._others, self._is_thing = others, ~solid
        parts: list[tuple[int, int, geometry.Part]] = []
        self.tall = np.zeros(len(motion.kinds))
        tall = _TALL[0] + _TALL[1] * rng.standard_normal(persons)
        self.tall[:persons] = np.minimum(tall, _MAX_TALL)
        for q, person in enumerate(motion.people.mover.tolist()):
            half = tuple(motion.people.semi_axes[q].tolist())
            figure = geometry.make_leg if q < 2 * Q // 3 else geometry.make_torso_and_head
            parts += [(q, person, part) for part in figure(half, self.tall[person])]
        for number, kind in enumerate(motion.kinds[persons:], start=persons):
            mover = number if motion.moved[number] else -1
            if mover < 0 and kind == "thing":
                mover = STANDING - (number - motion.kinds.index("thing"))
            own = _parts_of(scene, motion, number, kind)
            parts += [(Q + number - persons, mover, part) for part in own]
            self.tall[number] = max(part.z[1] for part in own)
        self._assembly = geometry.assemble(parts)

    def at(self, moment: Moment, scan: int) -> geometry.Solids:
        """The solids at the n times of a moment within one scan."""
        people, others = self._motion.people, moment.interpolate(self._others)
        # movable objects jump from place to place
        others[:, self._is_thing] = self._others[scan, self._is_thing]
        xy, heading = moment.interpolate(people.xy), moment.interpolate(people.heading)
        walking = np.concatenate([xy, heading[..., None]], axis=-1)
        poses = np.concatenate([walking, others], axis=1)
        foot = self._ground.height(poses[..., 0], poses[..., 1])
        return self._assembly.at(poses, foot)


def _parts_of(scene: Scene, motion: Motion, number: int, kind: str) -> list[geometry.Part]:
    """The parts of a door, vehicle or movable object."""
    length, width = motion.sizes[number].tolist()
    if kind == "door":
        return geometry.make_door(length, min(scene.heights.doors, scene.heights.top))
    if kind != "thing":
        return geometry.make_vehicle(length, width, kind)
    loops, lines = trace_loops(scene.things[number - motion.kinds.index("thing")].faces)
    parts = [_place_part(part, loop) for loop in loops for part in make_parts(loop, scene.heights)]
    for x0, y0, x1, y1 in lines:
        long, turn = math.hypot(x1 - x0, y1 - y0), math.atan2(y1 - y0, x1 - x0)
        half, z = (long / 2, _THIN / 2), (0.0, scene.heights.furniture)
        parts.append(geometry.Part(geometry.BOX, (x0 + x1) / 2, (y0 + y1) / 2, half, z, turn))
    return parts


def _place_part(part: geometry.Part, loop: Loop) -> geometry.Part:
    """A part of a loop, relative to the center of the whole object."""
    c, s = math.cos(loop.heading), math.sin(loop.heading)
    ahead = loop.x + c * part.ahead - s * part.aside
    aside = loop.y + s * part.ahead + c * part.aside
    return part._replace(ahead=ahead, aside=aside, turn=loop.heading + part.turn)


class World(NamedTuple):
    """A simulated scene in 3D.

    Attributes:
        episode: the motion, in the plane.
        static: the static surfaces.
        movers: their solids.
        robot: (T, 6) x, y, z, roll, pitch, yaw.
    """

    episode: Episode
    static: geometry.StaticSurfaces
    movers: MoverSolids
    robot: Float

    @classmethod
    def of(cls, episode: Episode) -> "World":
        """The 3D world of an episode, with heights of people and vibration of the robot."""
        scene, rng = episode.scene, episode.body_rng
        slope = np.array((scene.ground.slope_x, scene.ground.slope_y))
        pavements = np.reshape(scene.pavements, (-1, 4)).astype(float)
        ground = geometry.Ground(slope, pavements, scene.ground.kerb)
        movers = MoverSolids(scene, episode.motion, ground, rng)
        robot = _shake(episode.motion.robot, ground, scene.lidar, rng)
        return cls(episode, make_static_world(scene, ground), movers, robot)

    def T_world_base(self, moment: Moment) -> Float:
        """(N, 4, 4) pose of the robot at the times of a moment."""
        x, y, z, *angles = moment.interpolate(self.robot).T
        return geometry.make_pose(np.stack([x, y, z], axis=-1), *angles)

    def collect_surfaces(self) -> tuple[geometry.StaticSurfaces, geometry.MovingSurfaces]:
        """The surfaces at the stamps of the scans; movers that never moved are static."""
        poses = []
        for scan in range(len(self.robot)):
            moment = Moment(self.episode.motion, np.array([scan]), np.zeros(1))
            solids = self.movers.at(moment, scan)
            poses.append(solids.pose[0])
        solids = solids._replace(pose=np.stack(poses))
        moves = solids.mover >= 0
        never = solids._replace(pose=solids.pose[:1]).select(~moves)
        static = self.static._replace(solids=self.static.solids.concatenate(never))
        return static, geometry.MovingSurfaces(self.episode.exact_ns, solids.select(moves))


def _shake(
    robot: Float, ground: geometry.Ground, o: LidarOptions, rng: np.random.Generator
) -> Float:
    """(T, 6) x, y, z, roll, pitch, yaw of a robot (T, 3) on the ground, with vibration."""
    x, y, yaw = robot.T
    gx, gy = ground.slope
    ahead, left = gx * np.cos(yaw) + gy * np.sin(yaw), gy * np.cos(yaw) - gx * np.sin(yaw)
    shaking = rng.standard_normal((3, len(robot)))
    shaking *= np.array([[o.vibration_roll], [o.vibration_pitch], [o.vibration_z]])
    pitch = -np.arctan(ahead) + shaking[1]
    roll = np.arctan(left * np.cos(np.arctan(ahead))) + shaking[0]
    return np.stack([x, y, ground.height(x, y) + shaking[2], roll, pitch, yaw], axis=-1)
