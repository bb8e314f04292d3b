"""The layers of a scene as viser nodes: fixed ones, and those that depend on the time."""

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy  # submodules load on first use
from numpy.typing import NDArray

from stillmap.core.arrays import sample_indices
from stillmap.results import gltf, object_poses
from stillmap.results.colors import BLUE, color_by_id, color_by_p_static
from stillmap.results.report.renderer import BACKGROUND
from stillmap.viewer import tracks
from stillmap.viewer.scene import Scene
from stillmap.viewer.server import Server
from stillmap.viewer.tracks import Beams

Float = NDArray[np.float64]

_MAX_TRAJECTORY_POINTS = 5_000
_MAX_TRACK_SEGMENTS = 100_000
_MAX_RAYS = 1_500
_MAX_NUMBERS = 60
_LAYER_STEP = 0.02  # m between the map and what is drawn on it in 2D
_MAP_DEPTH = 0.15  # m of the map below the surface, which is uneven
_BEAMS_NOTE = "Beams: orange dynamic, blue static"
_RAY_COLOR = (240, 170, 60)
_NO_SHADOWS: dict[str, Any] = {"cast_shadow": False, "receive_shadow": False}
# sizes as shares of the height of the view: cloud points, beam ends, axes of the robot
_POINT_SIZE, _END_SIZE, _AXES_SIZE = 0.0007, 0.002, 0.03


