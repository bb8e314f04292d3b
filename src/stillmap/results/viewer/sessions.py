"""The sessions of a place: a slider, trajectories, boxes of changes and their labels."""

from typing import Any

import numpy as np

from stillmap.core.array_types import Float
from stillmap.results.colors import KIND_COLORS, color_by_id
from stillmap.results.timeline import SessionChange, Timeline
from stillmap.results.viewer.nodes import Labels, Nodes, escape_markdown, table_html
from stillmap.results.viewer.objects import box_edges

_MAX_ROWS = 25
_MAX_TRAJECTORY_POINTS = 20_000  # of all sessions together
_MAX_LABELS = 100
_MARGIN = 0.05  # m around what changed
# of an arrow's head, as shares of its length at most, and of the height of the view
_MAX_HEAD, _HEAD = 0.5, 0.02


class Sessions:
    """Controls and nodes that only a place has.

    Attributes:
        session: index of the session that is shown.
        scans: its scans.
        name: its name.
    """

    def __init__(self, nodes: Nodes, timeline: Timeline) -> None:
        """Add the controls to the page; create no node yet."""
        self._nodes, self._timeline, self._lines = nodes, timeline, dict[str, Any]()
        self._labels = Labels(nodes, "Change labels")
        self.count = len(timeline.sessions)
        gui, last = nodes.server.gui, self.count
        self._title: Any = gui.add_markdown("")
        self._slider: Any = gui.add_slider("Session", 1, max(last, 2), 1, last, disabled=last < 2)
        with gui.add_folder("Changed since the session before"):
            self._table: Any = gui.add_html("")

    @property
    def wanted(self) -> int:
        """Index of the session that the slider is at."""
        return min(int(self._slider.value), self.count) - 1

    def go_to(self, session: int) -> None:
        """Move the slider to the session that is nearest to an index."""
        self._slider.value = min(max(session, 0), self.count - 1) + 1

    def choose(self, session: int) -> None:
        """Show title and changes of a session."""
        one = self._timeline.sessions[session]
        self.session, self.name, self.scans = session, one.name, one.scans
        self._changes = self._timeline.changes_at(session)
        self._slider.value = session + 1
        self._title.content = f"**{escape_markdown(self._timeline.title(session))}**"
        rows = [(change.label, _describe(change)) for change in self._changes]
        more = len(rows) - _MAX_ROWS
        rows = [*rows[:_MAX_ROWS], ("", f"and {more} more")] if more > 0 else rows
        none = "it is the first session" if session == 0 else "nothing"
        self._table.content = table_html(rows or [("", none)])

    def make_trajectories(self) -> None:
        """Create the lines of all sessions, each in its color."""
        most = max(_MAX_TRAJECTORY_POINTS // self.count, 2)
        for k, one in enumerate(self._timeline.sessions):
            pieces = self._nodes.path_pieces(one.scans, 1, most)
            # one node each: viser draws colors of single lines paler than those of a whole node
            self._nodes.lines("Sessions", pieces, color_by_id([k])[0], 1.5, str(k))

    def make_boxes(self) -> None:
        """Create the lines around what changed, a node for each kind."""
        for kind, color in KIND_COLORS.items():
            none = np.zeros((1, 2, 3))
            self._lines[kind] = self._nodes.lines("Changes", none, color, 2.5, kind)

    def update(self, with_labels: bool) -> None:
        """Draw what changed since the session before, with labels or without."""
        for kind, node in self._lines.items():
            of_kind = [one for one in self._changes if one.kind == kind]
            outlines = [_outline(one, self._nodes.height) for one in of_kind]
            node.visible = bool(outlines)
            if outlines:
                drawn = np.concatenate(outlines) - self._nodes.origin(3)
                node.points = drawn.astype(np.float32)
        shown = self._changes[:_MAX_LABELS] if with_labels else []
        self._labels.show([(f"{one.label} {one.kind}", self._top(one)) for one in shown])

    def _top(self, change: SessionChange) -> Float:
        """(3,) m above the upper side of a box, relative to the scene's origin."""
        (x0, _, _), (x1, y1, z1) = (np.array([*one, 0.0][:3]) for one in change.boxes[0])
        return np.array([0.5 * (x0 + x1), y1, z1]) - self._nodes.origin(4)


def _describe(change: SessionChange) -> str:
    low, high = change.boxes[0]
    x, y = 0.5 * (low[:2] + high[:2])
    return f"{change.kind}, x {x:.1f} m, y {y:.1f} m"


def _outline(change: SessionChange, height: float) -> Float:
    """Line segments (n, 2, 3) m of a change: its box; of what moved both boxes and an arrow."""
    end, *starts = (_box_lines(low, high) for low, high in change.boxes)
    arrows = [_arrow(start.mean((0, 1)), end.mean((0, 1)), height) for start in starts]
    return np.concatenate([end, *starts, *arrows])


def _box_lines(low: Float, high: Float) -> Float:
    """(n, 2, 3) m, a little outside of the corners (D,)."""
    low, high = (np.array([*corner, 0.0][:3]) for corner in (low, high))
    T = np.eye(4)
    T[:3, 3] = 0.5 * (low + high)
    size = high - low + 2.0 * _MARGIN * (high > low)
    return np.asarray(box_edges(T[None], size[None])[0])


def _arrow(start: Float, end: Float, height: float) -> Float:
    """(3, 2, 3): a line and its head, which lies in the plane."""
    length = max(float(np.linalg.norm(end - start)), 1e-9)
    along = (end - start) / length
    across = np.array([-along[1], along[0], 0.0])
    head = min(_MAX_HEAD * length, _HEAD * height)
    wings = [end - head * (along + side * 0.5 * across) for side in (1.0, -1.0)]
    return np.array([[start, end], [wings[0], end], [wings[1], end]])
