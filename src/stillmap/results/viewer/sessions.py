"""The sessions of a place: trajectories, boxes of changes and their labels, and a slider."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.arrays import sample_indices
from stillmap.results.colors import KIND_COLORS, color_by_id
from stillmap.results.object_poses import ObjectPoses
from stillmap.results.timeline import SessionChange
from stillmap.results.viewer.nodes import Labels, Nodes, escape_markdown, table_html
from stillmap.results.viewer.objects import box_edges
from stillmap.results.viewer.scene import ViewedPlace

_MAX_ROWS = 25
Float = NDArray[np.float64]
_MAX_TRAJECTORY_POINTS = 20_000  # of all sessions together
_MAX_LABELS = 100
_MARGIN = 0.05  # m around what changed
# of an arrow's head, as shares of its length at most, and of the height of the view
_MAX_HEAD, _HEAD = 0.5, 0.02
# lengths drawn and left out in turn, as shares of the height of the view; None: a whole line
_DASHES: dict[str, tuple[float, ...] | None] = {
    "appeared": None,
    "gone": (0.006, 0.004),
    "moved": None,
    "from": (0.002, 0.003),
    "door": (0.01, 0.003, 0.002, 0.003),
}


class SessionNodes:
    """The nodes that only a place has.

    Attributes:
        session: index of the session that is shown.
    """

    def __init__(self, nodes: Nodes, place: ViewedPlace) -> None:
        """Create nothing yet.

        Args:
            nodes: creates them.
            place: the sessions.
        """
        self._nodes, self._place = nodes, place
        self._labels = Labels(nodes, "Change labels")
        self._lines: dict[str, Any] = {}
        self.session = len(place) - 1

    @property
    def changes(self) -> list[SessionChange]:
        """The changes since the session before."""
        return self._place.timeline.changes_at(self.session)

    def make_trajectories(self) -> None:
        """Create the lines of all sessions, each in its color."""
        place, poses = self._place, self._nodes.scene.poses
        most = max(_MAX_TRAJECTORY_POINTS // len(place), 2)
        for k in range(len(place)):
            scans = np.array(place.scans_of(k))
            points = poses[scans[sample_indices(len(scans), most)], :3, 3] - self._nodes.origin(1)
            if len(points) > 1:
                pieces = np.stack([points[:-1], points[1:]], axis=1)
                # one node each: viser draws colors of single lines paler than those of a whole node
                self._nodes.lines("Sessions", pieces, color_by_id([k])[0], 1.5, str(k))

    def make_boxes(self) -> None:
        """Create the lines around what changed, a node for each kind."""
        for kind, color in KIND_COLORS.items():
            pieces = np.zeros((1, 2, 3))
            self._lines[kind] = self._nodes.lines(
                "Changes", pieces, np.array(color, np.uint8), 2.5, kind
            )

    def update(self, with_boxes: bool, with_labels: bool) -> None:
        """Show what changed since the session before.

        Args:
            with_boxes: whether boxes are visible.
            with_labels: whether labels are.
        """
        if with_boxes:
            self._draw_boxes()
        shown = self.changes[:_MAX_LABELS] if with_labels else []
        self._labels.show([(f"{one.label} {one.kind}", self._top(one)) for one in shown])

    def _top(self, change: SessionChange) -> Float:
        """(3,) m above the upper side of a box, relative to the scene's origin."""
        low, high = (_in_space(corner) for corner in change.boxes[0])
        middle = 0.5 * float(low[0] + high[0])
        return np.asarray(np.array([middle, high[1], high[2]]) - self._nodes.origin(4))

    def _draw_boxes(self) -> None:
        for kind, node in self._lines.items():
            outlines = [
                _outline(one, self._nodes.height) for one in self.changes if one.kind == kind
            ]
            node.visible = bool(outlines)
            if outlines:
                drawn = np.concatenate(outlines) - self._nodes.origin(3)
                node.points = drawn.astype(np.float32)


