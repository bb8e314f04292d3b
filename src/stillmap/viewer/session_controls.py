"""The controls of a place: a slider over its sessions, and what changed in the chosen one."""

from typing import Any

from stillmap.viewer.place import ViewedPlace
from stillmap.viewer.sessions import SessionNodes
from stillmap.viewer.text import escape_markdown, table_html

_MAX_ROWS = 25


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
        rows = [(one.label, f"{one.kind}, {_place_of(*one.boxes[0])}") for one in changes]
        more = len(rows) - _MAX_ROWS
        rows = [*rows[:_MAX_ROWS], ("", f"and {more} more")] if more > 0 else rows
        none = "it is the first session" if session == 0 else "nothing"
        self._table.content = table_html(rows or [("", none)])


def _place_of(low: Any, high: Any) -> str:
    """The centre of a box."""
    x, y = 0.5 * (low[:2] + high[:2])
    return f"x {x:.1f} m, y {y:.1f} m"
