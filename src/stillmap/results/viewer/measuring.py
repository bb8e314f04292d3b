"""Measuring: while it lasts, clicks are ends of distances."""

import math
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.array_types import Float
from stillmap.results.viewer.nodes import Nodes, escape_markdown, node_path

_CLICK_RADIUS = 0.01  # of a click on a point, as a share of the height of the view
_MARK_SIZE = 0.006  # of a clicked point, likewise
_RED = np.array((200, 0, 60), np.uint8)


class Ray(NamedTuple):
    """A ray of sight through a pixel, from (3,) m along a unit vector (3,)."""

    origin: Float
    direction: Float


def pick_point(ray: Ray, clouds: Iterable[NDArray[np.floating]], tangent: float) -> Float | None:
    """The point (3,) of the clouds that a ray meets first; None where it meets none.

    Of the points within the cone around the ray, those about as far away as the nearest one belong
    to the same surface; of these it is the one closest to the ray.

    Args:
        ray: of the click.
        clouds: each (n, 3) m.
        tangent: of the angle between axis and side of the cone.
    """
    points = np.concatenate([np.zeros((0, 3)), *(cloud.astype(np.float64) for cloud in clouds)])
    offset = points - ray.origin
    depth = offset @ ray.direction
    across = np.linalg.norm(offset - depth[:, None] * ray.direction, axis=1)
    within = np.flatnonzero((depth > 0.0) & (across <= depth * tangent))
    if not len(within):
        return None
    near = within[depth[within] <= depth[within].min() * (1.0 + 2.0 * tangent)]
    return np.asarray(points[near[np.argmin(across[near] / depth[near])]])


def pick_plane(ray: Ray, z: float) -> Float | None:
    """The point (3,) where a ray meets the horizontal plane at height z; None where it does not."""
    rise = float(ray.direction[2])
    depth = (z - float(ray.origin[2])) / rise if abs(rise) > 1e-9 else 0.0
    return np.asarray(ray.origin + depth * ray.direction) if depth > 0.0 else None


class Measuring:
    """Buttons, clicked points, and the distance between every two of them.

    Attributes:
        active: whether clicks are points.
        points: (3,) m each, relative to the scene's origin.
    """

    def __init__(
        self,
        nodes: Nodes,
        pick: Callable[[Ray, float], Float | None],
        defer: Callable[..., Callable[..., None]],
    ) -> None:
        """Add the controls.

        Args:
            nodes: draws what was measured.
            pick: the visible point that a ray meets; see `Layers.pick`.
            defer: makes a callback for viser's threads that has a function called later.
        """
        self._nodes, self._pick, self._defer = nodes, pick, defer
        self.active, self.points, self._drawn = False, list[Float](), list[Any]()
        gui = nodes.server.gui
        self._button = gui.add_button("Measure")
        self._button.on_click(defer(self.toggle))
        self._text: Any = gui.add_markdown("", visible=False)

    @property
    def distances(self) -> list[float]:
        """In m, of the pairs that are complete."""
        ends = zip(self.points[::2], self.points[1::2], strict=False)
        return [float(np.linalg.norm(b - a)) for a, b in ends]

    def toggle(self) -> None:
        """Start or stop measuring; what was measured stays."""
        self.active = not self.active
        scene = self._nodes.server.scene
        if self.active:
            scene.on_click()(self._click)
        else:
            scene.remove_click_callback(self._click)
        self._button.label = "Stop measuring" if self.active else "Measure"
        self._show()

    def clear(self) -> None:
        """Remove what was measured."""
        for node in self._drawn:
            node.remove()
        self._drawn, self.points = [], []
        self._show()

    def add(self, ray: Ray, tangent: float) -> None:
        """Add the visible point that a ray meets."""
        if not self.active:
            return
        point = self._pick(ray, tangent)
        if point is not None:
            self.points.append(point)
            self._draw(f"Measured {len(self.points)}")
        self._show("" if point is not None else "There is no point there. ")

    def _draw(self, layer: str) -> None:
        """Draw the last point, and the distance that it ends."""
        self._drawn.append(self._nodes.cloud(layer, self.points[-1][None], _RED[None], _MARK_SIZE))
        if len(self.points) % 2 == 0:
            ends = np.stack(self.points[-2:])
            label = self._nodes.label(node_path(layer, "distance"))
            label.text, label.position = f"{self.distances[-1]:.2f} m", ends.mean(axis=0)
            self._drawn += [self._nodes.lines(layer, ends[None], _RED, 3.0), label]

    def _click(self, event: Any) -> None:
        """Called by viser, in one of its threads."""
        ray = Ray(np.array(event.ray_origin), np.array(event.ray_direction))
        tangent = _CLICK_RADIUS * 2.0 * math.tan(0.5 * float(event.client.camera.fov))
        self._defer(self.add, ray, tangent)()

    def _show(self, message: str = "") -> None:
        """Show the distances, and what the next click will be."""
        lines = [f"{length:.2f} m" for length in self.distances]
        if self.active:
            end = ("first", "second")[len(self.points) % 2]
            lines.append(f"{message}Click on the {end} point.")
        self._text.content = "  \n".join(escape_markdown(line) for line in lines)
        self._text.visible = bool(lines)