class SessionControls:
    """A slider over the sessions of a place."""

    def __init__(self, gui: Any, place: ViewedPlace, nodes: SessionNodes) -> None:
        """Add the controls to the page.

        Args:
            gui: of the server.
            place: the sessions.
            nodes: what is shown of them.
        """
        self._place, self._nodes, last = place, nodes, len(place)
        self._title: Any = gui.add_markdown("")
        self._slider: Any = gui.add_slider("Session", 1, max(last, 2), 1, last, disabled=last < 2)
        self._folder: Any = gui.add_folder("Changed since the session before")
        with self._folder:
            self._table: Any = gui.add_html("")
        self.show()

    @property
    def wanted(self) -> int:
        """Index of the session that the slider is at."""
        return min(int(self._slider.value), len(self._place)) - 1

    def go_to(self, session: int) -> None:
        """Move the slider to the session that is nearest to an index."""
        self._slider.value = min(max(session, 0), len(self._place) - 1) + 1

    def show(self) -> None:
        """Show title and changes of the session that is shown."""
        session, timeline = self._nodes.session, self._place.timeline
        self._slider.value = session + 1
        self._title.content = f"**{escape_markdown(timeline.title(session))}**"
        changes = self._nodes.changes
        rows = [(one.label, _describe(one)) for one in changes]
        more = len(rows) - _MAX_ROWS
        rows = [*rows[:_MAX_ROWS], ("", f"and {more} more")] if more > 0 else rows
        none = "it is the first session" if session == 0 else "nothing"
        self._table.content = table_html(rows or [("", none)])


def _describe(change: SessionChange) -> str:
    low, high = change.boxes[0]
    x, y = 0.5 * (low[:2] + high[:2])
    return f"{change.kind}, x {x:.1f} m, y {y:.1f} m"


def _outline(change: SessionChange, height: float) -> Float:
    """Line segments (n, 2, 3) m of a change: its box; of what moved both boxes and an arrow."""
    box, *earlier = change.boxes
    edges = _box_edges(*box)
    out = [_make_dashes(edges, _DASHES[change.kind], height)]
    for before in earlier:
        start = _box_edges(*before)
        out += [
            _make_dashes(start, _DASHES["from"], height),
            _arrow(start.mean((0, 1)), edges.mean((0, 1)), height),
        ]
    return np.concatenate(out)


def _in_space(corner: Float) -> Float:
    """(3,) of a corner (D,)."""
    return np.array([*corner, 0.0][:3])


def _box_edges(low: Float, high: Float) -> Float:
    """(n, 2, 3) m, a little outside of the corners (D,)."""
    low, high = _in_space(low), _in_space(high)
    T = np.eye(4)[None].copy()
    T[0, :3, 3] = 0.5 * (low + high)
    size = high - low
    size += 2.0 * _MARGIN * (size > 0.0)
    return np.asarray(box_edges(ObjectPoses(np.zeros(1, np.intp), T, size[None]))[0])


def _make_dashes(edges: Float, pattern: tuple[float, ...] | None, height: float) -> Float:
    """The parts of edges (n, 2, 3) that are drawn."""
    if pattern is None:
        return edges
    lengths = np.array(pattern) * height
    out = []
    for a, b in edges:
        length = float(np.linalg.norm(b - a))
        ends = np.cumsum(np.tile(lengths, int(length / lengths.sum()) + 1))
        starts = np.concatenate([[0.0], ends[:-1]])[::2]
        share = np.stack([starts, ends[::2]], axis=1)[starts < length] / max(length, 1e-9)
        out.append(a + np.minimum(share, 1.0)[:, :, None] * (b - a))
    return np.concatenate(out)


def _arrow(start: Float, end: Float, height: float) -> Float:
    """(3, 2, 3): a line and its head, which lies in the plane."""
    length = max(float(np.linalg.norm(end - start)), 1e-9)
    along = (end - start) / length
    across = np.array([-along[1], along[0], 0.0])
    head = min(_MAX_HEAD * length, _HEAD * height)
    wings = [end - head * (along + side * 0.5 * across) for side in (1.0, -1.0)]
    return np.array([[start, end], [wings[0], end], [wings[1], end]])
