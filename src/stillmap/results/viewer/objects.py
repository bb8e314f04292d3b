"""Moving objects as viser nodes: boxes, numbers, models, tracks and the one that is selected."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.array_types import Float
from stillmap.core.arrays import sample_indices
from stillmap.io.trajectory import quaternion_from_pose
from stillmap.results.colors import color_by_id
from stillmap.results.objects import interpolate_pose
from stillmap.results.reader import Track
from stillmap.results.viewer.nodes import NO_SHADOWS, Labels, Nodes, node_path

# the unit cube: bits 0 to 2 of a corner are its side in x, y, z
_CORNERS = ((np.arange(8)[:, None] >> np.arange(3)) & 1) - 0.5
_EDGES = np.array([(a, a | bit) for bit in (1, 2, 4) for a in range(8) if not a & bit])
_FLOOR = _EDGES[(_EDGES < 4).all(axis=1)]
# sides counterclockwise from outside
_QUADS = np.array(
    [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
)
_TRIANGLES = np.concatenate([_QUADS[:, [0, 1, 2]], _QUADS[:, [0, 2, 3]]])
_MAX_TRACK_SEGMENTS = 100_000
_MAX_NUMBERS = 60
_FILL_OPACITY = 0.25
_MIN_THICKNESS = 0.01  # m of the boxes in 2D, which a click must hit


def box_edges(T: Float, size: Float) -> Float:
    """Both ends of the edges of boxes of a size (n, 3), height 0 in 2D, at poses T (n, 4, 4) of
    their centers: (n, 12, 2, 3) m; in 2D (n, 4, 2, 3)."""
    corners = (_CORNERS * size[:, None]) @ T[:, :3, :3].transpose(0, 2, 1) + T[:, None, :3, 3]
    return np.asarray(corners[:, _EDGES if size[:, 2].any() else _FLOOR])


def is_present(track: Track, stamp_ns: int) -> bool:
    """True if the track spans a time."""
    return bool(track.stamp_ns[0] <= stamp_ns <= track.stamp_ns[-1])


def describe_object(track: Track, stamp_ns: int, start_ns: int) -> list[tuple[str, str]]:
    """Names and values of what is known about an object, for a person to read.

    Args:
        track: of the object.
        stamp_ns: the time that is shown.
        start_ns: stamp of the first scan; times are in s since then.
    """
    first, last = (1e-9 * int(track.stamp_ns[n] - start_ns) for n in (0, -1))
    speed = np.linalg.norm(track.velocity, axis=1)
    now = np.interp(0.0, 1e-9 * (track.stamp_ns - stamp_ns), speed)
    facts = {
        "Seen": f"{first:.1f} s to {last:.1f} s ({last - first:.1f} s)",
        "Scans": f"{len(track.stamp_ns)}",
        "Speed now": f"{now:.1f} m/s" if is_present(track, stamp_ns) else "not seen",
        "Mean, highest": f"{speed.mean():.1f}, {speed.max():.1f} m/s",
        "Size": " x ".join(f"{length:.2f}" for length in track.size) + " m",
        "Beams": "" if track.beams is None else f"{track.beams:,}",
        "Mean P(dynamic)": "" if track.p_dynamic is None else f"{track.p_dynamic:.3f}",
        "P(one mover)": "" if track.p_identity is None else f"{track.p_identity:.3f}",
    }
    return [(name, value) for name, value in facts.items() if value]


class ObjectNodes:
    """The nodes of the moving objects of a scene.

    Attributes:
        selected: id of the selected object; None: none is.
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

    def make_boxes(self) -> None:
        """Create edges and sides of the boxes, and what marks the selected one."""
        pieces, colors = np.zeros((1, 2, 3)), np.zeros((1, 2, 3))
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
        self._mark_label = Labels(self._nodes, "Selected object")

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
        pieces, numbers = [np.zeros((0, 2, 3))], list[int]()
        for one in self._tracks:
            z = np.zeros(len(one.xy)) if one.z is None else one.z
            line = np.column_stack([one.xy, z]) - self._nodes.origin(1)
            pieces.append(np.stack([line[:-1], line[1:]], axis=1))
            numbers += [one.id] * (len(line) - 1)
        use = sample_indices(len(numbers), _MAX_TRACK_SEGMENTS)
        color = color_by_id(np.array(numbers, np.intp)[use])
        lines = np.concatenate(pieces)[use]
        self._nodes.lines("Object tracks", lines, np.repeat(color[:, None], 2, axis=1), 1.5)

    def make_models(self) -> None:
        """Create the models, all hidden."""
        for model in self._nodes.scene.models:
            path = node_path("Object models", f"{model.track.id:04d}")
            add = self._nodes.server.scene.add_glb
            node = add(path, model.data, visible=False, **NO_SHADOWS)
            node.on_click(partial(self._click_model, model.track.id))
            self._models.append(node)

    def update(self, stamp_ns: int, session: str, shown: Callable[[str], bool]) -> None:
        """Move what is shown to where it is at a time.

        Args:
            stamp_ns: the time.
            session: name of that of a place whose objects are shown; empty in other results.
            shown: whether a layer of this name is.
        """
        if shown("Object models"):
            for node, model in zip(self._models, self._nodes.scene.models, strict=True):
                node.visible = is_present(model.track, stamp_ns)
                if node.visible:
                    self._nodes.place(node, model.pose_at(stamp_ns))
        if not self._tracks:
            return
        # those of the session: clocks of robots may agree
        there = [one for one in self._tracks if one.session == session]
        there = [one for one in there if is_present(one, stamp_ns)]
        T = np.array([interpolate_pose(one, stamp_ns) for one in there]).reshape(-1, 4, 4)
        size = np.array([(*one.size, 0.0)[:3] for one in there]).reshape(-1, 3)
        color = color_by_id([one.id for one in there])
        if shown("Objects"):
            self._draw_boxes(T, size, color)
            self._drawn = [one.id for one in there]
        # above the boxes
        top = T[:, :3, 3] - self._nodes.scene.origin + np.array([0.0, 0.0, 0.5]) * size
        labels = [(str(one.id), at) for one, at in zip(there, top, strict=True)]
        self._labels.show(labels[:_MAX_NUMBERS] if shown("Object ids") else [])
        at = [n for n, one in enumerate(there) if one.id == self.selected]
        self._mark.visible = bool(at)
        self._mark_label.show([(f"object {self.selected}", top[n]) for n in at])
        if at:
            self._draw_edges(self._mark, T[at], size[at], color[at])

    def _draw_boxes(self, T: Float, size: Float, color: NDArray[np.uint8]) -> None:
        self._draw_edges(self._edges, T, size, color)
        self._sides.visible = bool(len(T))
        if len(T):
            self._sides.batched_positions = (T[:, :3, 3] - self._nodes.origin(1)).astype(np.float32)
            self._sides.batched_wxyzs = quaternion_from_pose(T).astype(np.float32)
            self._sides.batched_scales = np.maximum(size, _MIN_THICKNESS).astype(np.float32)
            self._sides.batched_colors = color

    def _draw_edges(self, node: Any, T: Float, size: Float, color: NDArray[np.uint8]) -> None:
        lines = box_edges(T, size) - self._nodes.origin(2)
        node.points = lines.reshape(-1, 2, 3).astype(np.float32)
        node.colors = np.broadcast_to(color[:, None, None], lines.shape).reshape(-1, 2, 3)
