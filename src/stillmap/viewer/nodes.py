"""Creation of viser nodes in the frame of a scene."""

from typing import Any

import numpy as np
import scipy  # submodules load on first use
from numpy.typing import NDArray

from stillmap.viewer.scene import Scene
from stillmap.viewer.server import Server

Float = NDArray[np.float64]

NO_SHADOWS: dict[str, Any] = {"cast_shadow": False, "receive_shadow": False}
_LAYER_STEP = 0.02  # m between the map and what is drawn on it in 2D


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
        self,
        layer: str,
        pieces: Float,
        colors: NDArray[np.uint8],
        pixels: float,
        part: str = "lines",
    ) -> Any:
        """Line segments (n, 2, 3) in m, relative to the scene's origin; colors (3,) or alike."""
        return self.server.scene.add_line_segments(
            node_path(layer, part),
            pieces.astype(np.float32),
            colors,
            thickness=pixels,
            thickness_units="screen",
        )

    def label(self, path: str) -> Any:
        """A text above its position, empty at first."""
        return self.server.scene.add_label(path, "", anchor="bottom-center")

    def place(self, node: Any, T: Float) -> None:
        """Place a node at a pose (4, 4) in the map frame."""
        node.wxyz, node.position = quaternions(T[:3, :3]), T[:3, 3] - self.scene.origin


def quaternions(R: Float) -> Float:
    """Quaternions (..., 4), w first, of rotations (..., 3, 3)."""
    xyzw = scipy.spatial.transform.Rotation.from_matrix(R).as_quat()
    return np.asarray(np.roll(xyzw, 1, axis=-1))


def node_path(layer: str, part: str = "") -> str:
    """Path of a layer's node, or of a node below it."""
    return "/" + layer.lower().replace(" ", "_") + (f"/{part}" if part else "")
