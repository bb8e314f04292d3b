"""People: a social-force crowd that walks between places, and the legs and bodies of each."""

from typing import Literal

import numpy as np

from stillmap.core.array_types import Float, Int64
from stillmap.core.errors import InputError
from stillmap.sim.options import CrowdOptions, Shape
from stillmap.sim.planner import FreeSpace, Planner

BODY_RADIUS = 0.26  # m, minimum distance from walls

_PLACES = 80  # goals that people walk to
_PERSONAL = 0.7  # m between two people passing
_REACTION = 0.4  # s, time constant of the velocity
_ARRIVED = 0.45  # m from a goal
_STUCK_AFTER = 4.0  # s without half a metre of progress
_MIN_START_DISTANCE = 1.5  # m from the robot to people at the start


class Crowd:
    """State of P people. Positions in metres, headings in radians, speeds in m/s.

    Attributes:
        xy: (P, 2) positions.
        heading: (P,) rad.
        speed: (P,) current speed.
    """

    def __init__(
        self,
        options: CrowdOptions,
        space: FreeSpace,
        planner: Planner,
        robot: Float,
        rng: np.random.Generator,
    ) -> None:
        P = options.people
        self._options, self._space, self._planner, self._rng = options, space, planner, rng
        places = rng.choice(planner.nodes, min(_PLACES, len(planner.nodes)), replace=False)
        self._places = [_goals_in_part(planner, places, k) for k in range(planner.parts)]
        self.xy = self._start(P, robot)
        self.heading = rng.uniform(-np.pi, np.pi, P)
        self._velocity = np.zeros((P, 2))
        self._wanted_speed = rng.uniform(options.min_speed, options.max_speed, P)
        # a fixed number, so that the share holds in small crowds
        self._stops = rng.permutation(P) < round(options.stopping_share * P)
        self._stop_left = np.zeros(P)
        self._routes: list[list[Float]] = [[] for _ in range(P)]
        self._target = self.xy.copy()
        self._last_seen, self._stuck_for = self.xy.copy(), np.zeros(P)
        for person in range(P):
            self._set_off(person)

    @property
    def speed(self) -> Float:
        return np.asarray(np.hypot(*self._velocity.T))

    def next_corners(self, reach: float) -> Float:
        """(P, 3, 2) positions and the next two corners of the paths, cut off at `reach` metres.

        Args:
            reach: metres along the path.
        """
        following = [r[0] if r else t for r, t in zip(self._routes, self._target, strict=True)]
        corners = np.stack([self.xy, self._target, np.reshape(following, (-1, 2))], axis=1)
        legs = np.diff(corners, axis=1)
        length = np.hypot(legs[..., 0], legs[..., 1])
        left = reach - np.cumsum(length, axis=1) + length
        share = np.clip(left / np.maximum(length, 1e-9), 0.0, 1.0)
        corners[:, 1:] = self.xy[:, None] + np.cumsum(legs * share[..., None], axis=1)
        return corners

    def step(self, dt: float, robot: Float, contact: float, robot_waits: bool) -> None:
        """Advance by dt seconds.

        Args:
            dt: seconds.
            robot: (3,) its pose x, y, theta.
            contact: m, minimum distance from people to the robot's center.
            robot_waits: the robot is impatient: people who stand in its way walk on.
        """
        if not len(self.xy):
            return
        from_robot = self.xy - robot[:2]
        distance = np.hypot(*from_robot.T)
        if robot_waits:
            self._stop_left[distance < contact + 1.0] = 0.0
        self._stop_left = np.maximum(self._stop_left - dt, 0.0)
        self._arrivals()
        self._accelerate(dt, robot, from_robot, distance, contact)
        self._move(dt, robot[:2], contact)
        self._turn(dt)
        self._reroute_stuck(dt)

    def _start(self, P: int, robot: Float) -> Float:
        nodes = self._planner.point(self._planner.nodes)
        nodes = nodes[np.hypot(*(nodes - robot).T) > _MIN_START_DISTANCE]
        taken = np.empty((P, 2))
        for person in range(P):
            if not len(nodes):
                raise InputError(f"no room for {P} people", hint="fewer people")
            taken[person] = nodes[self._rng.integers(len(nodes))]
            nodes = nodes[np.hypot(*(nodes - taken[person]).T) > _PERSONAL]
        return taken

    def _set_off(self, person: int) -> None:
        """Choose a goal; people who stop do so anywhere on the path."""
        part = int(self._planner.part_of(self._planner.node(self.xy[person])))
        path = self._planner.path(self.xy[person], int(self._rng.choice(self._places[part])))
        if self._stops[person]:
            path = _cut_path(self.xy[person], path, self._rng.uniform(0.2, 1.0))
        # people do not all walk on the same line
        shifted = path + self._rng.uniform(-0.5, 0.5, path.shape)
        clear, _ = self._space.clearance_at(shifted)
        path = np.where((clear > 2 * BODY_RADIUS)[:, None], shifted, path)
        self._routes[person] = list(path)
        self._target[person] = self._routes[person].pop(0)

    def _arrivals(self) -> None:
        near = np.hypot(*(self._target - self.xy).T) < _ARRIVED
        for person in np.flatnonzero(near & (self._stop_left <= 0)).tolist():
            if self._routes[person]:
                self._target[person] = self._routes[person].pop(0)
                continue
            if self._stops[person]:
                o = self._options
                self._stop_left[person] = self._rng.uniform(o.min_stop, o.max_stop)
            self._set_off(person)

    def _accelerate(
        self, dt: float, robot: Float, from_robot: Float, distance: Float, contact: float
    ) -> None:
        way = self._target - self.xy
        way /= np.maximum(np.hypot(*way.T), 1e-6)[:, None]
        stands = self._stop_left > 0
        wanted = way * (self._wanted_speed * ~stands)[:, None]
        clear, gradient = self._space.clearance_at(self.xy)
        walls = gradient * np.exp((BODY_RADIUS - clear) / 0.08)[:, None]
        push = self._repulsion_of_others(way) + walls
        # who stands gives way only at close distance
        push[stands & (np.hypot(*push.T) < 0.5)] = 0.0
        push += _repulsion_of_robot(robot, from_robot, distance, contact)
        self._velocity += (wanted + push - self._velocity) * min(dt / _REACTION, 1.0)
        limit = np.maximum(self._wanted_speed, 0.7)
        speed = np.hypot(*self._velocity.T)
        self._velocity *= np.minimum(1.0, limit / np.maximum(speed, 1e-9))[:, None]
        self._velocity[stands & (speed < 0.05)] = 0.0

    def _repulsion_of_others(self, way: Float) -> Float:
        delta = self.xy[:, None] - self.xy
        distance = np.hypot(delta[..., 0], delta[..., 1])
        np.fill_diagonal(distance, 9.0)
        strength = np.exp((_PERSONAL - distance) / 0.25) * (distance < 2.0)
        push = np.einsum("pq,pqd->pd", strength / np.maximum(distance, 0.05), delta)
        # two who meet head-on both step to the right
        facing = np.maximum(-np.einsum("pqd,pd->pq", delta, way), 0.0) / distance
        right = np.stack([way[:, 1], -way[:, 0]], axis=-1)
        push += right * (facing * strength).sum(axis=1)[:, None]
        return np.asarray(push)

    def _move(self, dt: float, robot: Float, contact: float) -> None:
        xy = self.xy + self._velocity * dt
        clear, gradient = self._space.clearance_at(xy)
        missing = np.maximum(1.02 * BODY_RADIUS - clear, 0.0)
        length = np.maximum(np.hypot(*gradient.T), 0.3)
        xy = xy + gradient * (missing / length)[:, None]
        delta = xy - robot
        distance = np.hypot(*delta.T)
        touching = distance < contact
        xy[touching] = robot + delta[touching] * (1.001 * contact / distance[touching])[:, None]
        clear, _ = self._space.clearance_at(xy)
        # the robot keeps its distance from everybody: staying is always possible
        blocked = clear < BODY_RADIUS
        xy[blocked] = self.xy[blocked]
        self._velocity = (xy - self.xy) / dt
        self.xy = xy

    def _turn(self, dt: float) -> None:
        walks = self.speed > 0.15
        direction = np.arctan2(self._velocity[:, 1], self._velocity[:, 0])
        turn = (direction - self.heading + np.pi) % (2 * np.pi) - np.pi
        self.heading = self.heading + np.where(walks, turn * min(dt / 0.3, 1.0), 0.0)

    def _reroute_stuck(self, dt: float) -> None:
        moved = np.hypot(*(self.xy - self._last_seen).T) > 0.5
        self._stuck_for += dt
        fresh = moved | (self._stop_left > 0)
        self._stuck_for[fresh] = 0.0
        self._last_seen[fresh] = self.xy[fresh]
        for person in np.flatnonzero(self._stuck_for > _STUCK_AFTER).tolist():
            self._stuck_for[person] = 0.0
            self._set_off(person)


