"""Everything in a scene that does not depend on the sensor: motion, stamps, odometry, truth."""

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np

from stillmap.core import se2
from stillmap.core.array_types import Bool, Float, Int32, Int64
from stillmap.core.source import SensorNotes, Source
from stillmap.sim.dynamics import Motion, Progress, simulate_motion
from stillmap.sim.options import OdometryOptions
from stillmap.sim.scene import Scene
from stillmap.sim.truth import Truth

_FIRST_STAMP_NS = 1_000_000_000 * 10**9
_SAME_POSE = 1e-12  # m and elements of rotations


@dataclass(frozen=True, eq=False)
class Episode:
    """Motion of robot and movers, and odometry.

    Attributes:
        scene: the world and all parameters.
        seed: of the generator; None where it is unknown.
        motion: poses of everything at each of T scans.
        walls: (W, 4) static segments: walls, glass, everything that never moved, and mirrors.
        T_odom_base: (T, 3, 3) odometry.
        sensor_rng: generator of a planar laser, or of the first 3D sensor.
        body_rng: generator of body heights, vibration, and a second 3D sensor.
        mishap_rng: generator of the mishaps of a planar laser.
        colour_seed: of the appearance; None without cameras.
    """

    scene: Scene
    seed: Any
    motion: Motion
    walls: Float
    T_odom_base: Float
    sensor_rng: np.random.Generator
    body_rng: np.random.Generator
    mishap_rng: np.random.Generator
    colour_seed: int | None = None

    @property
    def has_standing_things(self) -> bool:
        """True if a movable object stands still throughout."""
        return bool((self.motion.still_thing >= 0).any())

    @property
    def stamp_ns(self) -> Int64:
        """(T,) recorded stamps in ns, rounded."""
        o, exact = self.scene.robot, self.exact_ns
        tick = max(1, round(o.stamp_rounding * 1e9))
        return _FIRST_STAMP_NS + (exact - _FIRST_STAMP_NS + tick // 2) // tick * tick

    @property
    def exact_ns(self) -> Int64:
        """(T,) exact stamps in ns."""
        return _FIRST_STAMP_NS + np.round(self.motion.seconds * 1e9).astype(np.int64)

    def source(self, sensors: list[SensorNotes]) -> Source:
        """Metadata of a recording."""
        details = {"scene": self.scene.name, "seed": self.seed}
        return Source(format="simulation", sensors=sensors, details=details)

    def truth(
        self,
        static: Bool,
        mover: Int32,
        T_world_base: Float,
        more: dict[str, Any] | None = None,
        T_base_sensor: Float | None = None,
        thing: Int32 | None = None,
    ) -> Truth:
        """The truth about beams; `more` is added to the scene after `mover_kinds`."""
        motion, scene = self.motion, self._describe_scene()
        about = {**scene, "mover_kinds": motion.kinds, **(more or {})}
        if self.colour_seed is not None:
            about["colour_seed"] = self.colour_seed
        for name, scan in (("carried_at_scan", motion.carried), ("paused_at_scan", motion.paused)):
            about[name] = scan if scan < len(T_world_base) else None
        faces = motion.things.faces[-1]
        lasting = faces[np.any(faces[:, :2] != faces[:, 2:], axis=1)]
        arrays = (static, mover, T_world_base, self.walls, motion.poses)
        return Truth(*arrays, about, lasting, T_base_sensor, thing)

    def _describe_scene(self) -> dict[str, Any]:
        """Name, seed and all parameters of the scene as JSON; walls are written as an array."""
        parameters = dataclasses.asdict(self.scene)
        unused = ["walls", "kerbs"]
        unused += ["camera"] * (not self.scene.camera.enabled)
        unused += ["mirrors"] * (not self.scene.mirrors)
        unused += ["lidar", "rig", "ground", "heights", "pavements"] * (not self.scene.in_3d)
        for name in unused:
            del parameters[name]
        return {"name": parameters.pop("name"), "seed": self.seed, **parameters}


def simulate_episode(scene: Scene, rng: np.random.Generator, tell: Progress) -> Episode:
    """Simulate motion and odometry.

    Args:
        scene: the world and all parameters.
        rng: one generator is spawned from it per kind of mover.
        tell: called with the completed share.

    Raises:
        InputError: no room for the robot on its route or for the people, or the robot is held up.
    """
    seed = getattr(rng.bit_generator.seed_seq, "entropy", None)
    crowd_rng, sensor_rng, odometry_rng, door_rng, traffic_rng, *mishap_rngs = rng.spawn(7)
    motion = simulate_motion(scene, (crowd_rng, door_rng, traffic_rng, mishap_rngs[0]), tell)
    walls = np.array([*scene.walls, *scene.glass, *motion.still, *scene.mirrors], float)
    driven, carried = se2.matrix(*motion.robot.T), motion.carried
    if carried < len(driven):  # odometry knows nothing of the jump
        back = driven[carried - 1] @ se2.inverse(driven[carried])
        driven = np.concatenate([driven[:carried], back @ driven[carried:]])
    T_odom_base = simulate_odometry(driven, scene.odometry, odometry_rng)
    T_odom_base = add_faults(T_odom_base, motion.seconds, scene.odometry, mishap_rngs[1])
    T_odom_base = delay_odometry(T_odom_base, motion.seconds, scene.odometry.latency)
    body_rng, mishap_rng = rng.spawn(1)[0], mishap_rngs[1].spawn(1)[0]
    # spawned last, so that a camera changes nothing else
    seed_of_colours = int(rng.spawn(1)[0].integers(1 << 31)) if scene.camera.enabled else None
    rngs = (sensor_rng, body_rng, mishap_rng)
    return Episode(scene, seed, motion, walls, T_odom_base, *rngs, seed_of_colours)


def simulate_odometry(
    T_world_base: Float, options: OdometryOptions, rng: np.random.Generator
) -> Float:
    """(T, 3, 3) T_odom_base for true poses (T, 3, 3); the first one is the identity.

    Between two scans the left and right wheel roll d -+ b theta / 2. They are misread by their
    own relative errors, turned back into d and theta with a wrong base b, and noise is added
    whose variance grows with the distance and angle, independent of the scan rate (Thrun, Burgard,
    Fox, Probabilistic Robotics, 5.4, with random-walk scaling). A slipping wheel rolls farther than
    the robot moves, on short parts of the path. At last come the factors on distance and rotation.
    """
    x, y, turn = se2.parameters(se2.increments(T_world_base)).T
    # an arc as chord at half its angle
    along = x * np.cos(turn / 2) + y * np.sin(turn / 2)
    distance = along / np.maximum(np.sinc(turn / (2 * np.pi)), 1e-3)
    left, right = 1.0 + options.wheel_radius_error * rng.standard_normal(2)
    base = 1.0 + options.wheel_base_error * rng.standard_normal()
    roll_left = left * (distance - options.wheel_base * turn / 2)
    roll_right = right * (distance + options.wheel_base * turn / 2)
    d = (roll_left + roll_right) / 2
    theta = (roll_right - roll_left) / (options.wheel_base * base)
    way, turned = np.abs(distance), np.abs(turn)
    noise = rng.standard_normal((2, len(d)))
    d = d + noise[0] * options.translation_noise * np.sqrt(way)
    variance = options.rotation_noise**2 * turned + options.drift_noise**2 * way
    theta = theta + noise[1] * np.sqrt(variance)
    if options.slip_rate > 0:
        slipped = _slips(way, options, rng) * way
        d = d + slipped.sum(axis=0) / 2
        theta = theta + (slipped[1] - slipped[0]) / (options.wheel_base * base)
    d, theta = options.scale * d, options.rotation_gain * theta
    heading = np.concatenate([[0.0], np.cumsum(theta)])
    middle = heading[:-1] + theta / 2
    chord = d * np.sinc(theta / (2 * np.pi))
    position = np.zeros((len(heading), 2))
    position[1:] = np.cumsum(chord[:, None] * np.stack([np.cos(middle), np.sin(middle)], -1), 0)
    return se2.matrix(position[:, 0], position[:, 1], heading)


def add_faults(
    T_odom_base: Float, seconds: Float, options: OdometryOptions, rng: np.random.Generator
) -> Float:
    """Add stalls and resets to odometry (T, 3, 3).

    Motion during a stall is lost for good. At a reset the pose returns to the identity.

    Args:
        T_odom_base: odometry without faults.
        seconds: (T,) times of the scans.
        options: rates.
        rng: of the times.
    """
    if options.stall_rate > 0:
        moves = se2.parameters(se2.increments(T_odom_base))
        moves[_stalls(seconds, options, rng)] = 0.0
        T_odom_base = _chain(moves)
    count = min(options.resets, len(T_odom_base) - 1)
    for scan in np.sort(rng.choice(np.arange(1, len(seconds)), count, replace=False)).tolist():
        again = se2.inverse(T_odom_base[scan]) @ T_odom_base[scan:]
        T_odom_base = np.concatenate([T_odom_base[:scan], again])
    return T_odom_base


def delay_odometry(T_odom_base: Float, seconds: Float, latency: float) -> Float:
    """Odometry (T, 3, 3) that is recorded `latency` s late: at each stamp the pose of then.

    Between two scans the robot moves evenly on a chord; before the first one it stands. Over a
    reset nothing is interpolated: the pose is that before it.

    Args:
        T_odom_base: odometry at the scans.
        seconds: (T,) times of the scans, rising.
        latency: s.
    """
    if latency == 0 or len(seconds) < 2:
        return T_odom_base
    when = np.maximum(seconds - latency, seconds[0])
    before = np.clip(np.searchsorted(seconds, when, side="right") - 1, 0, len(seconds) - 2)
    share = (when - seconds[before]) / (seconds[before + 1] - seconds[before])
    moves = se2.parameters(se2.inverse(T_odom_base[before]) @ T_odom_base[before + 1])
    again = np.abs(T_odom_base[before + 1] - np.eye(3)).max(axis=(1, 2)) < _SAME_POSE
    share = np.where(again & (share < 1), 0.0, share)
    return np.asarray(T_odom_base[before] @ se2.matrix(*(share[:, None] * moves).T))


def _stalls(seconds: Float, o: OdometryOptions, rng: np.random.Generator) -> Bool:
    """(T - 1,) whether odometry misses the motion between two scans."""
    often = rng.poisson(o.stall_rate / 60 * (seconds[-1] - seconds[0]))
    stalls = np.zeros(len(seconds) - 1, bool)
    for begin in rng.uniform(seconds[0], seconds[-1], often).tolist():
        stalls |= (seconds[:-1] >= begin) & (seconds[:-1] < begin + o.stall_time)
    return stalls


def _chain(moves: Float) -> Float:
    """(T, 3, 3) poses from the identity on, for relative moves (T - 1, 3)."""
    heading = np.concatenate([[0.0], np.cumsum(moves[:, 2])])
    c, s = np.cos(heading[:-1]), np.sin(heading[:-1])
    x, y = moves[:, 0], moves[:, 1]
    steps = np.stack([c * x - s * y, s * x + c * y], axis=-1)
    position = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    return se2.matrix(position[:, 0], position[:, 1], heading)


def _slips(way: Float, options: OdometryOptions, rng: np.random.Generator) -> Float:
    """(2, T - 1) excess roll of each wheel, relative to the distance (T - 1,)."""
    extra = np.zeros((2, len(way)))
    ends = np.cumsum(way)
    for begin in np.flatnonzero(rng.random(len(way)) < options.slip_rate * way).tolist():
        last = np.searchsorted(ends, ends[begin] + options.slip_length)
        extra[rng.integers(2), begin:last] += options.slip * rng.uniform(0.5, 1.5)
    return extra
