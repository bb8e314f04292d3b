"""What happens in a scene, whichever sensor looks on, and what is known of it afterwards."""

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
    """Everybody's motion, and what the robot's wheels say.

    Attributes:
        scene: the world and all parameters.
        seed: that of the generator, as far as it is known.
        motion: where everything is at each of T scans.
        walls: (W, 4) segments of everything that stands still: walls, glass, what never moved.
        T_odom_base: (T, 3, 3) odometry.
        sensor_rng: what a planar laser, or the first sensor in 3D, draws from.
        body_rng: how tall people are, how the robot shakes, and what a second sensor in 3D draws.
        colour_seed: what pictures look like; None: there are none.
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
        """(T,) nanoseconds, as well as the recorder knows them."""
        o, exact = self.scene.robot, self.exact_ns
        tick = max(1, round(o.stamp_rounding * 1e9))
        return _FIRST_STAMP_NS + (exact - _FIRST_STAMP_NS + tick // 2) // tick * tick

    @property
    def exact_ns(self) -> NDArray[np.int64]:
        """(T,) the same, not rounded."""
        return _FIRST_STAMP_NS + np.round(self.motion.seconds * 1e9).astype(np.int64)

    def source(self, sensors: list[dict[str, Any]]) -> dict[str, Any]:
        """What a recording says of where it is from."""
        name = self.scene.name
        return {"format": "simulation", "scene": name, "seed": self.seed, "sensors": sensors}

    def truth(
        self,
        static: NDArray[np.bool_],
        mover: NDArray[np.int32],
        T_world_base: Float,
        more: dict[str, Any] | None = None,
    ) -> Truth:
        """The truth about beams; `more` is told of the scene after `mover_kinds`."""
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
    """Let everybody move and the odometry drift.

    Args:
        scene: the world and all parameters.
        rng: generators are spawned from it, for each kind of thing one.
        tell: called now and then with the share that is done.

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
    # spawned last, so that all else stays as it is without a camera
    seed_of_colours = int(rng.spawn(1)[0].integers(1 << 31)) if scene.camera.enabled else None
    return Episode(scene, seed, motion, walls, T_odom_base, sensor_rng, body_rng, seed_of_colours)


def describe_scene(scene: Scene, seed: Any) -> dict[str, Any]:
    """Name, seed and all parameters of a scene, JSON-able; its walls lie beside as an array."""
    parameters = dataclasses.asdict(scene)
    del parameters["walls"], parameters["kerbs"]
    unused: tuple[str, ...]
    unused = () if scene.in_3d else ("lidar", "rig", "ground", "heights", "pavements")
    unused += () if scene.camera.enabled else ("camera",)
    for name in unused:
        del parameters[name]
    return {"name": parameters.pop("name"), "seed": seed, **parameters}