def _goals_in_part(planner: Planner, places: Int64, part: int) -> Int64:
    """The goals in a part of free space; all its nodes where it has none."""
    inside = places[planner.part_of(places) == part]
    every = planner.nodes
    return inside if len(inside) else np.asarray(every[planner.part_of(every) == part])


def _repulsion_of_robot(robot: Float, from_robot: Float, distance: Float, contact: float) -> Float:
    """Repulsion from the robot, and sideways out of its path."""
    away = from_robot / np.maximum(distance, 1e-6)[:, None]
    push = away * np.exp((contact + 0.3 - distance) / 0.2)[:, None]
    ahead = np.array([np.cos(robot[2]), np.sin(robot[2])])
    left = np.array([-ahead[1], ahead[0]])
    x, y = from_robot @ ahead, from_robot @ left
    in_lane = (x > 0) & (x < contact + 1.2) & (np.abs(y) < contact + 0.1)
    push += left * (np.where(y >= 0, 0.7, -0.7) * in_lane)[:, None]
    return np.minimum(np.maximum(push, -2.0), 2.0)


def _cut_path(start: Float, path: Float, share: float) -> Float:
    """The corners of the first `share` of a path, cut between two of them."""
    corners = np.concatenate([start[None], path])
    lengths = np.hypot(*np.diff(corners, axis=0).T)
    ends = np.cumsum(lengths)
    k = int(np.searchsorted(ends, share * ends[-1]))
    k = min(k, len(path) - 1)
    within = (share * ends[-1] - (ends[k] - lengths[k])) / max(lengths[k], 1e-9)
    end = corners[k] + min(within, 1.0) * (corners[k + 1] - corners[k])
    return np.concatenate([path[:k], end[None]])


