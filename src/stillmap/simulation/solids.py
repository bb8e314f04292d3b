"""What a lidar can hit: upright faces that stand still, and solids that stand still or move."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]

BOX, CYLINDER, ELLIPSOID = 0, 1, 2


class Faces(NamedTuple):
    """F upright faces.

    Attributes:
        ends: (F, 4) x0, y0, x1, y1 in metres.
        z: (F, 2) metres above the street, their lower and upper edges, which follow its slope.
        is_glass: (F,) bool.
    """

    ends: Float
    z: Float
    is_glass: NDArray[np.bool_]


class Solids(NamedTuple):
    """P upright boxes, elliptic cylinders and ellipsoids, at n times or at all times (n = 1).

    Attributes:
        pose: (n, P, 4) x, y of the middle in metres, heading in rad, height of the foot in metres.
        form: (P,) BOX, CYLINDER or ELLIPSOID.
        half: (P, 2) metres, half of what they measure along and across the heading.
        z: (P, 2) metres above the foot, from where to where they reach.
        mover: (P,) int32 whose part it is; -1: it stands still.
    """

    pose: Float
    form: NDArray[np.int8]
    half: Float
    z: Float
    mover: NDArray[np.int32]

    def some(self, kept: NDArray[np.bool_] | NDArray[np.intp]) -> "Solids":
        """Those that are kept."""
        return Solids(
            self.pose[:, kept], self.form[kept], self.half[kept], self.z[kept], self.mover[kept]
        )

    def with_others(self, others: "Solids") -> "Solids":
        """These, and then others at the same times."""
        return Solids(
            np.concatenate([self.pose, others.pose], axis=1),
            np.concatenate([self.form, others.form]),
            np.concatenate([self.half, others.half]),
            np.concatenate([self.z, others.z]),
            np.concatenate([self.mover, others.mover]),
        )


class Part(NamedTuple):
    """A solid as a part of something: where it sits on it, ahead and to the left, in metres.

    `half` and `z` as in Solids; `turn` in rad against the heading of the whole.
    """

    form: int
    ahead: float
    aside: float
    half: tuple[float, float]
    z: tuple[float, float]
    turn: float = 0.0


class Assembly(NamedTuple):
    """Parts of things, each of which is carried by one of K carriers.

    Attributes:
        carrier: (P,) which one carries it.
        offset: (P, 3) metres ahead and to the left of the carrier's middle, rad to the left.
        form, half, z: see Solids.
        mover: see Solids.
    """

    carrier: NDArray[np.int64]
    offset: Float
    form: NDArray[np.int8]
    half: Float
    z: Float
    mover: NDArray[np.int32]

    def at(self, poses: Float, foot: Float) -> Solids:
        """Where all parts are.

        Args:
            poses: (n, K, 3) of the carriers: x, y in metres, heading in rad.
            foot: (n, K) how high the floor is on which they stand, metres.
        """
        x, y, heading = np.moveaxis(poses, -1, 0)
        c, s = np.cos(heading)[:, self.carrier], np.sin(heading)[:, self.carrier]
        ahead, aside, turn = self.offset.T
        at = np.empty((*c.shape, 4))
        at[..., 0] = x[:, self.carrier] + c * ahead - s * aside
        at[..., 1] = y[:, self.carrier] + s * ahead + c * aside
        at[..., 2], at[..., 3] = heading[:, self.carrier] + turn, foot[:, self.carrier]
        return Solids(at, self.form, self.half, self.z, self.mover)


def assembled(parts: Sequence[tuple[int, int, Part]]) -> Assembly:
    """The parts of things: number of the carrier, number of the mover, and the part itself."""
    return Assembly(
        np.array([carrier for carrier, _, _ in parts], np.int64),
        np.array([(p.ahead, p.aside, p.turn) for _, _, p in parts], float).reshape(-1, 3),
        np.array([p.form for _, _, p in parts], np.int8),
        np.array([p.half for _, _, p in parts], float).reshape(-1, 2),
        np.array([p.z for _, _, p in parts], float).reshape(-1, 2),
        np.array([mover for _, mover, _ in parts], np.int32),
    )
