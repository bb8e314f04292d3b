"""Moving objects as viser nodes: boxes, numbers, models, tracks and the one that is selected."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.arrays import sample_indices
from stillmap.results.colors import color_by_id
from stillmap.results.object_poses import ObjectPoses, is_present, object_poses_at
from stillmap.results.reader import Track
from stillmap.results.viewer.nodes import NO_SHADOWS, Labels, Nodes, node_path, quaternions

Float = NDArray[np.float64]
# corners of a box that each edge joins; bits 0 to 2 of a corner are its side in x, y, z
_EDGES = np.array([(a, a | bit) for bit in (1, 2, 4) for a in range(8) if not a & bit])
_FLOOR = _EDGES[(_EDGES < 4).all(axis=1)]
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


def box_edges(objects: ObjectPoses) -> Float:
    """Both ends of the box edges, (n, 12, 2, 3) m in the map frame; (n, 4, 2, 3) in 2D."""
    edges = _EDGES if objects.size[:, 2].any() else _FLOOR
    sides = ((np.arange(8)[:, None] >> np.arange(3)) & 1) - 0.5  # (8, 3)
    corners = sides * objects.size[:, None]
    R, t = objects.T_map_object[:, :3, :3], objects.T_map_object[:, :3, 3]
    return np.asarray((corners @ R.transpose(0, 2, 1) + t[:, None])[:, edges])


def track_segments(tracks: Sequence[Track]) -> tuple[Float, NDArray[np.intp]]:
    """Line segments (m, 2, 3) in m of all tracks, and the index (m,) of their tracks."""
    lines = [
        np.column_stack([one.xy, np.zeros(len(one.xy)) if one.z is None else one.z])
        for one in tracks
    ]
    segments = [np.stack([row[:-1], row[1:]], axis=1) for row in lines]
    index = np.repeat(np.arange(len(lines)), [len(one) for one in segments])
    return np.concatenate([np.zeros((0, 2, 3)), *segments]), index


def describe_object(track: Track, stamp_ns: int, start_ns: int) -> list[tuple[str, str]]:
    """Names and values of what is known about an object, for a person to read.

    Args:
        track: of the object.
        stamp_ns: the time that is shown.
        start_ns: stamp of the first scan; times are in s since then.
    """
    first, last = (1e-9 * int(track.stamp_ns[n] - start_ns) for n in (0, -1))
    speed = np.linalg.norm(track.velocity, axis=1)
    now = "not seen"
    if is_present(track, stamp_ns):
        at = np.interp(0.0, 1e-9 * (track.stamp_ns - stamp_ns), speed)
        now = f"{at:.1f} m/s"
    facts = [
        ("Seen", f"{first:.1f} s to {last:.1f} s ({last - first:.1f} s)"),
        ("Scans", f"{len(track.stamp_ns)}"),
        ("Speed now", now),
        ("Mean, highest", f"{speed.mean():.1f}, {speed.max():.1f} m/s"),
        ("Size", " x ".join(f"{length:.2f}" for length in track.size) + " m"),
    ]
    if track.beams is not None:
        facts.append(("Beams", f"{track.beams:,}"))
    if track.p_dynamic is not None:
        facts.append(("Mean P(dynamic)", f"{track.p_dynamic:.3f}"))
    if track.p_identity is not None:
        facts.append(("P(one mover)", f"{track.p_identity:.3f}"))
    return facts


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
        self._labels = Labels(nodes, "Object ids")
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
        segments, index = track_segments(self._tracks)
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
        objects = object_poses_at(self._tracks, stamp_ns)
        # those of the session: clocks of robots may agree
        own = [self._tracks[n].session == self.session for n in objects.track]
        objects = _select(objects, np.flatnonzero(own))
        if shown("Objects"):
            self._draw_boxes(objects)
        if self._tracks:
            count = min(_MAX_NUMBERS, len(objects.track)) if shown("Object ids") else 0
            ids = [str(self._tracks[n].id) for n in objects.track[:count]]
            self._labels.show([(id, self._top(objects, n)) for n, id in enumerate(ids)])
            self._draw_mark(objects)

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
        lines = box_edges(objects) - self._nodes.origin(2)
        colors = np.broadcast_to(color[:, None, None], lines.shape)
        node.points = lines.reshape(-1, 2, 3).astype(np.float32)
        node.colors = colors.reshape(-1, 2, 3)

    def _draw_mark(self, objects: ObjectPoses) -> None:
        """Mark the selected object where it is there."""
        at = [n for n, one in enumerate(objects.track) if self._tracks[one].id == self.selected]
        self._mark.visible = self._mark_label.visible = bool(at)
        if at:
            only = _select(objects, np.array(at, np.intp))
            self._draw_edges(self._mark, only, self._colors(only.track))
            self._mark_label.text = f"object {self.selected}"
            self._mark_label.position = self._top(objects, at[0])

    def _top(self, objects: ObjectPoses, n: int) -> NDArray[np.float64]:
        """(3,) m, relative to the scene's origin."""
        top = np.array([0.0, 0.0, 0.5 * float(objects.size[n, 2])])
        return np.asarray(objects.T_map_object[n, :3, 3] - self._nodes.scene.origin + top)


def _select(objects: ObjectPoses, use: NDArray[np.intp]) -> ObjectPoses:
    return ObjectPoses(objects.track[use], objects.T_map_object[use], objects.size[use])