class Figures:
    """Legs and bodies of a crowd.

    In the stance half of the gait a foot is at rest on the floor, moving back relative to the body,
    while the other one swings forward.

    Attributes:
        semi_axes: (Q, 2) metres, along and across the heading; a person has one part or two.
        mover: (Q,) int32, person of each part: left legs, right legs, then bodies.
    """

    def __init__(
        self,
        people: int,
        shape: Shape | Literal["whole"],  # a lidar sees legs and body of everybody
        space: FreeSpace,
        rng: np.random.Generator,
    ) -> None:
        self._space = space
        has_legs = np.full(people, shape == "legs")
        if shape == "mixed":
            has_legs = rng.permutation(people) < people // 2
        self._phase = rng.uniform(0, 2 * np.pi, people)
        self._half_step = np.full(people, 0.2)
        legs, bodies = np.flatnonzero(has_legs), np.flatnonzero(~has_legs)
        if shape == "whole":
            legs = bodies = np.arange(people)
        radius = rng.uniform(0.05, 0.07, people)
        deep, wide = rng.uniform(0.12, 0.17, people), rng.uniform(0.2, 0.25, people)
        self._apart = rng.uniform(0.08, 0.12, people)
        self.mover = np.concatenate([legs, legs, bodies]).astype(np.int32)
        leg_axes = np.stack([radius, radius], axis=-1)[legs]
        body_axes = np.stack([deep, wide], axis=-1)[bodies]
        self.semi_axes = np.concatenate([leg_axes, leg_axes, body_axes])
        self._side = np.repeat([1.0, -1.0, 0.0], [len(legs), len(legs), len(bodies)])

    def step(self, dt: float, crowd: Crowd, robot: Float, radius: float) -> None:
        """Advance the gait by dt seconds; steps are short near walls and the robot.

        Args:
            dt: seconds.
            crowd: positions and speeds.
            robot: (2,) the robot's position, metres.
            radius: m, of the robot.
        """
        clear, _ = self._space.clearance_at(crowd.xy)
        from_robot = np.hypot(*(crowd.xy - robot).T) - radius
        reach = np.maximum(np.minimum(clear, from_robot) - 0.07, 0.0)
        room = np.sqrt(np.maximum(reach**2 - self._apart**2, 0.0))
        self._half_step = np.minimum(0.18 + 0.1 * crowd.speed, room)
        self._phase += np.pi * crowd.speed * dt / (2 * np.maximum(self._half_step, 0.1))

    def parts(self, crowd: Crowd) -> tuple[Float, Float]:
        """Centers (Q, 2) and headings (Q,) of all parts."""
        heading = crowd.heading[self.mover]
        phase = self._phase[self.mover] + np.where(self._side < 0, np.pi, 0.0)
        # 1 to -1 in the stance half, back in the swing half
        swing = 2 * np.abs(phase / np.pi % 2 - 1) - 1
        ahead = np.abs(self._side) * self._half_step[self.mover] * swing
        aside = self._side * self._apart[self.mover]
        c, s = np.cos(heading), np.sin(heading)
        offset = np.stack([c * ahead - s * aside, s * ahead + c * aside], axis=-1)
        return crowd.xy[self.mover] + offset, heading
