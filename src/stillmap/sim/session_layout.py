"""What stands where, session after session: furniture, parked cars, doors."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
import scipy  # its parts load when they are first used
from numpy.typing import NDArray

from stillmap.sim.dynamics import place_faces
from stillmap.sim.planner import Float, FreeSpace, compute_segment_distance
from stillmap.sim.scene import Door, Scene, Segment, Stay, Thing
from stillmap.sim.walls import box
from stillmap.sim.world_3d import trace_chains

_CHANGES = (4, 9)  # fewest and most objects that change between two sessions
_KINDS = ("moved", "gone", "appeared")  # alike often
_SHORT_MOVES = 0.4  # share of moves within the same room
_NEW = (4, 9)  # objects brought into a world beforehand
_DOOR_CHANGES = 0.25  # share of doors that are found at another angle
_CLOSED_DOORS = 0.3  # share of doors that are closed
_MIN_OPEN = 0.4  # of the full swing, of doors that are open
_MIN_TURN = math.radians(25.0)  # between two angles of a door that changed
_FREE_SLOTS = 0.3  # share of parking places that are free in the first session
_DOOR_ROOM = 0.1  # m around the sector that a door sweeps, without furniture
ObjectKind = Literal["furniture", "car", "door"]

_FURNITURE = (0.3, 2.7)  # m, shortest and longest side of outlines that can be moved
_CARS = ((3.9, 5.0), (1.6, 2.0))  # m, length and width of parked cars
_TRIES = 60  # random places of an object
_AGAINST_WALL = 0.6  # share of furniture that is put against a wall
_GAP = (0.04, 0.1)  # m between furniture and the wall it stands against
_MIN_GAP = 0.02  # m to everything else
_WAY = 0.37  # m, half of the width of a way for the robot
_AROUND = 0.9  # m around an object, within which it may take the room of the robot
_NEARBY = (0.5, 1.6)  # m, distance of a short move


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
    places: tuple[Place | None, ...]

    @property
    def is_changed(self) -> bool:
        """True if it differs between any two sessions."""
        return len(set(self.places)) > 1

    def thing(self, session: int) -> Thing | None:
        """The object as a part of the scene of a session."""
        place = self.places[session]
        return None if place is None else Thing(self.faces, (Stay(*place),))

    def to_dict(self, number: int) -> dict[str, Any]:
        """As JSON; `number`: its id."""
        return {
            "id": number,
            "kind": self.kind,
            "changed": self.is_changed,
            "faces": [list(face) for face in self.faces],
            "at": [None if place is None else list(place) for place in self.places],
        }

    def extent(self, session: int) -> tuple[float, float, float, float]:
        """x0, y0, x1, y1 in metres of the box around it, where it stands in a session."""
        thing = self.thing(session)
        if thing is None:
            raise ValueError("the object is absent")
        return compute_extent(place_faces(thing, thing.stays[0]))


def compute_extent(faces: Float) -> tuple[float, float, float, float]:
    """x0, y0, x1, y1 of the box around faces (K, 4)."""
    ends = faces.reshape(-1, 2)
    (x0, y0), (x1, y1) = ends.min(axis=0).tolist(), ends.max(axis=0).tolist()
    return x0, y0, x1, y1


def rectangle(length: float, width: float) -> tuple[Segment, ...]:
    """The faces of a box about its center."""
    return tuple(box(0.0, 0.0, length, width))


class MovableBox(NamedTuple):
    """A box of a world that can be moved: kind, place, length and width in metres."""

    kind: ObjectKind
    place: Place
    size: tuple[float, float]


def split_movable(walls: Sequence[Segment]) -> tuple[tuple[Segment, ...], list[MovableBox]]:
    """The walls that stay, and the boxes among them that can be moved: furniture, parked cars."""
    fixed: list[Segment] = []
    boxes: list[MovableBox] = []
    for chain, loop in trace_chains(walls):
        kind = None if loop is None or loop.sides != 4 else _kind_of(loop.length, loop.width)
        if loop is None or kind is None:
            fixed += chain
        else:
            place = Place(loop.x, loop.y, loop.heading)
            boxes.append(MovableBox(kind, place, (loop.length, loop.width)))
    return tuple(fixed), boxes


def _kind_of(length: float, width: float) -> ObjectKind | None:
    low, high = _FURNITURE
    if low <= width and length <= high:
        return "furniture"
    (short, long), (narrow, wide) = _CARS
    return "car" if short <= length <= long and narrow <= width <= wide else None


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
        self,
        size: tuple[float, float],
        standing: Float,
        rng: np.random.Generator,
        near: Place | None = None,
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
        rows, columns = np.nonzero(ways)
        nodes = space.origin + np.column_stack([columns, rows]) * space.spacing
        for _ in range(_TRIES):
            place = self._draw(size, nodes, rng, near)
            if place is None or not self._is_free(place, size, solid):
                continue
            if _is_in_sight(place, nodes, solid) and self._leaves_ways(place, size, space, ways):
                return place
        return None

    def _draw(
        self,
        size: tuple[float, float],
        nodes: Float,
        rng: np.random.Generator,
        near: Place | None,
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
        long = np.flatnonzero(self._lengths > size[0] + 0.1)
        away = np.array([float(compute_segment_distance(node, self._walls[k])) for k in long])
        if not len(long):
            return None
        wall = self._walls[long[away.argmin()]]
        along = (wall[2:] - wall[:2]) / np.hypot(*(wall[2:] - wall[:2]))
        normal = np.array([-along[1], along[0]])
        side = math.copysign(1.0, float((node - wall[:2]) @ normal))
        foot = wall[:2] + along * float((node - wall[:2]) @ along)
        x, y = foot + side * normal * (size[1] / 2 + rng.uniform(*_GAP))
        return Place(float(x), float(y), math.atan2(along[1], along[0]))

    def _is_free(self, place: Place, size: tuple[float, float], solid: Float) -> bool:
        """True if no surface (K, 4) is within the box at that place, nor in its frame."""
        reach = math.hypot(*size) / 2
        gap = np.hypot(self._keep_clear[:, 0] - place.x, self._keep_clear[:, 1] - place.y)
        if np.any(gap < self._keep_clear[:, 2] + reach):
            return False
        half = np.array(size) / 2 + _MIN_GAP
        c, s = math.cos(place.yaw), math.sin(place.yaw)
        turn = np.array([[c, -s], [s, c]])
        local = (solid.reshape(-1, 2, 2) - (place.x, place.y)) @ turn
        return not cross_rectangle(local[:, 0], local[:, 1], half).any()

    def _leaves_ways(
        self, place: Place, size: tuple[float, float], space: FreeSpace, ways: NDArray[np.bool_]
    ) -> bool:
        """True if the robot still gets everywhere but to the room of the box itself."""
        after = self._main_part(space.with_walls(np.array(box(place.x, place.y, *size, place.yaw))))
        rows, columns = np.nonzero(ways & ~after)
        lost = space.origin + np.column_stack([columns, rows]) * space.spacing
        far = np.hypot(lost[:, 0] - place.x, lost[:, 1] - place.y)
        return bool(np.all(far < math.hypot(*size) / 2 + _AROUND))

    def _main_part(self, space: FreeSpace) -> NDArray[np.bool_]:
        """(H, W) nodes of the largest part of free space through which the robot gets."""
        parts, count = scipy.ndimage.label(space.clearance >= _WAY, structure=np.ones((3, 3)))
        anchors = np.round((self._anchors - space.origin) / space.spacing).astype(int)
        at = parts[anchors[:, 1], anchors[:, 0]]
        if not np.any(at > 0):
            return np.zeros(parts.shape, bool)
        sizes = np.bincount(at[at > 0], minlength=count + 1)
        return np.asarray(parts == sizes.argmax())


def cross_rectangle(start: Float, end: Float, half: Float) -> NDArray[np.bool_]:
    """(K,) whether segments from (K, 2) to (K, 2) meet the rectangle -half to half."""
    along = end - start
    parallel = np.abs(along) < 1e-12
    step = np.where(parallel, 1.0, along)
    a, b = (-half - start) / step, (half - start) / step
    inside = np.abs(start) <= half
    first = np.where(parallel, np.where(inside, 0.0, np.inf), np.minimum(a, b)).max(axis=1)
    last = np.where(parallel, np.where(inside, 1.0, -np.inf), np.maximum(a, b)).min(axis=1)
    return np.asarray(np.maximum(first, 0.0) <= np.minimum(last, 1.0))


def _is_in_sight(place: Place, nodes: Float, solid: Float) -> bool:
    """True if no surface (K, 4) lies between a place and the nearest of the nodes (N, 2)."""
    at = np.array([place.x, place.y])
    nearest = nodes[np.hypot(*(nodes - at).T).argmin()]
    to = nearest - at
    long, angle = float(np.hypot(*to)), math.atan2(to[1], to[0])
    c, s = math.cos(angle), math.sin(angle)
    local = (solid.reshape(-1, 2, 2) - (at + nearest) / 2) @ np.array([[c, -s], [s, c]])
    line = np.array([long / 2, 1e-6])
    return not cross_rectangle(local[:, 0], local[:, 1], line).any()


class Layout:
    """Places of all things, session after session."""

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        self._rng, self._doors = rng, scene.leaves
        self.walls, boxes = split_movable(scene.walls)
        keep_clear = [(*door.hinge, door.width + _DOOR_ROOM) for door in scene.leaves]
        self._floor = Floor(scene, self.walls, np.reshape(keep_clear, (-1, 3)).astype(float))
        self._kinds: list[ObjectKind] = [movable.kind for movable in boxes]
        self._sizes = [movable.size for movable in boxes]
        self._history: list[list[Place | None]] = [[movable.place] for movable in boxes]
        self._slots = [movable.place for movable in boxes if movable.kind == "car"]
        self._angles = [[self._draw_angle(door)] for door in scene.leaves]
        self._park_first()
        for _ in range(int(rng.integers(_NEW[0], _NEW[1] + 1))) if not self._slots else ():
            self._bring()

    def objects(self) -> tuple[StandingObject, ...]:
        """All objects, doors last."""
        boxes = [
            StandingObject(kind, rectangle(*size), tuple(places))
            for kind, size, places in zip(self._kinds, self._sizes, self._history, strict=True)
        ]
        doors = [
            StandingObject(
                "door",
                ((0.0, 0.0, door.width, 0.0),),
                tuple(Place(*door.hinge, angle) for angle in angles),
            )
            for door, angles in zip(self._doors, self._angles, strict=True)
        ]
        return (*boxes, *doors)

    def go_on(self, has_changes: bool) -> None:
        """The next session: some objects are moved, taken and brought, some doors turned."""
        for places in self._history:
            places.append(places[-1])
        for angles in self._angles:
            angles.append(angles[-1])
        if not has_changes:
            return
        touched: set[int] = set()
        for _ in range(int(self._rng.integers(_CHANGES[0], _CHANGES[1] + 1))):
            kind = _KINDS[self._rng.integers(len(_KINDS))]
            if kind == "appeared":
                touched.add(self._bring())
                continue
            there = [k for k, p in enumerate(self._history) if p[-1] and k not in touched]
            if not there:
                continue
            number = there[self._rng.integers(len(there))]
            touched.add(number)
            self._history[number][-1] = self._move(number) if kind == "moved" else None
        for door, angles in zip(self._doors, self._angles, strict=True):
            if self._rng.random() < _DOOR_CHANGES:
                angles[-1] = self._draw_angle(door, angles[-1])

    def _bring(self) -> int:
        """Bring a new object; its number, or -1 where there is no room."""
        sessions = len(self._history[0]) if self._history else 1
        kind: ObjectKind = "car" if self._slots else "furniture"
        if kind == "car":
            size = tuple(self._rng.uniform((4.0, 1.7), (4.9, 1.9)).tolist())
            place = self._free_slot()
        else:
            size = tuple(sorted(self._rng.uniform((0.5, 0.3), (2.0, 0.9)).tolist(), reverse=True))
            place = self._floor.find_place(size, self._standing(), self._rng)
        if place is None:
            return -1
        self._kinds.append(kind)
        self._sizes.append((size[0], size[1]))
        self._history.append([None] * (sessions - 1) + [place])
        return len(self._kinds) - 1

    def _move(self, number: int) -> Place | None:
        """Another place of an object; its own where there is no other."""
        here, size = self._history[number][-1], self._sizes[number]
        if self._kinds[number] == "car":
            return self._free_slot() or here
        near = here if self._rng.random() < _SHORT_MOVES else None
        standing = self._standing(without=number)
        found = self._floor.find_place(size, standing, self._rng, near)
        return found or self._floor.find_place(size, standing, self._rng) or here

    def _park_first(self) -> None:
        """Some parking places are free in the first session."""
        for number, kind in enumerate(self._kinds):
            if kind == "car" and self._rng.random() < _FREE_SLOTS:
                self._history[number][0] = None

    def _free_slot(self) -> Place | None:
        taken = [p[-1] for p, kind in zip(self._history, self._kinds, strict=True) if kind == "car"]
        xy = np.array([(p.x, p.y) for p in taken if p is not None]).reshape(-1, 2)
        free = [s for s in self._slots if not np.any(np.hypot(*(xy - (s.x, s.y)).T) < 3.0)]
        if not free:
            return None
        x, y, yaw = free[self._rng.integers(len(free))]
        dx, dy, turn = self._rng.normal(0.0, (0.2, 0.08, 0.02)).tolist()
        c, s = math.cos(yaw), math.sin(yaw)
        return Place(x + c * dx - s * dy, y + s * dx + c * dy, yaw + turn)

    def _standing(self, without: int = -1) -> Float:
        """(K, 4) faces of everything that stands there now, open doors too."""
        faces = [np.empty((0, 4))]
        for number, (size, places) in enumerate(zip(self._sizes, self._history, strict=True)):
            place = places[-1]
            if place is not None and number != without:
                faces.append(_faces_at(rectangle(*size), place))
        leaves: list[Segment] = [
            door.leaf(angles[-1]) for door, angles in zip(self._doors, self._angles, strict=True)
        ]
        return np.concatenate([*faces, np.reshape(leaves, (-1, 4)).astype(float)])

    def _draw_angle(self, door: Door, other: float | None = None) -> float:
        """A direction of the leaf; `other`: not that."""
        while True:
            is_closed = self._rng.random() < _CLOSED_DOORS
            share = 0.0 if is_closed else float(self._rng.uniform(_MIN_OPEN, 1.0))
            angle = door.closed + share * (door.opened - door.closed)
            if other is None or abs(angle - other) > _MIN_TURN:
                return angle


def _faces_at(faces: tuple[Segment, ...], place: Place) -> Float:
    stay = Stay(*place)
    return place_faces(Thing(faces, (stay,)), stay)
