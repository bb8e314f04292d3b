"""The layers of a scene as viser nodes: fixed ones, and those that depend on the time."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.arrays import sample_indices
from stillmap.mesh.texture import GRAY
from stillmap.results import gltf
from stillmap.results.colors import (
    BACKGROUND,
    BLUE,
    ORANGE,
    TEAL,
    color_by_height,
    color_by_p_static,
    color_static,
)
from stillmap.results.viewer.beams import Beams
from stillmap.results.viewer.measuring import Ray, pick_plane, pick_point
from stillmap.results.viewer.nodes import NO_SHADOWS, Nodes, node_path
from stillmap.results.viewer.objects import ObjectNodes
from stillmap.results.viewer.scene import MAX_POINTS, Points, to_rgba
from stillmap.results.viewer.sessions import SessionNodes

_MAX_TRAJECTORY_POINTS = 5_000
_MAX_RAYS = 1_500
_MAP_DEPTH = 0.15  # m of the map below the surface, which is uneven
# sizes as shares of the height of the view: cloud points, beam ends, axes of the robot
_POINT_SIZE, _FLAT_POINT_SIZE, _END_SIZE, _AXES_SIZE = 0.0009, 0.0014, 0.0022, 0.03
_HEIGHT_QUANTILES = (0.02, 0.98)  # of the static points, at the ends of the color map

LABEL, HEIGHT, PICTURES = "label", "height", "pictures"  # what points are colored by


class Layers:
    """The layers of a scene; each has a parent node that shows or hides it.

    Attributes:
        default_visibility: by name of the layer.
        notes: by name, text to show with a visible layer.
        clouds: by name of the layer, relative to the scene's origin.
        colorings: what the points can be colored by; the first is the default.
        heights: lowest and highest of the color map of heights, in m in the map frame.
    """

    def __init__(
        self,
        nodes: Nodes,
        beams: Beams | None,
        objects: ObjectNodes,
        sessions: SessionNodes | None = None,
    ) -> None:
        """Create the nodes.

        Args:
            nodes: creates them.
            beams: None: without beams and rays.
            objects: creates those of moving objects.
            sessions: creates those of a place; None: a single result.
        """
        self._nodes, self._scene, self._beams, self._objects = nodes, nodes.scene, beams, objects
        self._sessions = sessions
        self._points: dict[str, tuple[Any, float]] = {}
        self._parents: dict[str, Any] = {}
        self.clouds = self._read_clouds()
        self.heights: tuple[float, float] = (0.0, 0.0)
        self.colorings: tuple[str, ...] = (LABEL,)
        if (static := self.clouds.get("Static points")) is not None:
            low, high = np.quantile(static.points[:, 2].astype(np.float64), _HEIGHT_QUANTILES)
            self.heights = float(low + nodes.scene.origin[2]), float(high + nodes.scene.origin[2])
            self.colorings = (LABEL, HEIGHT) + (PICTURES,) * (static.colors is not None)
        self.default_visibility: dict[str, bool] = {}
        self.notes = {
            f"{name.capitalize()} points": f"{len(one.points):,} of {one.total:,} {name} points "
            "are shown"
            for name, one in self._scene.clouds.items()
            if len(one.points) < one.total
        }
        # light grey, so that white walls are visible
        nodes.server.scene.set_background_image(np.array([[BACKGROUND]], np.uint8), format="png")
        for name, shown, exists, make in self._definitions():
            if exists:
                self.default_visibility[name] = shown
                parent = nodes.server.scene.add_frame(node_path(name), False, visible=shown)
                self._parents[name] = parent
                make()

    def _definitions(self) -> list[tuple[str, bool, bool, Callable[[], None]]]:
        """Name, default visibility, whether there is data, and the function that creates it."""
        scene, beams, moving = self._scene, self._beams is not None, bool(self._scene.tracks)
        static, dynamic = "Static points", "Dynamic points"
        definitions = [
            ("Map", True, scene.map_image is not None, self._make_map),
            # it would cover the points
            ("Surface", False, scene.surface is not None, self._make_surface),
            (static, True, static in self.clouds, lambda: self._make_cloud(static)),
            (dynamic, True, dynamic in self.clouds, lambda: self._make_cloud(dynamic)),
            ("Robot", True, True, self._make_trajectory),
            ("Beams", True, beams, self._make_beams),
            ("Rays", False, beams, self._make_rays),
            ("Objects", True, moving, self._objects.make_boxes),
            ("Object tracks", False, moving, self._objects.make_tracks),
            ("Object models", True, bool(scene.models), self._objects.make_models),
            ("Object ids", False, moving, lambda: None),
        ]
        place, sessions = scene.place, self._sessions
        if place is not None and sessions is not None:
            several = len(place) > 1
            definitions += [
                ("Sessions", True, True, sessions.make_trajectories),
                ("Changes", True, several, sessions.make_boxes),
                ("Change labels", False, several, lambda: None),
            ]
        return definitions

    def is_shown(self, name: str) -> bool:
        """True if the layer exists and is visible."""
        return name in self._parents and bool(self._parents[name].visible)

    def set_visible(self, name: str, shown: bool) -> bool:
        """Show or hide a layer; returns whether that changed it."""
        if self._parents[name].visible == shown:
            return False
        self._parents[name].visible = shown
        return True

    def scale_points(self, factor: float) -> None:
        """Scale the points by a factor of their initial size."""
        for node, size in self._points.values():
            node.point_size = factor * size

    def color_points(self, by: str) -> None:
        """Color static and dynamic points by one of `colorings`."""
        for name, cloud in self.clouds.items():
            self._points[name][0].colors = self._cloud_colors(name, cloud, by)

    def pick(self, ray: Ray, tangent: float) -> NDArray[np.float64] | None:
        """The visible point (3,) that a ray meets, relative to the scene's origin; else the map's.

        Args:
            ray: of a click.
            tangent: of the angle around it within which a point is met.
        """
        shown = [name for name in self.clouds if self.is_shown(name)]
        if self.is_shown("Surface"):  # the static points lie on it
            shown.append("Static points")
        clouds = [self.clouds[name].points for name in dict.fromkeys(shown) if name in self.clouds]
        found = None if self._scene.is_2d else pick_point(ray, clouds, tangent)
        if found is None and self.is_shown("Map"):
            found = pick_plane(ray, self._map_height - float(self._scene.origin[2]))
        return found

    def update(self, scan: int) -> None:
        """Update the visible layers that depend on the time."""
        self._nodes.place(self._robot, self._scene.poses[scan])
        if self.is_shown("Beams") or self.is_shown("Rays"):
            self._draw_beams(scan)
        self._objects.update(int(self._scene.stamp_ns[scan]), self.is_shown)
        if self._sessions is not None:
            self._sessions.update(self.is_shown("Changes"), self.is_shown("Change labels"))

    def show_session(self, session: int) -> None:
        """Show the map and the trajectory of a session of a place."""
        place = self._scene.place
        assert place is not None
        if place.pictures is not None:
            drawn = place.pictures.draw(session)
            self._map.image = to_rgba(drawn, transparent=not self._scene.is_2d)
        self._path.points = self._trajectory(place.scans_of(session)).astype(np.float32)
        self._objects.session = place.timeline.sessions[session].name

    def _read_clouds(self) -> dict[str, Points]:
        """Clouds by name of their layer; in 2D the dynamic points are those of the recording."""
        clouds = {f"{name.capitalize()} points": one for name, one in self._scene.clouds.items()}
        if self._scene.is_2d and self._beams is not None:
            ends = self._beams.dynamic_ends(MAX_POINTS["dynamic"])
            points = np.zeros((len(ends), 3)) - self._nodes.origin(1)
            points[:, :2] += ends
            clouds["Dynamic points"] = Points(points.astype(np.float32), None, len(ends))
        return {name: one for name, one in clouds.items() if len(one.points)}

    def _cloud_colors(self, name: str, cloud: Points, by: str) -> NDArray[np.uint8]:
        """(n, 3) of the points of a layer."""
        static = name == "Static points"
        if by == PICTURES and cloud.colors is not None:
            colors = cloud.colors.copy()
            if not static:  # grey where no picture shows them, which would look static
                colors[(colors == GRAY).all(axis=1)] = ORANGE
            return colors
        if not static:
            return np.full((len(cloud.points), 3), ORANGE, np.uint8)
        color = color_by_height if by == HEIGHT else color_static
        return color(cloud.points[:, 2] + self._scene.origin[2], *self.heights)

    @property
    def _map_height(self) -> float:
        """In m, in the map frame."""
        return self._scene.ground - (0.0 if self._scene.surface is None else _MAP_DEPTH)

    def _make_map(self) -> None:
        plan, scene = self._scene.map_image, self._scene
        assert plan is not None
        x0, y0, x1, y1 = plan.window
        self._map: Any = self._nodes.server.scene.add_image(
            node_path("Map", "plan"),
            plan.picture,
            x1 - x0,
            y1 - y0,
            format="png",
            **NO_SHADOWS,
            # viser's images face -z
            wxyz=(0.0, 1.0, 0.0, 0.0),
            position=np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1), self._map_height]) - scene.origin,
        )

    def _make_surface(self) -> None:
        assert self._scene.surface is not None
        path = node_path("Surface", "mesh")
        node = self._nodes.server.scene.add_glb(path, self._scene.surface, **NO_SHADOWS)
        self._nodes.place(node, gltf.MAP_FROM_GLTF)

    def _make_cloud(self, name: str) -> None:
        cloud, share = self.clouds[name], _FLAT_POINT_SIZE if self._scene.is_2d else _POINT_SIZE
        colors = self._cloud_colors(name, cloud, self.colorings[0])
        node = self._nodes.cloud(name, cloud.points, colors, share)
        self._points[name] = node, node.point_size

    def _make_trajectory(self) -> None:
        segments = self._trajectory(range(len(self._scene.poses)))
        self._path = self._nodes.lines("Robot", segments, np.array(BLUE, np.uint8), 2.5)
        length = _AXES_SIZE * self._nodes.height
        self._robot = self._nodes.server.scene.add_frame(
            node_path("Robot", "robot"), axes_length=length, axes_radius=0.06 * length
        )

    def _trajectory(self, scans: range) -> NDArray[np.float64]:
        """Line segments (n, 2, 3) between the poses of scans, relative to the scene's origin."""
        positions = self._scene.poses[scans.start : scans.stop, :3, 3] - self._nodes.origin(2)
        use = positions[sample_indices(len(positions), _MAX_TRAJECTORY_POINTS)]
        return np.stack([use[:-1], use[1:]], axis=1)

    def _make_beams(self) -> None:
        points, colors = np.zeros((1, 3), np.float32), np.zeros((1, 3), np.uint8)
        self._ends = self._nodes.cloud("Beams", points, colors, _END_SIZE)
        self._points["Beams"] = self._ends, self._ends.point_size

    def _make_rays(self) -> None:
        none = np.zeros((1, 2, 3))
        self._ray = self._nodes.lines("Rays", none, np.array(TEAL, np.uint8), 1.0)

    def _draw_beams(self, scan: int) -> None:
        assert self._beams is not None
        view = self._beams.scan_view(scan)
        ends = view.ends - self._nodes.origin(3)
        with self._nodes.server.atomic():
            self._ends.points = ends.astype(np.float32)
            self._ends.colors = color_by_p_static(view.p_static)
        some = ends[sample_indices(len(ends), _MAX_RAYS)]
        begin = np.broadcast_to(view.origin - self._scene.origin, some.shape)
        self._ray.points = np.stack([begin, some], axis=1).astype(np.float32)
