"""The simulation itself: people and robot move, the laser looks, odometry drifts."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap import se2
from stillmap.recording.model import Recording
from stillmap.simulation import laser, lidar, odometry, sweep
from stillmap.simulation.motion import Motion, Progress, move
from stillmap.simulation.options import LaserOptions, RobotOptions
from stillmap.simulation.scene import Scene
from stillmap.simulation.sweep import Sweep
from stillmap.simulation.truth import Truth
from stillmap.simulation.turns import Turns, record

Float = NDArray[np.float64]

_FIRST_STAMP_NS = 1_000_000_000 * 10**9
_MOTION_SHARE = 0.7  # of the time that a simulation takes, for progress
_LIDAR_MOTION_SHARE = 0.05  # the same with a lidar


@dataclass(frozen=True, eq=False)
class Simulation:
    """A scene, what the robot recorded in it, and what really happened."""

    scene: Scene
    recording: Recording
    truth: Truth


def simulate(
    scene: Scene,
    rng: np.random.Generator | int = 0,
    progress: Progress | None = None,
    scratch: Path | None = None,
) -> Simulation:
    """Let a robot record a scene.

    People, laser, odometry, doors, vehicles and mishaps draw from generators of their own, spawned
    from `rng`: another laser or odometry leaves the way everybody goes unchanged.

    A door, vehicle or thing that does not move once while the robot records is a wall: no recording
    could tell it from one.

    Args:
        scene: the world and all parameters. With a lidar the recording and its truth are in 3D.
        rng: the generator, or a seed for one. The same seed gives the same recording to the bit.
        progress: called now and then with the share that is done, 0 to 1.
        scratch: folder for what a lidar records, where that is too large for memory; None: the
            system's temporary folder.

    Raises:
        InputError: no room for the robot on its route or for the people, or the robot is held up.
        OSError: the disk is full.
    """
    rng = np.random.default_rng(rng)
    seed = getattr(rng.bit_generator.seed_seq, "entropy", None)
    crowd_rng, laser_rng, odometry_rng, door_rng, traffic_rng, *mishap_rngs = rng.spawn(7)
    tell, share = progress or _silent, _LIDAR_MOTION_SHARE if scene.has_lidar else _MOTION_SHARE
    rngs = (crowd_rng, door_rng, traffic_rng, mishap_rngs[0])
    motion = move(scene, rngs, lambda done: tell(share * done))
    walls = np.array([*scene.walls, *scene.glass, *motion.still], float)
    T_world_base = se2.matrix(*motion.robot.T)
    driven = odometry.without_jump(T_world_base, motion.carried)
    T_odom_base = odometry.drifting(driven, scene.odometry, odometry_rng)
    T_odom_base = odometry.reported(T_odom_base, motion.seconds, scene.odometry, mishap_rngs[1])
    about = {**describe(scene, seed), "mover_kinds": motion.kinds}
    if scene.has_lidar:
        own_rngs = (laser_rng, rng.spawn(1)[0])
        turns = record(
            scene, motion, own_rngs, lambda done: tell(share + (1 - share) * done), scratch
        )
        recording = _recording(scene, motion, turns, T_odom_base, seed, scratch)
        static, mover, T_world_base = turns.static, turns.mover, turns.T_world_base
        about["mover_sizes"] = _sizes(motion, turns)
    else:
        recording, mover = _record(scene, walls, motion, T_odom_base, laser_rng, seed)
        static = recording.hit & (mover < 0)
    tell(1.0)
    for name, scan in (("carried_at_scan", motion.carried), ("paused_at_scan", motion.paused)):
        about[name] = scan if scan < len(T_world_base) else None
    faces = motion.things.faces[-1]
    lasting = faces[np.any(faces[:, :2] != faces[:, 2:], axis=1)]
    truth = Truth(static, mover, T_world_base, walls, motion.poses, about, lasting)
    return Simulation(scene, recording, truth)


def _recording(
    scene: Scene,
    motion: Motion,
    turns: Turns,
    T_odom_base: Float,
    seed: Any,
    scratch: Path | None,
) -> Recording:
    """The recording of a lidar; odometry knows of the plane only."""
    source = {"format": "simulation", "scene": scene.name, "seed": seed}
    return Recording(
        stamp_ns=_stamps(motion, scene.robot),
        offset=turns.offset,
        points=turns.points,
        hit=turns.hit,
        T_base_sensor=turns.T_base_sensor,
        sensor=np.zeros(len(motion.robot), np.int32),
        T_odom_base=lidar.planar(T_odom_base),
        source={**source, "sensors": [{"name": "simulated lidar"}]},
        beam_time=turns.beam_time,
        scratch=scratch,
    )


def _sizes(motion: Motion, turns: Turns) -> list[list[float | None]]:
    """Length, width and height of each mover in metres; None where they are not of one size."""
    rows = np.column_stack([motion.sizes, turns.tall]).tolist()
    return [[None if value != value else value for value in row] for row in rows]


def _record(
    scene: Scene,
    walls: Float,
    motion: Motion,
    T_odom_base: Float,
    rng: np.random.Generator,
    seed: Any,
) -> tuple[Recording, NDArray[np.int32]]:
    """The recording, and the mover (M,) that each of its beams met."""
    o, T = scene.laser, len(motion.robot)
    T_base_sensor, sensor = _sensors(o), np.arange(T, dtype=np.int32) % o.count
    exact = sweep.cast(motion, walls, T_base_sensor[sensor], o)
    is_glass = np.zeros(len(walls), bool)
    is_glass[len(scene.walls) : len(scene.walls) + len(scene.glass)] = True
    ranges, hit = laser.measure(exact, is_glass, o, rng)
    angles = laser.beam_angles(o.beams, o.fov)
    if o.upside_down == "known":
        angles = -angles
    points = ranges[..., None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    recording = Recording(
        stamp_ns=_stamps(motion, scene.robot),
        offset=np.arange(T + 1, dtype=np.int64) * o.beams,
        points=points.reshape(-1, 2).astype(np.float32),
        hit=hit.ravel(),
        T_base_sensor=T_base_sensor,
        sensor=sensor,
        T_odom_base=T_odom_base,
        source=_source(scene, seed, angles),
        beam_time=np.tile(Sweep.of(o).beam_times(o.beams), T) if o.sweep_time > 0 else None,
    )
    return recording, np.where(hit, exact.mover, np.int32(-1)).ravel()


def _sensors(o: LaserOptions) -> Float:
    """(S, 3, 3) T_base_sensor."""
    front = se2.matrix(o.x, o.y, o.yaw)
    return np.stack([front, se2.matrix(0.0, 0.0, np.pi) @ front][: o.count])


def _stamps(motion: Motion, o: RobotOptions) -> NDArray[np.int64]:
    """(T,) nanoseconds, as well as the recorder knows them."""
    if o.stamps_missing:
        return np.arange(len(motion.seconds), dtype=np.int64) * 10**9
    tick = max(1, round(o.stamp_rounding * 1e9))
    exact = np.round(motion.seconds * 1e9).astype(np.int64)
    return _FIRST_STAMP_NS + (exact + tick // 2) // tick * tick


def describe(scene: Scene, seed: Any) -> dict[str, Any]:
    """Name, seed and all parameters of a scene, JSON-able; its walls lie beside as an array."""
    parameters = dataclasses.asdict(scene)
    del parameters["walls"], parameters["kerbs"]
    for name in ("laser",) if scene.has_lidar else ("lidar", "ground", "heights", "pavements"):
        del parameters[name]
    return {"name": parameters.pop("name"), "seed": seed, **parameters}


def _silent(share: float) -> None:
    pass


def _source(scene: Scene, seed: Any, angles: Float) -> dict[str, Any]:
    sensors = [
        {
            "name": name,
            "beams_per_scan": len(angles),
            "start_angle": float(angles[0]),
            "angle_step": float(angles[1] - angles[0]),
        }
        for name in ("simulated laser", "simulated rear laser")[: scene.laser.count]
    ]
    return {"format": "simulation", "scene": scene.name, "seed": seed, "sensors": sensors}
