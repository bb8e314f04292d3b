"""Vehicles on lanes (car following, lights, queues), and the speed profile of the robot."""

import math

import numpy as np

from stillmap.core.array_types import Float, Int64
from stillmap.sim.options import RobotOptions, TrafficOptions
from stillmap.sim.scene import Lane, Light

_SPACING = 0.25  # m between points of a lane

_GAP = 2.0  # m between standing vehicles

_HEADWAY = 1.2  # s between moving ones

_ACCELERATION = 2.5  # m/s^2

_BRAKING = 8.0  # m/s^2

_SIDE_MARGIN = 0.6  # m between the robot and a vehicle that passes it

_RELEASE = 4.0  # m from the robot to the point that releases a queue

_MIN_STOP = 3.0  # s

_VAN_SHARE = 0.25  # of the cars

_STOP_DISTANCE = (20.0, 120.0)  # m between two stops


class Traffic:
    """State of V vehicles, lane by lane.

    Attributes:
        kinds: car or forklift.
        size: (V, 2) length and width, metres.
        speed: (V,) m/s.
    """

    def __init__(
        self, lanes: tuple[Lane, ...], options: TrafficOptions, rng: np.random.Generator
    ) -> None:
        self._seconds = 0.0
        self._lanes = [_Track(lane) for lane in lanes]
        self._options, self._rng = options, rng
        lane = np.array(_spread(lanes, options.vehicles), np.int64)
        self._on = [np.flatnonzero(lane == k) for k in range(len(lanes))]
        own, V = [lanes[k] for k in lane.tolist()], len(lane)
        self.kinds = [lane.kind for lane in own]
        self.size = _sizes(self.kinds, rng)
        self._wanted = rng.uniform(options.min_speed, options.max_speed, V)
        self._stops = rng.random(V) < options.stopping_share
        self._way_left = rng.uniform(*_STOP_DISTANCE, V)
        self._stop_left = np.zeros(V)
        self._waits = np.array([lane.waiting > 0 for lane in own], bool)
        self._at = self._first_places(rng.uniform(0.0, 0.5, V))
        self.speed = np.where(self._waits, 0.0, self._wanted)

    def poses(self) -> Float:
        """(V, 3) centers in metres and headings in radians."""
        poses = np.zeros((len(self._at), 3))
        for track, on in zip(self._lanes, self._on, strict=True):
            # both axles are on the path
            half = 0.3 * self.size[on, 0]
            rear, front = track.points(self._at[on] - half), track.points(self._at[on] + half)
            poses[on, :2] = (rear + front) / 2
            poses[on, 2] = np.arctan2(*(front - rear).T[::-1])
        return poses

    def faces(self) -> Float:
        """(4 V, 4) the sides of all vehicles, four each."""
        x, y, heading = self.poses().T[:, :, None]
        u = self.size[:, :1] / 2 * [1, -1, -1, 1]
        v = self.size[:, 1:] / 2 * [1, 1, -1, -1]
        c, s = np.cos(heading), np.sin(heading)
        corners = np.stack([x + c * u - s * v, y + s * u + c * v], axis=-1)
        return np.concatenate([corners, np.roll(corners, -1, axis=1)], axis=-1).reshape(-1, 4)

    def step(self, dt: float, robot: Float, radius: float) -> None:
        """Advance by dt seconds.

        Args:
            dt: seconds.
            robot: (2,) its position, metres.
            radius: m, of the robot.
        """
        self._release(robot)
        self._seconds += dt
        self._stop_left = np.maximum(self._stop_left - dt, 0.0)
        wanted = np.where(self._waits | (self._stop_left > 0), 0.0, self._wanted)
        gap = self._gaps(robot, radius)
        wanted = np.minimum(wanted, np.maximum(gap - _GAP, 0.0) / _HEADWAY)
        change = np.clip(wanted - self.speed, -_BRAKING * dt, _ACCELERATION * dt)
        # vehicles never touch, however late one brakes
        room = np.maximum(gap - 0.25 * _GAP, 0.0) / dt
        self.speed = np.minimum(np.maximum(self.speed + change, 0.0), room)
        self._at = self._at + self.speed * dt
        for track, on in zip(self._lanes, self._on, strict=True):
            self._at[on] %= track.length
        self._stop_now_and_then(self.speed * dt)

    def _first_places(self, jitter: Float) -> Float:
        places = np.zeros(len(jitter))
        for track, on in zip(self._lanes, self._on, strict=True):
            if track.lane.waiting:
                taken = np.cumsum(self.size[on, 0] + _GAP) - (self.size[on, 0] + _GAP) / 2
                places[on] = track.lane.stop - taken
            else:
                places[on] = (np.arange(len(on)) + jitter[on]) * track.length / max(len(on), 1)
        return places

    def _release(self, robot: Float) -> None:
        for track, on in zip(self._lanes, self._on, strict=True):
            if np.hypot(*(robot - track.lane.go)) < _RELEASE:
                self._waits[on] = False

    def _gaps(self, robot: Float, radius: float) -> Float:
        """(V,) metres to the next obstacle on the same lane."""
        gaps = np.full(len(self._at), np.inf)
        for track, vehicles in zip(self._lanes, self._on, strict=True):
            on = vehicles[np.argsort(self._at[vehicles], kind="stable")]
            if len(on) > 1:
                ahead = np.roll(on, -1)
                between = (self._at[ahead] - self._at[on]) % track.length
                gaps[on] = between - (self.size[on, 0] + self.size[ahead, 0]) / 2
            gaps[on] = np.minimum(gaps[on], self._to_red_light(track, on))
            width = self.size[on, 1].max(initial=0.0)
            if track.distance(robot) < radius + _SIDE_MARGIN + width / 2:
                between = (track.nearest(robot) - self._at[on]) % track.length
                gaps[on] = np.minimum(gaps[on], between - self.size[on, 0] / 2 - radius)
        return gaps

    def _to_red_light(self, track: "_Track", on: Int64) -> Float:
        """(N,) metres from vehicles `on` a lane to the next red light that they can stop at."""
        gaps = np.full(len(on), np.inf)
        for light, line in zip(track.lane.lights, track.lines, strict=True):
            if light.is_red(self._seconds):
                gap = (line - self._at[on]) % track.length - self.size[on, 0] / 2
                stops = gap > self.speed[on] ** 2 / (2 * _BRAKING)
                gaps = np.where(stops, np.minimum(gaps, gap), gaps)
        return gaps

    def _stop_now_and_then(self, way: Float) -> None:
        self._way_left -= way
        due = np.flatnonzero(self._stops & (self._way_left < 0))
        self._stop_left[due] = self._rng.uniform(_MIN_STOP, self._options.max_stop, len(due))
        self._way_left[due] = self._rng.uniform(*_STOP_DISTANCE, len(due))


