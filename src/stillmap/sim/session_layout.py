"""Layout of a world, session after session: furniture, parked cars, doors."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import scipy  # its parts load when they are first used

from stillmap.core.array_types import Bool, Float
from stillmap.core.segments import segments_meet_box
from stillmap.sim.dynamics import place_faces
from stillmap.sim.planner import SPACING, FreeSpace, compute_segment_distance
from stillmap.sim.scene import Door, Scene, Segment, Stay, Thing
from stillmap.sim.walls import box
from stillmap.sim.world_3d import trace_chains

_CHANGES = (4, 9)  # fewest and most objects that change between two sessions
_SHORT_MOVES = 0.4  # share of moves within the same room
_NEW = (4, 9)  # objects brought into a world beforehand
_DOOR_CHANGES = 0.25  # share of doors that are found at another angle
_CLOSED_DOORS = 0.3  # share of doors that are closed
_MIN_OPEN = 0.4  # of the full swing, of doors that are open
_MIN_TURN = math.radians(25.0)  # between two angles of a door that changed
_FREE_SLOTS = 0.3  # share of parking places that are free in the first session
_DOOR_ROOM = 0.1  # m around the sector that a door sweeps, without furniture
_FURNITURE = (0.3, 2.7)  # m, shortest and longest side of outlines that can be moved
_CARS = ((3.9, 5.0), (1.6, 2.0))  # m, length and width of parked cars
_TRIES = 60  # random places of an object
_AGAINST_WALL = 0.6  # share of furniture that is put against a wall
_GAP = (0.04, 0.1)  # m between furniture and the wall it stands against
_MIN_GAP = 0.02  # m to everything else
_WAY = 0.37  # m, half of the width of a way for the robot
_AROUND = 0.9  # m around an object, within which it may take the room of the robot
_NEARBY = (0.5, 1.6)  # m, distance of a short move

Size = tuple[float, float]  # m, length and width
ObjectKind = Literal["furniture", "car", "door"]


class Place(NamedTuple):
    """x, y in metres, of the center (of a door: the hinge), and heading in rad."""

    x: float
    y: float
    yaw: float


@dataclass(frozen=True)
class StandingObject:
    """An object with a constant place in each of S sessions.

    Attributes:
        kind: "furniture", "car" or "door".
        faces: segments in metres about its center; of a door: about its hinge.
        places: its place in each session; None: it is not there.
    """

    kind: ObjectKind
    faces: tuple[Segment, ...]
    places: list[Place | None]

    @classmethod
    def of_box(cls, kind: ObjectKind, size: Size, places: list[Place | None]) -> "StandingObject":
        """A box about its center."""
        return cls(kind, tuple(box(0.0, 0.0, *size)), places)

    @property
    def size(self) -> Size:
        """Length and width of a box."""
        x, y = self.faces[1][:2]
        return 2 * x, -2 * y

    @property
    def is_changed(self) -> bool:
        """True if it differs between any two sessions."""
        return len(set(self.places)) > 1

    def thing(self, session: int) -> Thing | None:
        """The object as a part of the scene of a session."""
        place = self.places[session]
        return None if place is None else Thing(self.faces, (Stay(*place),))

    def faces_in(self, session: int) -> Float:
        """(K, 4) its faces in the world in a session; none while it is absent."""
        thing = self.thing(session)
        return np.empty((0, 4)) if thing is None else place_faces(thing, thing.stays[0])


class Floor:
    """The free floor for furniture that leaves the robot a way everywhere.

    Args:
        scene: its walls, glass, mirrors and kerbs; doors are ignored.
        walls: (W, 4) fixed walls in place of the scene's, metres.
        keep_clear: (K, 3) discs x, y, radius without furniture, as where doors swing.
    """

    def __init__(self, scene: Scene, walls: Sequence[Segment], keep_clear: Float) -> None:
        self._solid = np.array([*walls, *scene.glass, *scene.mirrors, *scene.kerbs], float)
        self._walls = np.array([*walls, *scene.glass], float)
        self._lengths = np.hypot(*(self._walls[:, 2:] - self._walls[:, :2]).T)
        self._space = FreeSpace(self._solid)
        self._keep_clear = keep_clear
        self._anchors = np.array(scene.route, float)

    def find_place(
        self, size: Size, standing: Float, rng: np.random.Generator, near: Place | None = None
    ) -> Place | None:
        """A random place for a box of `size` metres; None: none was found.

        Args:
            size: length and width.
            standing: (K, 4) faces of the objects that stand there already.
            rng: generator.
            near: the place from where it is moved a little.
        """
        space, solid = self._space.with_walls(standing), np.concatenate([self._solid, standing])
        ways = self._main_part(space)
        if not ways.any():
            return None
        nodes = _points(space, ways)
        for _ in range(_TRIES):
            place = self._draw(size, nodes, rng, near)
            if place is None or not self._is_free(place, size, solid):
                continue
            if _is_in_sight(place, nodes, solid) and self._leaves_ways(place, size, space, ways):
                return place
        return None

    def _draw(
        self, size: Size, nodes: Float, rng: np.random.Generator, near: Place | None
    ) -> Place | None:
        if near is not None:
            far, angle = rng.uniform(*_NEARBY), rng.uniform(-math.pi, math.pi)
            turn = float(rng.choice([0.0, rng.uniform(-0.4, 0.4)]))
            x, y = near.x + far * math.cos(angle), near.y + far * math.sin(angle)
            return Place(float(x), float(y), near.yaw + turn)
        node = nodes[rng.integers(len(nodes))]
        if rng.random() >= _AGAINST_WALL:
            x, y = node.tolist()
            return Place(x, y, float(rng.uniform(-math.pi, math.pi)))
        long = self._walls[self._lengths > size[0] + 0.1]
        if not len(long):
            return None
        wall = min(long, key=lambda wall: float(compute_segment_distance(node, wall)))
        along = (wall[2:] - wall[:2]) / np.hypot(*(wall[2:] - wall[:2]))
        normal = np.array([-along[1], along[0]])
        side = math.copysign(1.0, float((node - wall[:2]) @ normal))
        foot = wall[:2] + along * float((node - wall[:2]) @ along)
        x, y = foot + side * normal * (size[1] / 2 + rng.uniform(*_GAP))
        return Place(float(x), float(y), math.atan2(along[1], along[0]))

    def _is_free(self, place: Place, size: Size, solid: Float) -> bool:
        """True if no surface (K, 4) is within the box at that place, and no disc to keep clear."""
        gap = np.hypot(*(self._keep_clear[:, :2] - place[:2]).T)
        if np.any(gap < self._keep_clear[:, 2] + math.hypot(*size) / 2):
            return False
        return not meets_box(solid, place, np.array(size) / 2 + _MIN_GAP)

    def _leaves_ways(self, place: Place, size: Size, space: FreeSpace, ways: Bool) -> bool:
        """True if the robot still gets everywhere but to the room of the box itself."""
        after = self._main_part(space.with_walls(np.array(box(place.x, place.y, *size, place.yaw))))
        far = np.hypot(*(_points(space, ways & ~after) - place[:2]).T)
        return bool(np.all(far < math.hypot(*size) / 2 + _AROUND))

    def _main_part(self, space: FreeSpace) -> Bool:
        """(H, W) nodes of the largest part of free space through which the robot gets."""
        parts, count = scipy.ndimage.label(space.clearance >= _WAY, structure=np.ones((3, 3)))
        anchors = np.round((self._anchors - space.origin) / SPACING).astype(int)
        at = parts[anchors[:, 1], anchors[:, 0]]
        if not np.any(at > 0):
            return np.zeros(parts.shape, bool)
        sizes = np.bincount(at[at > 0], minlength=count + 1)
        return np.asarray(parts == sizes.argmax())


def _points(space: FreeSpace, nodes: Bool) -> Float:
    """(K, 2) metres, of the nodes of a mask (H, W)."""
    rows, columns = np.nonzero(nodes)
    return np.asarray(space.origin + np.column_stack([columns, rows]) * SPACING)


def meets_box(solid: Float, place: Place, half: Float) -> bool:
    """True if a surface (K, 4) meets the box with half extents (2,) at a place."""
    c, s = math.cos(place.yaw), math.sin(place.yaw)
    local = (solid.reshape(-1, 2, 2) - place[:2]) @ np.array([[c, -s], [s, c]])
    return bool(segments_meet_box(local[:, 0], local[:, 1], half).any())


def _is_in_sight(place: Place, nodes: Float, solid: Float) -> bool:
    """True if no surface (K, 4) lies between a place and the nearest of the nodes (N, 2)."""
    at = np.array(place[:2])
    nearest = nodes[np.hypot(*(nodes - at).T).argmin()]
    (x, y), (dx, dy) = (at + nearest) / 2, nearest - at
    line = Place(float(x), float(y), math.atan2(dy, dx))
    return not meets_box(solid, line, np.array([float(np.hypot(dx, dy)) / 2, 1e-6]))


class Layout:
    """Places of all things, session after session.

    Attributes:
        walls: those that stay in place.
        objects: everything else, with its places up to now.
    """

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        self._rng, self._doors, self._sessions = rng, scene.leaves, 1
        self._boxes: list[StandingObject] = []
        fixed: list[Segment] = []
        for chain, loop in trace_chains(scene.walls):
            kind = None if loop is None or loop.sides != 4 else _kind_of(loop.length, loop.width)
            if loop is None or kind is None:
                fixed += chain
                continue
            size, place = (loop.length, loop.width), Place(*loop[:3])
            self._boxes.append(StandingObject.of_box(kind, size, [place]))
        self.walls = tuple(fixed)
        keep_clear = [(*door.hinge, door.width + _DOOR_ROOM) for door in scene.leaves]
        self._floor = Floor(scene, self.walls, np.reshape(keep_clear, (-1, 3)).astype(float))
        cars = [parked for parked in self._boxes if parked.kind == "car"]
        self._slots = [place for car in cars for place in car.places if place is not None]
        self._leaves = [
            StandingObject("door", ((0.0, 0.0, door.width, 0.0),), [self._draw_angle(door)])
            for door in scene.leaves
        ]
        for car in cars:
            if rng.random() < _FREE_SLOTS:
                car.places[0] = None
        for _ in range(int(rng.integers(_NEW[0], _NEW[1] + 1))) if not self._slots else ():
            self._bring()

    @property
    def objects(self) -> tuple[StandingObject, ...]:
        """Boxes, then doors."""
        return (*self._boxes, *self._leaves)

    def add_session(self) -> None:
        """The next session: some objects are moved, taken and brought, some doors turned."""
        self._sessions += 1
        for standing in self.objects:
            standing.places.append(standing.places[-1])
        self._change_boxes()
        for door, leaf in zip(self._doors, self._leaves, strict=True):
            if self._rng.random() < _DOOR_CHANGES:
                leaf.places[-1] = self._draw_angle(door, leaf.places[-1])

    def _change_boxes(self) -> None:
        untouched = list(self._boxes)
        for _ in range(int(self._rng.integers(_CHANGES[0], _CHANGES[1] + 1))):
            kind = ("moved", "gone", "appeared")[self._rng.integers(3)]
            if kind == "appeared":
                self._bring()
                continue
            there = [k for k, item in enumerate(untouched) if item.places[-1] is not None]
            if not there:
                continue
            item = untouched.pop(there[self._rng.integers(len(there))])
            item.places[-1] = self._move(item) if kind == "moved" else None

    def _bring(self) -> None:
        """Bring a new object in the last session, if there is room."""
        kind: ObjectKind = "car" if self._slots else "furniture"
        if kind == "car":
            length, width = self._rng.uniform((4.0, 1.7), (4.9, 1.9)).tolist()
            place = self._free_slot()
        else:
            width, length = sorted(self._rng.uniform((0.5, 0.3), (2.0, 0.9)).tolist())
            place = self._floor.find_place((length, width), self._standing(), self._rng)
        if place is not None:
            places = [*[None] * (self._sessions - 1), place]
            self._boxes.append(StandingObject.of_box(kind, (length, width), places))

    def _move(self, item: StandingObject) -> Place | None:
        """Another place of an object; its own where there is no other."""
        here = item.places[-1]
        if item.kind == "car":
            return self._free_slot() or here
        near = here if self._rng.random() < _SHORT_MOVES else None
        standing, rng = self._standing(without=item), self._rng
        place = self._floor.find_place(item.size, standing, rng, near)
        return place or self._floor.find_place(item.size, standing, rng) or here

    def _free_slot(self) -> Place | None:
        taken = [item.places[-1] for item in self._boxes if item.kind == "car"]
        xy = np.array([place[:2] for place in taken if place is not None]).reshape(-1, 2)
        free = [s for s in self._slots if not np.any(np.hypot(*(xy - s[:2]).T) < 3.0)]
        if not free:
            return None
        x, y, yaw = free[self._rng.integers(len(free))]
        dx, dy, turn = self._rng.normal(0.0, (0.2, 0.08, 0.02)).tolist()
        c, s = math.cos(yaw), math.sin(yaw)
        return Place(x + c * dx - s * dy, y + s * dx + c * dy, yaw + turn)

    def _standing(self, without: StandingObject | None = None) -> Float:
        """(K, 4) faces of everything that stands there now, open doors too."""
        faces = [item.faces_in(-1) for item in self.objects if item is not without]
        return np.concatenate([np.empty((0, 4)), *faces])

    def _draw_angle(self, door: Door, former: Place | None = None) -> Place:
        """A door with a direction of its leaf; `former`: not with that."""
        while True:
            is_closed = self._rng.random() < _CLOSED_DOORS
            share = 0.0 if is_closed else float(self._rng.uniform(_MIN_OPEN, 1.0))
            angle = door.closed + share * (door.opened - door.closed)
            if former is None or abs(angle - former.yaw) > _MIN_TURN:
                return Place(*door.hinge, angle)


def _kind_of(length: float, width: float) -> ObjectKind | None:
    low, high = _FURNITURE
    if low <= width and length <= high:
        return "furniture"
    (short, long), (narrow, wide) = _CARS
    return "car" if short <= length <= long and narrow <= width <= wide else None
