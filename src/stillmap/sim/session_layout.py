"""Layouts of a world, session after session: furniture, parked cars, doors."""

import math

import numpy as np

from stillmap.sim.furniture import (
    Floor,
    ObjectKind,
    Place,
    StandingObject,
    rectangle,
    split_movable,
)
from stillmap.sim.objects import place_faces
from stillmap.sim.planner import Float
from stillmap.sim.scene import Door, Scene, Segment, Stay, Thing

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


class Layout:
    """Places of all things, session after session."""

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        self._rng, self._doors = rng, scene.leaves
        self.walls, boxes = split_movable(scene.walls)
        keep_clear = [(*door.hinge, door.width + _DOOR_ROOM) for door in scene.leaves]
        self._floor = Floor(scene, self.walls, np.reshape(keep_clear, (-1, 3)).astype(float))
        self._kinds: list[ObjectKind] = [one.kind for one in boxes]
        self._sizes = [(one.length, one.width) for one in boxes]
        self._history: list[list[Place | None]] = [[one.place] for one in boxes]
        self._slots = [one.place for one in boxes if one.kind == "car"]
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
