"""Movable objects, placed by the clock, and doors, which open at random and for people."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.sim.laser import Float, Outlines
from stillmap.sim.options import DoorOptions
from stillmap.sim.scene import Door, Stay, Thing


class PlacedObjects(NamedTuple):
    """P movable objects at T scans.

    Attributes:
        poses: (T, P, 3) x, y in metres, yaw in rad; NaN where absent.
        outlines: faces of those that move; of length 0 while absent.
        still: (K, 4) faces of those that never move.
        still_thing: (K,) index of the object that each of these faces belongs to.
        moved: (P,) whether each ever moves.
    """

    poses: Float
    outlines: Outlines
    still: Float
    still_thing: NDArray[np.int32]
    moved: NDArray[np.bool_]


def faces_at_all_places(things: tuple[Thing, ...]) -> Float:
    """(K, 4) faces of all objects at all their places."""
    faces = [place_faces(thing, stay) for thing in things for stay in thing.stays]
    return np.concatenate([np.empty((0, 4)), *faces])


def place_objects(things: tuple[Thing, ...], seconds: Float, first: int) -> PlacedObjects:
    """Poses and faces of P movable objects at each scan.

    Args:
        things: the objects.
        seconds: (T,) since the beginning of the recording.
        first: mover number of the first object.
    """
    T, poses, still = len(seconds), [], [np.empty((0, 4))]
    moving, mover = [np.empty((T, 0, 4))], [np.empty(0, np.int32)]
    still_thing = [np.empty(0, np.int32)]
    moved: list[bool] = []
    for number, thing in enumerate(things, start=first):
        at = np.full((T, 3), np.nan)
        for stay in thing.stays:
            end = np.inf if stay.until is None else stay.until
            at[(seconds >= stay.since) & (seconds < end)] = (stay.x, stay.y, stay.yaw)
        faces = transform_faces(thing, at)
        poses.append(at)
        moved.append(not np.array_equal(at, np.broadcast_to(at[0], at.shape)))
        if not moved[-1]:
            still.append(faces[0])
            still_thing.append(np.full(len(thing.faces), number - first, np.int32))
        else:
            moving.append(faces)
            mover.append(np.full(len(thing.faces), number, np.int32))
    outlines = Outlines(np.concatenate(moving, axis=1), np.concatenate(mover))
    by_scan = np.reshape(poses, (-1, T, 3)).swapaxes(0, 1)
    return PlacedObjects(
        by_scan,
        outlines,
        np.concatenate(still),
        np.concatenate(still_thing),
        np.array(moved, bool),
    )


def place_faces(thing: Thing, stay: Stay) -> Float:
    """(K, 4) faces of an object in the world during a stay."""
    return np.asarray(transform_faces(thing, np.array([[stay.x, stay.y, stay.yaw]]))[0])


def transform_faces(thing: Thing, poses: Float) -> Float:
    """(T, K, 4) faces of an object at poses (T, 3); of length 0 where these are NaN."""
    T = se2.matrix(*poses.T)[:, None]
    ends = np.reshape(thing.faces, (-1, 2)).astype(float)
    moved = np.einsum("tkij,nj->tni", T[..., :2, :2], ends) + T[..., :2, 2]
    return np.asarray(np.nan_to_num(moved.reshape(len(poses), -1, 4)), np.float64)


DOOR_RANGE = 3.0  # m from the doorway, at which a person opens the door

_MIN_CLEARANCE = 1.2  # m from the doorway's center to people, for a leaf to close


class Doors:
    """State of D doors.

    Attributes:
        share: (D,) opening, from 0 to 1.
        width: (D,) metres.
    """

    def __init__(
        self, doors: tuple[Door, ...], options: DoorOptions, rng: np.random.Generator
    ) -> None:
        D = len(doors)
        self._options, self._rng = options, rng
        self._hinge = np.array([door.hinge for door in doors]).reshape(-1, 2)
        self.width = np.array([door.width for door in doors])
        self._closed = np.array([door.closed for door in doors])
        self._sweep = np.array([door.opened for door in doors]) - self._closed
        leaf = self.width[:, None] * _direction(self._closed)
        self._end, self._middle = self._hinge + leaf, self._hinge + leaf / 2
        self._opens = rng.random(D) < 0.5
        self.share = self._opens.astype(float)
        self._left = rng.random(D) * [self._draw_duration(opens) for opens in self._opens.tolist()]

    @property
    def angle(self) -> Float:
        """(D,) rad, direction from the hinge along the leaf."""
        return np.asarray(self._closed + self.share * self._sweep)

    def poses(self) -> Float:
        """(D, 3) center of each leaf in metres and its direction in radians."""
        middle = self._hinge + self.width[:, None] / 2 * _direction(self.angle)
        return np.column_stack([middle, self.angle])

    def faces(self) -> Float:
        """(D, 4) each leaf as a segment from its hinge."""
        end = self._hinge + self.width[:, None] * _direction(self.angle)
        return np.concatenate([self._hinge, end], axis=1)

    def step(self, dt: float, standing: Float, ways: Float) -> None:
        """Advance by dt seconds.

        Args:
            dt: seconds.
            standing: (N, 2) positions of people and robot, metres.
            ways: (K, 4) next segments of their paths, x0, y0, x1, y1.
        """
        delta = self._middle[:, None] - standing
        near = np.any(np.hypot(delta[..., 0], delta[..., 1]) < _MIN_CLEARANCE, axis=1)
        passing = self._crossed_by(ways)
        self._left -= dt
        for door in np.flatnonzero(passing & ~self._opens).tolist():
            self._turn(door, opens=True)
        for door in np.flatnonzero((self._left <= 0) & ~passing & ~near).tolist():
            self._turn(door, opens=not self._opens[door])
        step = dt / self._options.swing
        change = np.where(self._opens, step, np.where(near, 0.0, -step))
        self.share = np.clip(self.share + change, 0.0, 1.0)

    def _turn(self, door: int, opens: bool) -> None:
        self._opens[door] = opens
        self._left[door] = self._draw_duration(opens)

    def _draw_duration(self, opens: bool) -> float:
        o = self._options
        low, high = (o.min_open, o.max_open) if opens else (o.min_closed, o.max_closed)
        return float(np.exp(self._rng.uniform(np.log(low), np.log(high))))

    def _crossed_by(self, ways: Float) -> NDArray[np.bool_]:
        """(D,) whether a path segment (K, 4) crosses the doorway."""
        start, end = ways[:, None, :2], ways[:, None, 2:]
        aside = _side_of(self._hinge, self._end, start) * _side_of(self._hinge, self._end, end)
        through = _side_of(start, end, self._hinge) * _side_of(start, end, self._end)
        return np.asarray(np.any((aside < 0) & (through < 0), axis=0))


def split_into_segments(corners: Float) -> Float:
    """(N (K - 1), 4) segments of N paths with K corners (N, K, 2)."""
    return np.concatenate([corners[:, :-1], corners[:, 1:]], axis=-1).reshape(-1, 4)


def _direction(angle: Float) -> Float:
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _side_of(a: Float, b: Float, c: Float) -> Float:
    """Positive where c lies to the left of the line from a to b."""
    along, across = b - a, c - a
    return np.asarray(along[..., 0] * across[..., 1] - along[..., 1] * across[..., 0])