class _Track:
    """A lane as dense points; past its end it begins again."""

    def __init__(self, lane: Lane) -> None:
        self.lane = lane
        corners = np.array(lane.path, float)
        along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))])
        self.length = float(along[-1])
        self._closed = lane.path[0] == lane.path[-1]
        self._along, self._corners = along, corners
        self._dense = np.arange(0.0, self.length, _SPACING)
        self._points = self.points(self._dense)
        self.lines = [self.nearest(np.array(light.at)) for light in lane.lights]

    def points(self, at: Float) -> Float:
        """(N, 2) the points at (N,) metres along the lane."""
        at = at % self.length if self._closed else np.clip(at, 0.0, self.length)
        return np.stack([np.interp(at, self._along, self._corners[:, k]) for k in (0, 1)], -1)

    def nearest(self, xy: Float) -> float:
        """Metres along the lane of the point nearest to (2,)."""
        return float(self._dense[np.argmin(np.hypot(*(self._points - xy).T))])

    def distance(self, xy: Float) -> float:
        """Metres from a point (2,) to the lane."""
        return float(np.hypot(*(self._points - xy).T).min())


def _spread(lanes: tuple[Lane, ...], vehicles: int) -> list[int]:
    """Lane of each vehicle: queues, and the others spread over the free lanes."""
    free = [k for k, lane in enumerate(lanes) if not lane.waiting]
    count = [lane.waiting for lane in lanes]
    for n in range(vehicles if free else 0):
        count[free[n % len(free)]] += 1
    return [k for k, n in enumerate(count) for _ in range(n)]