class Layers:
    """The layers of a scene; each has a parent node that shows or hides it.

    Attributes:
        default_visibility: by name of the layer.
        notes: by name, text to show with a visible layer.
    """

    def __init__(self, server: Server, scene: Scene, beams: Beams | None, height: float) -> None:
        """Create the nodes.

        Args:
            server: the page.
            scene: what to draw.
            beams: None: without beams and rays.
            height: height of the default view in m.
        """
        self._server, self._scene, self._beams, self._height = server, scene, beams, height
        self._points: list[tuple[Any, float]] = []
        self._label: list[Any] = []
        self._nodes: dict[str, Any] = {}
        self.default_visibility: dict[str, bool] = {}
        self.notes: dict[str, str] = {} if beams is None else {"Beams": _BEAMS_NOTE}
        for name, shown, exists, make in self._definitions():
            if exists:
                self.default_visibility[name] = shown
                self._nodes[name] = server.scene.add_frame(_path(name), False, visible=shown)
                make()

    def _definitions(self) -> list[tuple[str, bool, bool, Callable[[], None]]]:
        """Name, default visibility, whether there is data, and the function that creates it."""
        scene, beams = self._scene, self._beams is not None
        static, dynamic = "static" in scene.clouds, "dynamic" in scene.clouds
        bare = scene.surface is None
        return [
            # hidden by default where a surface would cover them or be covered
            ("Map", bare, scene.map_image is not None, self._make_map),
            ("Surface", True, not bare, self._make_surface),
            ("Static points", bare, static, lambda: self._make_cloud("static")),
            ("Dynamic points", False, dynamic, lambda: self._make_cloud("dynamic")),
            ("Robot", True, True, self._make_trajectory),
            ("Beams", bare, beams, self._make_beams),
            ("Rays", False, beams, self._make_rays),
            ("Objects", True, bool(scene.tracks), self._make_boxes),
            ("Object tracks", False, bool(scene.tracks), self._make_tracks),
            ("Object models", True, bool(scene.models), self._make_models),
            ("Object numbers", False, bool(scene.tracks), lambda: None),
        ]

    def set_visible(self, name: str, shown: bool) -> bool:
        """Show or hide a layer; returns whether that changed it."""
        if self._nodes[name].visible == shown:
            return False
        self._nodes[name].visible = shown
        return True

    def scale_points(self, factor: float) -> None:
        """Scale the points by a factor of their initial size."""
        for node, size in self._points:
            node.point_size = factor * size

    def update(self, scan: int) -> None:
        """Update the visible layers that depend on the time."""
        scene, stamp_ns = self._scene, int(self._scene.stamp_ns[scan])
        _place(self._robot, scene.poses[scan], scene.origin)
        if self._is_shown("Beams") or self._is_shown("Rays"):
            self._draw_beams(scan)
        if self._is_shown("Object models"):
            for node, model in zip(self._models, scene.models, strict=True):
                node.visible = object_poses.is_present(model.track, stamp_ns)
                if node.visible:
                    _place(node, model.pose_at(stamp_ns), scene.origin)
        if self._is_shown("Objects") or self._is_shown("Object numbers"):
            objects = object_poses.object_poses_at(scene.tracks, stamp_ns)
            self._draw_boxes(objects)
            self._draw_numbers(objects)

    def _is_shown(self, name: str) -> bool:
        return name in self._nodes and bool(self._nodes[name].visible)

    def _origin(self, level: int) -> Float:
        """(3,) m; relative to it a layer of a 2D scene lies so many steps above the map."""
        lift = level * _LAYER_STEP if self._scene.is_2d else 0.0
        return np.asarray(self._scene.origin - np.array([0.0, 0.0, lift]))

    def _make_map(self) -> None:
        plan = self._scene.map_image
        assert plan is not None
        x0, y0, x1, y1 = plan.window
        z = self._scene.ground - (0.0 if self._scene.surface is None else _MAP_DEPTH)
        middle = np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1), z])
        self._server.scene.add_image(
            _path("Map", "plan"),
            plan.picture,
            x1 - x0,
            y1 - y0,
            format="png",
            **_NO_SHADOWS,
            # viser's images face -z
            wxyz=(0.0, 1.0, 0.0, 0.0),
            position=middle - self._scene.origin,
        )

    def _make_surface(self) -> None:
        assert self._scene.surface is not None
        # light grey, so that white walls are visible
        self._server.scene.set_background_image(np.array([[BACKGROUND]], np.uint8), format="png")
        path = _path("Surface", "mesh")
        node = self._server.scene.add_glb(path, self._scene.surface, **_NO_SHADOWS)
        _place(node, gltf.MAP_FROM_GLTF, self._scene.origin)

    def _make_cloud(self, name: str) -> None:
        cloud, layer = self._scene.clouds[name], f"{name.capitalize()} points"
        assert cloud.colors is not None
        self._cloud(layer, cloud.points, cloud.colors)
        if len(cloud.points) < cloud.total:
            self.notes[layer] = f"{len(cloud.points):,} of {cloud.total:,} {name} points are shown"

    def _make_trajectory(self) -> None:
        positions = self._scene.poses[:, :3, 3] - self._origin(2)
        use = positions[sample_indices(len(positions), _MAX_TRAJECTORY_POINTS)]
        segments = np.stack([use[:-1], use[1:]], axis=1)
        self._lines("Robot", segments, np.array(BLUE, np.uint8), 2.5)
        length = _AXES_SIZE * self._height
        self._robot = self._server.scene.add_frame(
            _path("Robot", "robot"), axes_length=length, axes_radius=0.06 * length
        )

    def _make_beams(self) -> None:
        self._ends = self._cloud("Beams", np.zeros((1, 3), np.float32), np.zeros((1, 3), np.uint8))

    def _make_rays(self) -> None:
        self._ray = self._lines("Rays", np.zeros((1, 2, 3)), np.array(_RAY_COLOR, np.uint8), 1.0)

    def _draw_beams(self, scan: int) -> None:
        assert self._beams is not None
        view = self._beams.scan_view(scan)
        ends = view.ends - self._origin(3)
        with self._server.atomic():
            self._ends.points = ends.astype(np.float32)
            self._ends.colors = color_by_p_static(view.p_static)
        some = ends[sample_indices(len(ends), _MAX_RAYS)]
        begin = np.broadcast_to(view.origin - self._scene.origin, some.shape)
        self._ray.points = np.stack([begin, some], axis=1).astype(np.float32)

    def _make_boxes(self) -> None:
        pieces = np.zeros((1, 2, 3))
        self._box = self._lines("Objects", pieces, np.zeros((1, 2, 3), np.uint8), 2.0)

    def _draw_boxes(self, objects: object_poses.ObjectPoses) -> None:
        lines = tracks.box_edges(objects) - self._origin(2)
        color = color_by_id([self._scene.tracks[n].id for n in objects.track])
        colors = np.broadcast_to(color[:, None, None], lines.shape)
        with self._server.atomic():
            self._box.points = lines.reshape(-1, 2, 3).astype(np.float32)
            self._box.colors = colors.reshape(-1, 2, 3)

    def _make_tracks(self) -> None:
        segments, index = tracks.track_segments(self._scene.tracks)
        use = sample_indices(len(segments), _MAX_TRACK_SEGMENTS)
        color = color_by_id([self._scene.tracks[n].id for n in index[use]])
        lines = segments[use] - self._origin(1)
        self._lines("Object tracks", lines, np.repeat(color[:, None], 2, axis=1), 1.5)

    def _make_models(self) -> None:
        self._models = [
            self._server.scene.add_glb(
                _path("Object models", f"{model.track.id:04d}"),
                model.data,
                visible=False,
                **_NO_SHADOWS,
            )
            for model in self._scene.models
        ]

    def _draw_numbers(self, objects: object_poses.ObjectPoses) -> None:
        """Show ids as labels; labels are created on demand and reused."""
        count = _MAX_NUMBERS if self._is_shown("Object numbers") else 0
        use = objects.track[:count]
        while len(self._label) < len(use):
            path = _path("Object numbers", f"{len(self._label)}")
            self._label.append(self._server.scene.add_label(path, "", anchor="bottom-center"))
        for n, label in enumerate(self._label):
            label.visible = n < len(use)
            if label.visible:
                label.text = str(self._scene.tracks[use[n]].id)
                top = np.array([0.0, 0.0, 0.5 * float(objects.size[n, 2])])
                label.position = objects.T_map_object[n, :3, 3] - self._scene.origin + top

    def _cloud(self, name: str, points: NDArray[np.floating], color: NDArray[np.uint8]) -> Any:
        size = self._height * (_END_SIZE if name == "Beams" else _POINT_SIZE)
        node = self._server.scene.add_point_cloud(
            _path(name, "points"),
            points,
            color,
            point_size=size,
            point_shape="circle",
            point_shading="flat",
            precision="float32",
        )
        self._points.append((node, size))
        return node

    def _lines(self, name: str, pieces: Float, color: NDArray[np.uint8], pixels: float) -> Any:
        return self._server.scene.add_line_segments(
            _path(name, "lines"),
            pieces.astype(np.float32),
            color,
            thickness=pixels,
            thickness_units="screen",
        )


def _path(name: str, part: str = "") -> str:
    return "/" + name.lower().replace(" ", "_") + (f"/{part}" if part else "")


def _place(node: Any, T: Float, origin: Float) -> None:
    """Place a node at a pose (4, 4) in the map frame."""
    x, y, z, w = scipy.spatial.transform.Rotation.from_matrix(T[:3, :3]).as_quat()
    node.wxyz, node.position = (w, x, y, z), T[:3, 3] - origin
