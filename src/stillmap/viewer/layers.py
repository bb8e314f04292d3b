"""The parts of a scene as viser's nodes: those that stay, and those that change with the time."""

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy  # its parts load when they are first used
from numpy.typing import NDArray

from stillmap.results import gltf
from stillmap.results.report.renderer import BACKGROUND
from stillmap.viewer import display, tracks
from stillmap.viewer.display import sample_indices
from stillmap.viewer.scene import Scene
from stillmap.viewer.server import Server
from stillmap.viewer.tracks import Beams

Float = NDArray[np.float64]

_MOST_WAY = 5_000  # pieces of the robot's way
_MOST_WAYS = 100_000  # of the ways of all that moved
_MOST_RAYS = 1_500
_MOST_NUMBERS = 60
_LIFTED = 0.02  # m: what lies on the plan is drawn above it
_LOWERED = 0.15  # m: the plan lies below a floor that is drawn, which is uneven
_KEY = "Beams: orange dynamic, blue static"
_RAY = (240, 170, 60)
# of the height of the window: edges of points of clouds and of ends of beams, the robot's axes
_POINT, _END, _AXES = 0.0007, 0.002, 0.03


class Layers:
    """What is drawn; each layer has a node of its own, which shows or hides all below it.

    Attributes:
        shown: by name, those that there is something of, and whether they are shown at first.
        notes: by name, what there is to say of a layer while it is shown.
    """

    def __init__(self, server: Server, scene: Scene, beams: Beams | None, across: float) -> None:
        """Make them all.

        Args:
            server: that shows them.
            scene: what is shown.
            beams: None: without.
            across: metres from the lower to the upper edge of the window at first.
        """
        self._server, self._scene, self._beams, self._across = server, scene, beams, across
        self._points: list[tuple[Any, float]] = []
        self._label: list[Any] = []
        self._nodes: dict[str, Any] = {}
        self.default_visibility: dict[str, bool] = {}
        self.notes: dict[str, str] = {} if beams is None else {"Beams": _KEY}
        for name, shown, is_there, make in self._kinds():
            if is_there:
                self.default_visibility[name] = shown
                self._nodes[name] = server.scene.add_frame(_path(name), False, visible=shown)
                make()

    def _kinds(self) -> list[tuple[str, bool, bool, Callable[[], None]]]:
        """Name, whether it is shown at first, whether there is any of it, what makes it."""
        scene, beams = self._scene, self._beams is not None
        static, bare = "static" in scene.clouds, scene.surface is None
        return [
            # these would hide a surface, or lie on it
            ("Map", bare, scene.map_image is not None, self._make_plan),
            ("Surface", True, not bare, self._make_surface),
            ("Static points", bare, static, lambda: self._make_cloud("static")),
            (
                "Dynamic points",
                False,
                "dynamic" in scene.clouds,
                lambda: self._make_cloud("dynamic"),
            ),
            ("Robot", True, True, self._make_way),
            ("Beams", bare, beams, self._make_beams),
            ("Rays", False, beams, self._make_rays),
            ("Objects", True, bool(scene.tracks), self._make_boxes),
            ("Object ways", False, bool(scene.tracks), self._make_ways),
            ("Object models", True, bool(scene.models), self._make_models),
            ("Object numbers", False, bool(scene.tracks), lambda: None),
        ]

    def set_visible(self, name: str, shown: bool) -> bool:
        """Show or hide a layer; whether that changed anything."""
        if self._nodes[name].visible == shown:
            return False
        self._nodes[name].visible = shown
        return True

    def scale_points(self, factor: float) -> None:
        """Points so many times as large as at first."""
        for node, size in self._points:
            node.point_size = factor * size

    def update(self, scan: int) -> None:
        """What changes with the time, of the layers that are shown."""
        scene, stamp_ns = self._scene, int(self._scene.stamp_ns[scan])
        _place(self._robot, scene.poses[scan], scene.origin)
        if self._is_shown("Beams") or self._is_shown("Rays"):
            self._draw_beams(scan)
        if self._is_shown("Object models"):
            for node, model in zip(self._models, scene.models, strict=True):
                node.visible = tracks.is_present(model.track, stamp_ns)
                if node.visible:
                    _place(node, model.pose_at(stamp_ns), scene.origin)
        if self._is_shown("Objects") or self._is_shown("Object numbers"):
            things = tracks.object_poses_at(scene.tracks, stamp_ns)
            self._draw_boxes(things)
            self._draw_numbers(things)

    def _is_shown(self, name: str) -> bool:
        return name in self._nodes and bool(self._nodes[name].visible)

    def _make_plan(self) -> None:
        plan = self._scene.map_image
        assert plan is not None
        x0, y0, x1, y1 = plan.window
        z = self._scene.ground - (0.0 if self._scene.surface is None else _LOWERED)
        middle = np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1), z])
        self._server.scene.add_image(
            _path("Map", "plan"),
            plan.picture,
            x1 - x0,
            y1 - y0,
            format="png",
            cast_shadow=False,
            receive_shadow=False,
            # viser's pictures hang, facing against z
            wxyz=(0.0, 1.0, 0.0, 0.0),
            position=middle - self._scene.origin,
        )

    def _make_surface(self) -> None:
        assert self._scene.surface is not None
        # a white wall would not be told from a white page
        self._server.scene.set_background_image(np.array([[BACKGROUND]], np.uint8), format="png")
        node = self._server.scene.add_glb(
            _path("Surface", "mesh"), self._scene.surface, cast_shadow=False, receive_shadow=False
        )
        _place(node, gltf.MAP_FROM_GLTF, self._scene.origin)

    def _make_cloud(self, name: str) -> None:
        cloud, layer = self._scene.clouds[name], f"{name.capitalize()} points"
        self._cloud(layer, cloud.points, cloud.colors)
        if len(cloud.points) < cloud.total:
            self.notes[layer] = f"{len(cloud.points):,} of {cloud.total:,} {name} points are shown"

    def _make_way(self) -> None:
        places = self._scene.poses[:, :3, 3] - self._scene.origin
        if self._scene.is_2d:
            places = places + np.array([0.0, 0.0, 2 * _LIFTED])
        use = places[sample_indices(len(places), _MOST_WAY)]
        pieces = np.stack([use[:-1], use[1:]], axis=1)
        self._lines("Robot", pieces, np.array(display.BLUE, np.uint8), 2.5)
        length = _AXES * self._across
        self._robot = self._server.scene.add_frame(
            _path("Robot", "robot"), axes_length=length, axes_radius=0.06 * length
        )

    def _make_beams(self) -> None:
        self._ends = self._cloud("Beams", np.zeros((1, 3), np.float32), np.zeros((1, 3), np.uint8))

    def _make_rays(self) -> None:
        self._ray = self._lines("Rays", np.zeros((1, 2, 3)), np.array(_RAY, np.uint8), 1.0)

    def _draw_beams(self, scan: int) -> None:
        assert self._beams is not None
        seen = self._beams.scan_view(scan)
        ends = seen.ends - self._scene.origin
        if self._scene.is_2d:
            ends[:, 2] = 3 * _LIFTED
        with self._server.atomic():
            self._ends.points = ends.astype(np.float32)
            self._ends.colors = display.color_by_p_static(seen.p_static)
        some = ends[sample_indices(len(ends), _MOST_RAYS)]
        begin = np.broadcast_to(seen.origin - self._scene.origin, some.shape)
        self._ray.points = np.stack([begin, some], axis=1).astype(np.float32)

    def _make_boxes(self) -> None:
        pieces = np.zeros((1, 2, 3))
        self._box = self._lines("Objects", pieces, np.zeros((1, 2, 3), np.uint8), 2.0)

    def _draw_boxes(self, things: tracks.ObjectPoses) -> None:
        lines = tracks.box_edges(things) - self._scene.origin
        if self._scene.is_2d:
            lines = lines + np.array([0.0, 0.0, 2 * _LIFTED])
        tone = display.color_by_id([self._scene.tracks[n].id for n in things.index])
        tones = np.broadcast_to(tone[:, None, None], lines.shape)
        with self._server.atomic():
            self._box.points = lines.reshape(-1, 2, 3).astype(np.float32)
            self._box.colors = tones.reshape(-1, 2, 3)

    def _make_ways(self) -> None:
        pieces, whose = tracks.track_segments(self._scene.tracks)
        use = sample_indices(len(pieces), _MOST_WAYS)
        tone = display.color_by_id([self._scene.tracks[n].id for n in whose[use]])
        lifted = np.array([0.0, 0.0, _LIFTED if self._scene.is_2d else 0.0])
        lines = pieces[use] - self._scene.origin + lifted
        self._lines("Object ways", lines, np.repeat(tone[:, None], 2, axis=1), 1.5)

    def _make_models(self) -> None:
        self._models = [
            self._server.scene.add_glb(
                _path("Object models", f"{model.track.id:04d}"),
                model.data,
                visible=False,
                cast_shadow=False,
                receive_shadow=False,
            )
            for model in self._scene.models
        ]

    def _draw_numbers(self, things: tracks.ObjectPoses) -> None:
        """Labels are made when they are needed, and used again for other things."""
        count = _MOST_NUMBERS if self._is_shown("Object numbers") else 0
        use = things.index[:count]
        while len(self._label) < len(use):
            path = _path("Object numbers", f"{len(self._label)}")
            self._label.append(self._server.scene.add_label(path, "", anchor="bottom-center"))
        for n, label in enumerate(self._label):
            label.visible = n < len(use)
            if label.visible:
                label.text = str(self._scene.tracks[use[n]].id)
                top = np.array([0.0, 0.0, 0.5 * float(things.size[n, 2])])
                label.position = things.T_map_object[n, :3, 3] - self._scene.origin + top

    def _cloud(self, name: str, points: NDArray[np.float32], colour: NDArray[np.uint8]) -> Any:
        size = self._across * (_END if name == "Beams" else _POINT)
        node = self._server.scene.add_point_cloud(
            _path(name, "points"),
            points,
            colour,
            point_size=size,
            point_shape="circle",
            point_shading="flat",
            precision="float32",
        )
        self._points.append((node, size))
        return node

    def _lines(self, name: str, pieces: Float, colour: NDArray[np.uint8], pixels: float) -> Any:
        return self._server.scene.add_line_segments(
            _path(name, "lines"),
            pieces.astype(np.float32),
            colour,
            thickness=pixels,
            thickness_units="screen",
        )


def _path(name: str, part: str = "") -> str:
    return "/" + name.lower().replace(" ", "_") + (f"/{part}" if part else "")


def _place(node: Any, T: Float, origin: Float) -> None:
    """Put a node at a pose (4, 4) in the map frame."""
    x, y, z, w = scipy.spatial.transform.Rotation.from_matrix(T[:3, :3]).as_quat()
    node.wxyz, node.position = (w, x, y, z), T[:3, 3] - origin
