"""Everything in a scene that does not depend on the sensor: motion, stamps, odometry, truth."""

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.sim import odometry
from stillmap.sim.dynamics import Motion, Progress, simulate_motion
from stillmap.sim.scene import Scene
from stillmap.sim.truth import Truth

Float = NDArray[np.float64]

_FIRST_STAMP_NS = 1_000_000_000 * 10**9


@dataclass(frozen=True, eq=False)
class Episode:
    """Motion of robot and movers, and odometry.

    Attributes:
        scene: the world and all parameters.
        seed: of the generator; None where it is unknown.
        motion: poses of everything at each of T scans.
        walls: (W, 4) static segments: walls, glass, and everything that never moved.
        T_odom_base: (T, 3, 3) odometry.
        sensor_rng: generator of a planar laser, or of the first 3D sensor.
        body_rng: generator of body heights, vibration, and a second 3D sensor.
        colour_seed: of the appearance; None without cameras.
    """

    scene: Scene
    seed: Any
    motion: Motion
    walls: Float
    T_odom_base: Float
    sensor_rng: np.random.Generator
    body_rng: np.random.Generator
    colour_seed: int | None = None

    @property
    def stamp_ns(self) -> NDArray[np.int64]:
        """(T,) recorded stamps in ns, rounded."""
        o, exact = self.scene.robot, self.exact_ns
        tick = max(1, round(o.stamp_rounding * 1e9))
        return _FIRST_STAMP_NS + (exact - _FIRST_STAMP_NS + tick // 2) // tick * tick

    @property
    def exact_ns(self) -> NDArray[np.int64]:
        """(T,) exact stamps in ns."""
        return _FIRST_STAMP_NS + np.round(self.motion.seconds * 1e9).astype(np.int64)

    def source(self, sensors: list[dict[str, Any]]) -> dict[str, Any]:
        """Metadata of a recording."""
        name = self.scene.name
        return {"format": "simulation", "scene": name, "seed": self.seed, "sensors": sensors}

    def truth(
        self,
        static: NDArray[np.bool_],
        mover: NDArray[np.int32],
        T_world_base: Float,
        more: dict[str, Any] | None = None,
    ) -> Truth:
        """The truth about beams; `more` is added to the scene after `mover_kinds`."""
        motion = self.motion
        about = {
            **describe_scene(self.scene, self.seed),
            "mover_kinds": motion.kinds,
            **(more or {}),
        }
        if self.colour_seed is not None:
            about["colour_seed"] = self.colour_seed
        for name, scan in (("carried_at_scan", motion.carried), ("paused_at_scan", motion.paused)):
            about[name] = scan if scan < len(T_world_base) else None
        faces = motion.things.faces[-1]
        lasting = faces[np.any(faces[:, :2] != faces[:, 2:], axis=1)]
        return Truth(static, mover, T_world_base, self.walls, motion.poses, about, lasting)


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
    walls = np.array([*scene.walls, *scene.glass, *motion.still], float)
    driven = odometry.remove_jump(se2.matrix(*motion.robot.T), motion.carried)
    T_odom_base = odometry.simulate_odometry(driven, scene.odometry, odometry_rng)
    T_odom_base = odometry.add_faults(T_odom_base, motion.seconds, scene.odometry, mishap_rngs[1])
    body_rng = rng.spawn(1)[0]
    # spawned last, so that a camera changes nothing else
    seed_of_colours = int(rng.spawn(1)[0].integers(1 << 31)) if scene.camera.enabled else None
    return Episode(scene, seed, motion, walls, T_odom_base, sensor_rng, body_rng, seed_of_colours)


def describe_scene(scene: Scene, seed: Any) -> dict[str, Any]:
    """Name, seed and all parameters of a scene as JSON; walls are written as an array."""
    parameters = dataclasses.asdict(scene)
    del parameters["walls"], parameters["kerbs"]
    unused: tuple[str, ...]
    unused = () if scene.in_3d else ("lidar", "rig", "ground", "heights", "pavements")
    unused += () if scene.camera.enabled else ("camera",)
    for name in unused:
        del parameters[name]
    return {"name": parameters.pop("name"), "seed": seed, **parameters}
