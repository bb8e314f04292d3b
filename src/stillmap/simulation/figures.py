"""What a laser at knee or waist height sees of a person: two swinging legs, or a body."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from stillmap.simulation.free_space import FreeSpace
from stillmap.simulation.options import Shape
from stillmap.simulation.people import Crowd

Float = NDArray[np.float64]


class Figures:
    """Legs and bodies of a crowd.

    During one half of the gait a foot goes back under the body as fast as the body goes on, so
    that it stands still on the floor, while the other swings forward; then they change over.

    Attributes:
        semi_axes: (Q, 2) metres, along and across the heading; a person has one part or two.
        mover: (Q,) int32, whose part this is: first left legs, then right ones, then bodies.
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
        """The gait goes on for dt seconds; steps get short close to walls and to the robot.

        Args:
            dt: seconds.
            crowd: where everybody is and how fast they walk.
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
        """Centres (Q, 2) and headings (Q,) of all parts."""
        heading = crowd.heading[self.mover]
        phase = self._phase[self.mover] + np.where(self._side < 0, np.pi, 0.0)
        # 1 to -1 in the stance half, back in the swing half
        swing = 2 * np.abs(phase / np.pi % 2 - 1) - 1
        ahead = np.abs(self._side) * self._half_step[self.mover] * swing
        aside = self._side * self._apart[self.mover]
        c, s = np.cos(heading), np.sin(heading)
        offset = np.stack([c * ahead - s * aside, s * ahead + c * aside], axis=-1)
        return crowd.xy[self.mover] + offset, heading
