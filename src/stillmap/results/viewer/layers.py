"""The layers of a scene as viser nodes: fixed ones, and those that depend on the time."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.array_types import Float
from stillmap.core.arrays import sample_indices
from stillmap.mesh.texture import GRAY
from stillmap.results import colors as palette
from stillmap.results import gltf
from stillmap.results.viewer.measuring import Ray, pick_plane, pick_point
from stillmap.results.viewer.nodes import NO_SHADOWS, Nodes, node_path
from stillmap.results.viewer.objects import ObjectNodes
from stillmap.results.viewer.scene import MAX_POINTS, Beams, MapImage, Points, to_rgba
from stillmap.results.viewer.sessions import Sessions

_MAX_TRAJECTORY_POINTS = 5_000
_MAX_RAYS = 1_500
_MAP_DEPTH = 0.15  # m of the map below the surface, which is uneven
# sizes as shares of the height of the view: cloud points, beam ends, axes of the robot
_POINT_SIZE, _FLAT_POINT_SIZE, _END_SIZE, _AXES_SIZE = 0.0009, 0.0014, 0.0022, 0.03
_HEIGHT_QUANTILES = (0.02, 0.98)  # of the static points, at the ends of the color map

LABEL, HEIGHT, PICTURES = "label", "height", "pictures"  # what points are colored by
STATIC, DYNAMIC = "Static points", "Dynamic points"


class Layers:
    """The layers of a scene; each has a parent node that shows or hides it.

    Attributes:
        default_visibility: by name of the layer.
        clouds: by name of the layer, relative to the scene's origin.
        colorings: what the points can be colored by; the first is the default.
        heights: lowest and highest of the color map of heights, in m in the map frame.
    """

    def __init__(
        self,
        nodes: Nodes,
        beams: Beams | None,
        objects: ObjectNodes,
        sessions: Sessions | None = None,
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
        self.default_visibility: dict[str, bool] = {}
        self.clouds = dict(self._scene.clouds)
        if self._scene.is_2d and beams is not None:  # the dynamic points are those of the recording
            ends = beams.dynamic_ends(MAX_POINTS["dynamic"])
            points = np.pad(ends, ((0, 0), (0, 1))) - nodes.origin(1)
            self.clouds |= {DYNAMIC: Points(points.astype(np.float32), None)} if len(ends) else {}
        self.heights: tuple[float, float] = (0.0, 0.0)
        self.colorings: tuple[str, ...] = (LABEL,)
        if (static := self.clouds.get(STATIC)) is not None:
            z = static.points[:, 2].astype(np.float64)
            low, high = (np.quantile(z, _HEIGHT_QUANTILES) + nodes.scene.origin[2]).tolist()
            self.heights = low, high
            self.colorings = (LABEL, HEIGHT) + (PICTURES,) * (static.colors is not None)
        # light grey, so that white walls are visible
        background = np.array([[palette.BACKGROUND]], np.uint8)
        nodes.server.scene.set_background_image(background, format="png")
        self._make_all()

    def _make_all(self) -> None:
        """Create the layers for which there is data."""
        scene, sessions, objects = self._scene, self._sessions, self._objects
        if scene.map_image is not None:
            self._make_map(scene.map_image)
        if scene.surface is not None:  # hidden at first: it would cover the points
            self._add("Surface", lambda: self._make_surface(scene.surface), shown=False)
        for name, cloud in self.clouds.items():
            self._make_cloud(name, cloud)
        self._add("Robot", self._make_trajectory)
        if self._beams is not None:
            self._add("Beams", self._make_beams)
            self._add("Rays", self._make_rays, shown=False)
        if scene.tracks:
            self._add("Objects", objects.make_boxes)
            self._add("Object tracks", objects.make_tracks, shown=False)
        if scene.models:
            self._add("Object models", objects.make_models)
        if scene.tracks:
            self._add("Object ids", shown=False)
        if sessions is not None:
            self._add("Sessions", sessions.make_trajectories)
            if sessions.count > 1:
                self._add("Changes", sessions.make_boxes)
                self._add("Change labels", shown=False)

    def _add(
        self, name: str, make: Callable[[], object] = lambda: None, shown: bool = True
    ) -> None:
        """Add a layer, whose nodes `make` creates."""
        self.default_visibility[name] = shown
        parent = self._nodes.server.scene.add_frame(node_path(name), False, visible=shown)
        self._parents[name] = parent
        make()

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

    def pick(self, ray: Ray, tangent: float) -> Float | None:
        """The visible point (3,) that a ray meets, relative to the scene's origin; else the map's.

        Args:
            ray: of a click.
            tangent: of the angle around it within which a point is met.
        """
        shown = {name for name in self.clouds if self.is_shown(name)}
        if self.is_shown("Surface"):  # the static points lie on it
            shown |= {STATIC} & self.clouds.keys()
        clouds = [self.clouds[name].points for name in sorted(shown)]
        found = None if self._scene.is_2d else pick_point(ray, clouds, tangent)
        if found is None and self.is_shown("Map"):
            found = pick_plane(ray, self._map_height - float(self._scene.origin[2]))
        return found

    def update(self, scan: int) -> None:
        """Update the visible layers that depend on the time."""
        self._nodes.place(self._robot, self._scene.poses[scan])
        if self.is_shown("Beams") or self.is_shown("Rays"):
            self._draw_beams(scan)
        session = "" if self._sessions is None else self._sessions.name
        self._objects.update(int(self._scene.stamp_ns[scan]), session, self.is_shown)
        if self._sessions is not None:
            self._sessions.update(self.is_shown("Change labels"))

    def show_session(self, sessions: Sessions) -> None:
        """Show the map and the trajectory of the chosen session of a place."""
        if self._scene.pictures is not None:
            drawn = self._scene.pictures.draw(sessions.session)
            self._map.image = to_rgba(drawn, transparent=not self._scene.is_2d)
        pieces = self._nodes.path_pieces(sessions.scans, 2, _MAX_TRAJECTORY_POINTS)
        self._path.points = pieces.astype(np.float32)

    def _cloud_colors(self, name: str, cloud: Points, by: str) -> NDArray[np.uint8]:
        """(n, 3) of the points of a layer."""
        if by == PICTURES and cloud.colors is not None:
            colors = cloud.colors.copy()
            if name == DYNAMIC:  # grey where no picture shows them, which would look static
                colors[(colors == GRAY).all(axis=1)] = palette.ORANGE
            return colors
        if name == DYNAMIC:
            return np.full((len(cloud.points), 3), palette.ORANGE, np.uint8)
        z = cloud.points[:, 2] + self._scene.origin[2]
        stops = palette.HEIGHT_COLORS if by == HEIGHT else palette.STATIC_COLORS
        return palette.color_by_height(z, *self.heights, stops)

    @property
    def _map_height(self) -> float:
        """In m, in the map frame."""
        return self._scene.ground - (0.0 if self._scene.surface is None else _MAP_DEPTH)

    def _make_map(self, plan: MapImage) -> None:
        self._add("Map")
        x0, y0, x1, y1 = plan.window
        center = np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1), self._map_height])
        self._map: Any = self._nodes.server.scene.add_image(
            node_path("Map", "plan"),
            plan.picture,
            x1 - x0,
            y1 - y0,
            format="png",
            **NO_SHADOWS,
            # viser's images face -z
            wxyz=(0.0, 1.0, 0.0, 0.0),
            position=center - self._scene.origin,
        )

    def _make_surface(self, surface: bytes | None) -> None:
        path = node_path("Surface", "mesh")
        node = self._nodes.server.scene.add_glb(path, surface or b"", **NO_SHADOWS)
        self._nodes.place(node, gltf.MAP_FROM_GLTF)

    def _make_cloud(self, name: str, cloud: Points) -> None:
        self._add(name)
        share = _FLAT_POINT_SIZE if self._scene.is_2d else _POINT_SIZE
        colors = self._cloud_colors(name, cloud, LABEL)
        node = self._nodes.cloud(name, cloud.points, colors, share)
        self._points[name] = node, node.point_size

    def _make_trajectory(self) -> None:
        whole = slice(0, len(self._scene.poses))
        pieces = self._nodes.path_pieces(whole, 2, _MAX_TRAJECTORY_POINTS)
        self._path = self._nodes.lines("Robot", pieces, palette.BLUE, 2.5)
        length = _AXES_SIZE * self._nodes.height
        self._robot = self._nodes.server.scene.add_frame(
            node_path("Robot", "robot"), axes_length=length, axes_radius=0.06 * length
        )

    def _make_beams(self) -> None:
        points, colors = np.zeros((1, 3), np.float32), np.zeros((1, 3), np.uint8)
        self._ends = self._nodes.cloud("Beams", points, colors, _END_SIZE)
        self._points["Beams"] = self._ends, self._ends.point_size

    def _make_rays(self) -> None:
        self._ray = self._nodes.lines("Rays", np.zeros((1, 2, 3)), palette.TEAL, 1.0)

    def _draw_beams(self, scan: int) -> None:
        assert self._beams is not None
        ends, p_static, sensor = self._beams.scan_view(scan)
        ends = ends - self._nodes.origin(3)
        with self._nodes.server.atomic():
            self._ends.points = ends.astype(np.float32)
            self._ends.colors = palette.color_by_p_static(p_static)
        some = ends[sample_indices(len(ends), _MAX_RAYS)]
        begin = np.broadcast_to(sensor - self._scene.origin, some.shape)
        self._ray.points = np.stack([begin, some], axis=1).astype(np.float32)
