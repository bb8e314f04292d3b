"""Creation of viser nodes in the frame of a scene, and its default view."""

import math
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.array_types import Float
from stillmap.core.arrays import sample_indices
from stillmap.io.trajectory import quaternion_from_pose
from stillmap.results.report.template import render_part
from stillmap.results.viewer.scene import Scene
from stillmap.results.viewer.server import Server

FIELD_OF_VIEW = math.radians(60.0)  # vertical
_ASPECT = 1.1  # width / height of the page beside the controls, at least
_MARGIN = 1.1
_EXTENT_QUANTILES = (0.03, 0.97)  # of the points, without far outliers
_DIRECTION_3D = np.array([-0.45, -0.7, 0.62])  # from the scene to the camera
_SCALE_3D = 0.95  # of the height: what lies behind the center appears smaller
_MIN_EXTENT = 5.0  # m
NO_SHADOWS: dict[str, Any] = {"cast_shadow": False, "receive_shadow": False}
_LAYER_STEP = 0.02  # m between the map and what is drawn on it in 2D


class DefaultView(NamedTuple):
    """The initial camera.

    Attributes:
        position, look_at: (3,) m relative to the scene's origin.
        height: height of the view in m at `look_at`.
        distance: from the camera to `look_at` in m.
    """

    position: Float
    look_at: Float
    height: float
    distance: float


def default_view(scene: Scene) -> DefaultView:
    """The camera that shows the whole scene: 2D from above, north up; 3D at a slant."""
    static = scene.clouds.get("Static points")
    if static is not None:
        low, high = np.quantile(static.points.astype(np.float64), _EXTENT_QUANTILES, axis=0)
    else:
        seen = scene.poses[:, :3, 3]
        if scene.map_image is not None:
            x0, y0, x1, y1 = scene.map_image.window
            seen = np.array([[x0, y0, 0.0], [x1, y1, 0.0]])
        low, high = seen.min(axis=0) - scene.origin, seen.max(axis=0) - scene.origin
    center, (width, height) = 0.5 * (low + high), np.maximum(high - low, _MIN_EXTENT)[:2]
    shown = _MARGIN * max(height, width / _ASPECT) * (1.0 if scene.is_2d else _SCALE_3D)
    distance = 0.5 * shown / math.tan(0.5 * FIELD_OF_VIEW)
    # in 2D not exactly vertical, which would leave the direction of north undefined
    direction = np.array([0.0, -0.01, 1.0]) if scene.is_2d else _DIRECTION_3D
    offset = distance * direction / np.linalg.norm(direction)
    return DefaultView(center + offset, center, shown, distance)


class Nodes:
    """Creates nodes below the parent node of their layer.

    Attributes:
        server: the page.
        scene: what is drawn.
        height: height of the default view in m.
    """

    def __init__(self, server: Server, scene: Scene, height: float) -> None:
        self.server, self.scene, self.height = server, scene, height

    def origin(self, level: int) -> Float:
        """(3,) m; relative to it a layer of a 2D scene lies so many steps above the map."""
        lift = level * _LAYER_STEP if self.scene.is_2d else 0.0
        return np.asarray(self.scene.origin - np.array([0.0, 0.0, lift]))

    def cloud(
        self, layer: str, points: NDArray[np.floating], colors: NDArray[np.uint8], share: float
    ) -> Any:
        """A point cloud (n, 3), relative to the scene's origin.

        Args:
            layer: name of the layer.
            points: (n, 3) m.
            colors: (n, 3).
            share: size of a point as a share of the height of the view.
        """
        return self.server.scene.add_point_cloud(
            node_path(layer, "points"),
            points,
            colors,
            point_size=share * self.height,
            point_shape="circle",
            point_shading="flat",
            precision="float32",
        )

    def lines(
        self, layer: str, pieces: Float, colors: Any, pixels: float, part: str = "lines"
    ) -> Any:
        """Line segments (n, 2, 3) in m, relative to the scene's origin; colors (3,) or alike."""
        return self.server.scene.add_line_segments(
            node_path(layer, part),
            pieces.astype(np.float32),
            np.asarray(colors, np.uint8),
            thickness=pixels,
            thickness_units="screen",
        )

    def path_pieces(self, scans: slice, level: int, most: int) -> Float:
        """Line segments (n, 2, 3) between at most so many poses of scans, at a level."""
        positions = self.scene.poses[scans, :3, 3] - self.origin(level)
        use = positions[sample_indices(len(positions), most)]
        return np.stack([use[:-1], use[1:]], axis=1)

    def label(self, path: str) -> Any:
        """A text above its position, empty at first."""
        return self.server.scene.add_label(path, "", anchor="bottom-center")

    def place(self, node: Any, T: Float) -> None:
        """Place a node at a pose (4, 4) in the map frame."""
        node.wxyz, node.position = quaternion_from_pose(T), T[:3, 3] - self.scene.origin


class Labels:
    """The labels of a layer, created on demand and reused."""

    def __init__(self, nodes: Nodes, layer: str) -> None:
        self._nodes, self._layer = nodes, layer
        self._labels: list[Any] = []

    def show(self, texts: Sequence[tuple[str, Float]]) -> None:
        """Show these texts alone, each with its position (3,)."""
        while len(self._labels) < len(texts):
            self._labels.append(self._nodes.label(node_path(self._layer, str(len(self._labels)))))
        for n, label in enumerate(self._labels):
            label.visible = n < len(texts)
            if label.visible:
                label.text, label.position = texts[n]


def node_path(layer: str, part: str = "") -> str:
    """Path of a layer's node, or of a node below it."""
    return "/" + layer.lower().replace(" ", "_") + (f"/{part}" if part else "")


def escape_markdown(text: str) -> str:
    """Text escaped for Markdown."""
    return re.sub(r"([\\`*_{}\[\]()<>#+\-.!|~&$:])", r"\\\1", text)


def table_html(rows: Sequence[tuple[str, str]]) -> str:
    """A table of names and values."""
    return render_part("viewer.html.j2", "table", rows)
