"""A robot that follows its route (pure pursuit) and waits for people in its way."""

import numpy as np

from stillmap.core.array_types import Float, Int64
from stillmap.sim.options import RobotOptions
from stillmap.sim.planner import FreeSpace, Planner
from stillmap.sim.scene import Light, Point
from stillmap.sim.vehicles import SpeedProfile

_SPACING = 0.05  # m between points of the route
_PATIENCE = 3.0  # s of waiting, after which it creeps on
_LOOK_AHEAD = 0.35  # m from the robot to the point of the route that it steers for
_LOOK_AHEAD_TIME = 0.5  # s, the same for a fast robot
_VIEW_DISTANCE = 1.5  # m ahead in which it gives way
_VIEW_TIME = 1.2  # s, the same for a fast robot
_CREEP_SPEED = 0.12  # m/s
_MIN_CARRY = 0.3  # of the distance to the farthest point of the route, when it is carried
_MIN_ROOM = 2.0  # m to people and vehicles where it is set down
_TURN_IN_PLACE = 0.4  # rad of heading error


class Robot:
    """Pose and progress of the robot.

    Attributes:
        pose: (3,) x, y in metres, theta in radians.
        impatient: it has waited long enough and creeps on.
        arrived: it is at the end of its way (never, if that is closed).
    """

    def __init__(
        self,
        way: Float,
        space: FreeSpace,
        options: RobotOptions,
        closed: bool,
        lights: tuple[Light, ...] = (),
    ) -> None:
        self._way, self._space, self._options, self._closed = way, space, options, closed
        self._pace = SpeedProfile(way, closed, options, lights)
        self._seconds, self._speed = 0.0, 0.0
        first = way[min(1, len(way) - 1)] - way[0]
        self.pose: Float = np.array([*way[0], np.arctan2(first[1], first[0])])
        self.is_impatient = False
        self.arrived = False
        self._at = 0
        self._waited = 0.0

    def step(self, dt: float, people: Float, contact: float) -> None:
        """Drive for dt seconds.

        Args:
            dt: seconds.
            people: (P, 2) positions of people and corners of vehicles, metres.
            contact: m, their minimum distance from the robot's center.
        """
        self._advance()
        o = self._options
        x, y, theta = self.pose
        to = self._way[self._ahead(self._look_ahead())[-1]] - self.pose[:2]
        error = np.arctan2(to[1], to[0]) - theta
        error = (error + np.pi) % (2 * np.pi) - np.pi
        turn = float(np.clip(2.0 * error, -o.turn_rate, o.turn_rate))
        past = (x - self._way[self._at, 0]) * np.cos(theta)
        past += (y - self._way[self._at, 1]) * np.sin(theta)
        speed = self._pace.limit_speed(self._at, float(past), self._speed, self._seconds, dt)
        share = 1.0 - abs(error) / _TURN_IN_PLACE
        if o.acceleration is not None:  # whoever brakes slowly turns in passing
            share = min(1.0, 1.0 + share)
        speed = self._pace.accelerate(speed * max(0.0, share), self._speed, dt)
        speed = self._give_way(dt, min(speed, np.hypot(*to) / dt), people, contact)
        middle = theta + turn * dt / 2
        new = np.array([x + speed * dt * np.cos(middle), y + speed * dt * np.sin(middle)])
        if not self._is_free(new, people, contact):
            new, speed = self.pose[:2], 0.0
        self._seconds, self._speed = self._seconds + dt, float(speed)
        self.pose = np.array([new[0], new[1], theta + turn * dt])

    def stand(self, dt: float) -> None:
        """Stand for dt seconds."""
        self._seconds, self._speed = self._seconds + dt, 0.0

    def put_down(self, rng: np.random.Generator, others: Float) -> None:
        """Set the robot down on a point of its route: a distant one with a random heading, or that
        which the options name, or the next one with room around it.

        Args:
            rng: generator.
            others: (N, 2) positions of people and corners of vehicles, metres.
        """
        for at in self._places_to_put_down(rng).tolist():
            near = np.hypot(*(others - self._way[at]).T).min(initial=np.inf)
            if near > _MIN_ROOM:
                self._at = at
                break
        heading = rng.uniform(-np.pi, np.pi)
        if self._options.carried_turn is not None:
            to = self._way[self._ahead(self._look_ahead())[-1]] - self._way[self._at]
            heading = np.arctan2(to[1], to[0]) + self._options.carried_turn
        self.pose = np.array([*self._way[self._at], heading])
        self._speed, self._waited = 0.0, 0.0

    def _places_to_put_down(self, rng: np.random.Generator) -> Int64:
        """Points of the route where the robot may be put down, in the order of preference."""
        by = self._options.carried_by
        if by is not None:
            ahead = self._at + round(by / _SPACING) + np.arange(len(self._way))
            on_route = (ahead >= 0) & (ahead < len(self._way))
            return ahead % len(self._way) if self._closed else ahead[on_route]
        away = np.hypot(*(self._way - self.pose[:2]).T)
        places = np.flatnonzero(away > _MIN_CARRY * away.max())
        if not self._closed:  # or the recording would soon be over
            places = places[places < (1.0 - _MIN_CARRY) * len(self._way)]
        return rng.permutation(places)

    def nominal_time(self) -> float:
        """Seconds of one lap at full speed."""
        return len(self._way) * _SPACING / self._options.speed

    def route_ahead(self, reach: float) -> Float:
        """(K, 2) the next `reach` metres of its route."""
        return np.asarray(self._way[self._ahead(round(reach / _SPACING))])

    def _ahead(self, count: int) -> Int64:
        ahead = np.arange(self._at, self._at + count + 1)
        last = len(self._way) - 1
        return ahead % len(self._way) if self._closed else np.minimum(ahead, last)

    def _fast(self) -> float:
        """m/s, the speed that determines how far it looks ahead."""
        return self._options.speed if self._options.acceleration is None else self._speed

    def _look_ahead(self) -> int:
        """Points of the route from the robot to the one that it steers for."""
        return round(max(_LOOK_AHEAD, _LOOK_AHEAD_TIME * self._fast()) / _SPACING)

    def _advance(self) -> None:
        ahead = self._ahead(2 * self._look_ahead())
        nearest = int(ahead[np.argmin(np.hypot(*(self._way[ahead] - self.pose[:2]).T))])
        self.arrived = not self._closed and nearest == len(self._way) - 1
        self._at = nearest

    def _give_way(self, dt: float, speed: float, people: Float, contact: float) -> float:
        """m/s, the speed limited by people ahead."""
        c, s = np.cos(self.pose[2]), np.sin(self.pose[2])
        dx, dy = (people - self.pose[:2]).T
        x, y = c * dx + s * dy, c * dy - s * dx
        sees = max(_VIEW_DISTANCE, contact + 0.1 + _VIEW_TIME * self._fast())
        ahead = (x > 0) & (x < sees) & (np.abs(y) < contact)
        gap = float(x[ahead].min(initial=np.inf)) - contact
        allowed = max(0.0, gap - 0.1)
        if speed > 0 and allowed < 0.1:
            self._waited += dt
        else:
            self._waited = max(0.0, self._waited - dt)
        self.is_impatient = self._waited > _PATIENCE
        return min(speed, max(allowed, _CREEP_SPEED if self.is_impatient else 0.0))

    def _is_free(self, xy: Float, people: Float, contact: float) -> bool:
        clear, _ = self._space.clearance_at(np.stack([xy, self.pose[:2]]))
        near = np.hypot(*(people - xy).T).min(initial=np.inf)
        # a robot that cut a corner may always return to where there is more room
        return bool(clear[0] >= min(self._options.radius, clear[1]) and near >= contact)


def plan_route(route: tuple[Point, ...], planner: Planner, closed: bool) -> Float:
    """(N, 2) points every few centimetres along the route, around walls; closed: a loop."""
    stops = [np.array(p, float) for p in route]
    if closed:
        stops.append(stops[0])
    corners = [stops[0]]
    for stop in stops[1:]:
        if planner.is_visible(corners[-1], stop[None])[0]:
            corners.append(stop)
        else:
            corners.extend(planner.path(corners[-1], planner.node(stop)))
    line = np.array(corners)
    lengths = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    along = np.linspace(0.0, lengths[-1], max(2, int(lengths[-1] / _SPACING) + 1))
    return np.stack([np.interp(along, lengths, line[:, k]) for k in (0, 1)], axis=-1)
