"""Models of what moved (Sect. 4.5): what ended on a thing, in its own frame, as a surface."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap.models.aligning import Sweep, aligned
from stillmap.models.frames import Way
from stillmap.models.options import MoverOptions
from stillmap.models.sources import Sources
from stillmap.objects import MovingObject
from stillmap.recording.stamps import beam_ns
from stillmap.surface.building import fused
from stillmap.surface.mesh import Mesh
from stillmap.surface.patches import Order, Patch, order_of, patches_of
from stillmap.texture.things import Thing
from stillmap.threads import in_order

Float = NDArray[np.float64]
Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Shape:
    """The surface of a thing that moved.

    Attributes:
        id: of the object.
        mesh: in the thing's own frame: x ahead, y left, z up, on the ground below its middle.
        way: where that frame was.
        rigid: whether it kept its shape.
        seconds: when it was of this shape: of one that is not rigid the middle of the sweep, of a
            rigid one when most of it was seen; by the time of its box.
        span: s, from the first beam of that sweep to the last; what is rigid: all of its track.
    """

    id: int
    mesh: Mesh
    way: Way
    rigid: bool
    seconds: float
    span: tuple[float, float]


class _Piece:
    """Triangles of one range image that lie on a thing, in the frame of its track."""

    def __init__(self, patch: Patch, weight: NDArray[np.float32], seconds: Float) -> None:
        self.patch, self.weight, self.seconds = patch, weight, seconds

    @property
    def middle(self) -> float:
        return float(np.median(self.seconds))