def _sizes(kinds: list[str], rng: np.random.Generator) -> Float:
    """(V, 2) length and width in metres."""
    vans = rng.random(len(kinds)) < _VAN_SHARE
    spread = 1.0 + rng.uniform(-0.06, 0.06, (len(kinds), 2))
    usual = [
        (2.4, 1.2) if kind == "forklift" else (5.6, 2.0) if van else (4.4, 1.8)
        for kind, van in zip(kinds, vans.tolist(), strict=True)
    ]
    return np.reshape(usual, (-1, 2)) * spread


_UNLIMITED = 1e3  # m/s^2

_MAX_OVERSHOOT = 0.5  # m past the stop line

_CURVE_SPAN = 1.0  # m before and after a point, over which its curvature is measured


class SpeedProfile:
    """Speed limits along a route from curves, lights and acceleration.

    Args:
        way: (N, 2) points in metres, evenly spaced.
        closed: whether the route is a loop.
        options: of the robot.
        lights: where it stops while they are red.
    """

    def __init__(
        self, way: Float, closed: bool, options: RobotOptions, lights: tuple[Light, ...]
    ) -> None:
        self._acceleration = options.acceleration or _UNLIMITED
        self._spacing = float(np.hypot(*(way[1] - way[0]))) if len(way) > 1 else 0.0
        self._closed, self._lights = closed, lights
        self._lines = [int(np.argmin(np.hypot(*(way - light.at).T))) for light in lights]
        self._allowed = self._limit_by_curves(way, options.speed)

    def accelerate(self, wanted: float, now: float, dt: float) -> float:
        """m/s, speed reached in dt seconds."""
        return min(wanted, now + self._acceleration * dt)

    def limit_speed(self, at: int, past: float, now: float, seconds: float, dt: float) -> float:
        """m/s, maximum speed of the next step.

        Args:
            at: index of the point of the route nearest to the robot.
            past: m from that point to the robot, along the route.
            now: m/s, current speed.
            seconds: since the beginning of the recording.
            dt: s, of the step.
        """
        a, points = self._acceleration, len(self._allowed)
        speed = float(self._allowed[at])
        for light, line in zip(self._lights, self._lines, strict=True):
            ahead = (line - at) % points if self._closed else line - at
            left = ahead * self._spacing - past
            # a robot past the line, or unable to stop, drives on
            if light.is_red(seconds) and left + _MAX_OVERSHOOT > now**2 / (2 * a):
                # the rest is driven in this step and while braking after it
                left = max(left, 0.0)
                speed = min(speed, math.sqrt((a * dt) ** 2 + 2 * a * left) - a * dt)
        return speed

    def _limit_by_curves(self, way: Float, fastest: float) -> Float:
        """(N,) m/s, limited by lateral acceleration, and by braking for later curves."""
        if len(way) < 3:
            return np.full(len(way), fastest)
        laps = np.concatenate([way, way[1:]]) if self._closed else way
        heading = np.unwrap(np.arctan2(*np.diff(laps, axis=0).T[::-1]))
        half = max(1, round(_CURVE_SPAN / self._spacing))
        ends = np.pad(heading, half, mode="edge")
        bend = np.abs(ends[2 * half :] - ends[: -2 * half]) / (2 * half * self._spacing)
        squares = np.minimum(fastest**2, self._acceleration / np.maximum(bend, 1e-9))
        squares = np.append(squares, squares[-1])
        gain = 2 * self._acceleration * self._spacing * np.arange(len(squares))
        squares = np.minimum.accumulate((squares + gain)[::-1])[::-1] - gain
        # rounding must not make a straight way slower
        is_free, limit = squares > fastest**2 * (1 - 1e-9), np.sqrt(np.maximum(squares, 0))
        return np.asarray(np.where(is_free, fastest, limit)[: len(way)])
