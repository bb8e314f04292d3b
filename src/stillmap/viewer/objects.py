"""Moving objects as viser nodes: boxes, numbers, models, tracks and the one that is selected."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.arrays import sample_indices
from stillmap.results.colors import color_by_id
from stillmap.results.object_poses import ObjectPoses, is_present, object_poses_at
from stillmap.viewer import tracks
from stillmap.viewer.nodes import NO_SHADOWS, Nodes, node_path, quaternions

_MAX_TRACK_SEGMENTS = 100_000
_MAX_NUMBERS = 60
_FILL_OPACITY = 0.25
_MIN_THICKNESS = 0.01  # m of the boxes in 2D, which a click must hit

# the unit cube: corners as in `tracks`, sides counterclockwise from outside
_CORNERS = ((np.arange(8)[:, None] >> np.arange(3)) & 1) - 0.5
_QUADS = np.array(
    [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
)
_TRIANGLES = np.concatenate([_QUADS[:, [0, 1, 2]], _QUADS[:, [0, 2, 3]]])


class ObjectNodes:
    """The nodes of the moving objects of a scene.

    Attributes:
        selected: id of the selected object; None: none is.
        session: name of the session of a place whose objects are shown; empty in other results.
    """

    def __init__(self, nodes: Nodes, on_click: Callable[[int], None]) -> None:
        """Create nothing yet.

        Args:
            nodes: creates them.
            on_click: called with the id of an object that was clicked, in a thread of viser.
        """
        self._nodes, self._tracks, self._on_click = nodes, nodes.scene.tracks, on_click
        self._drawn: Sequence[int] = ()
        self._labels: list[Any] = []
        self._models: list[Any] = []
        self.selected: int | None = None
        self.session = ""

    def make_boxes(self) -> None:
        """Create edges and sides of the boxes, and what marks the selected one."""
        pieces, colors = np.zeros((1, 2, 3)), np.zeros((1, 2, 3), np.uint8)
        self._edges = self._nodes.lines("Objects", pieces, colors, 2.0)
        self._sides = self._nodes.server.scene.add_batched_meshes_simple(
            node_path("Objects", "sides"),
            _CORNERS.astype(np.float32),
            _TRIANGLES,
            np.array([[1.0, 0.0, 0.0, 0.0]]),
            np.zeros((1, 3)),
            batched_scales=np.ones((1, 3)),
            batched_colors=np.zeros((1, 3), np.uint8),
            opacity=_FILL_OPACITY,
            flat_shading=True,
            side="double",
            lod="off",
            visible=False,
            **NO_SHADOWS,
        )
        self._sides.on_click(self._click_box)
        self._mark = self._nodes.lines("Selected object", pieces, colors, 5.0)
        self._mark_label = self._nodes.label(node_path("Selected object", "number"))

    def _click_box(self, event: Any) -> None:
        """Called by viser; since the click there may be other boxes."""
        drawn = self._drawn
        if event.instance_index < len(drawn):
            self._on_click(drawn[event.instance_index])

    def _click_model(self, number: int, _event: Any) -> None:
        """Called by viser."""
        self._on_click(number)

    def make_tracks(self) -> None:
        """Create the lines of whole tracks."""
        segments, index = tracks.track_segments(self._tracks)
        use = sample_indices(len(segments), _MAX_TRACK_SEGMENTS)
        lines = segments[use] - self._nodes.origin(1)
        color = np.repeat(self._colors(index[use])[:, None], 2, axis=1)
        self._nodes.lines("Object tracks", lines, color, 1.5)

    def make_models(self) -> None:
        """Create the models, all hidden."""
        for model in self._nodes.scene.models:
            path = node_path("Object models", f"{model.track.id:04d}")
            add = self._nodes.server.scene.add_glb
            node = add(path, model.data, visible=False, **NO_SHADOWS)
            node.on_click(partial(self._click_model, model.track.id))
            self._models.append(node)

    def update(self, stamp_ns: int, shown: Callable[[str], bool]) -> None:
        """Move what is shown to where it is at a time.

        Args:
            stamp_ns: the time.
            shown: whether a layer of this name is.
        """
        if shown("Object models"):
            for node, model in zip(self._models, self._nodes.scene.models, strict=True):
                node.visible = is_present(model.track, stamp_ns)
                if node.visible:
                    self._nodes.place(node, model.pose_at(stamp_ns))
        objects = self._objects_at(stamp_ns)
        if shown("Objects"):
            self._draw_boxes(objects)
        if self._tracks:
            self._draw_numbers(objects, _MAX_NUMBERS if shown("Object ids") else 0)
            self._draw_mark(objects)

    def _objects_at(self, stamp_ns: int) -> ObjectPoses:
        """Those of the session: clocks of robots may agree."""
        found = object_poses_at(self._tracks, stamp_ns)
        own = np.array([self._tracks[n].session == self.session for n in found.track], np.bool_)
        return ObjectPoses(found.track[own], found.T_map_object[own], found.size[own])

    def _colors(self, index: NDArray[np.intp]) -> NDArray[np.uint8]:
        return color_by_id([self._tracks[n].id for n in index])

    def _draw_boxes(self, objects: ObjectPoses) -> None:
        color = self._colors(objects.track)
        self._draw_edges(self._edges, objects, color)
        self._drawn = [self._tracks[n].id for n in objects.track]
        self._sides.visible = bool(self._drawn)
        if self._drawn:
            T = objects.T_map_object
            self._sides.batched_positions = (T[:, :3, 3] - self._nodes.origin(1)).astype(np.float32)
            self._sides.batched_wxyzs = quaternions(T[:, :3, :3]).astype(np.float32)
            self._sides.batched_scales = np.maximum(objects.size, _MIN_THICKNESS).astype(np.float32)
            self._sides.batched_colors = color

    def _draw_edges(self, node: Any, objects: ObjectPoses, color: NDArray[np.uint8]) -> None:
        lines = tracks.box_edges(objects) - self._nodes.origin(2)
        colors = np.broadcast_to(color[:, None, None], lines.shape)
        node.points = lines.reshape(-1, 2, 3).astype(np.float32)
        node.colors = colors.reshape(-1, 2, 3)

    def _draw_numbers(self, objects: ObjectPoses, count: int) -> None:
        """Show ids as labels; labels are created on demand and reused."""
        use = objects.track[:count]
        while len(self._labels) < len(use):
            path = node_path("Object ids", f"{len(self._labels)}")
            self._labels.append(self._nodes.label(path))
        for n, label in enumerate(self._labels):
            label.visible = n < len(use)
            if label.visible:
                label.text = str(self._tracks[use[n]].id)
                label.position = self._top(objects, n)

    def _draw_mark(self, objects: ObjectPoses) -> None:
        """Mark the selected object where it is there."""
        at = [n for n, one in enumerate(objects.track) if self._tracks[one].id == self.selected]
        self._mark.visible = self._mark_label.visible = bool(at)
        if at:
            only = ObjectPoses(objects.track[at], objects.T_map_object[at], objects.size[at])
            self._draw_edges(self._mark, only, self._colors(only.track))
            self._mark_label.text = f"object {self.selected}"
            self._mark_label.position = self._top(objects, at[0])

    def _top(self, objects: ObjectPoses, n: int) -> NDArray[np.float64]:
        """(3,) m, relative to the scene's origin."""
        top = np.array([0.0, 0.0, 0.5 * float(objects.size[n, 2])])
        return np.asarray(objects.T_map_object[n, :3, 3] - self._nodes.scene.origin + top)
