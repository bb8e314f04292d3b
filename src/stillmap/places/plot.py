"""Pictures of a place: its map, the way of the robot in each session, what changed."""

from typing import TYPE_CHECKING

import numpy as np

from stillmap.core.errors import import_extra
from stillmap.places.pictures import KIND_COLORS
from stillmap.results.plot import draw_dynamic, plot_result

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from stillmap.places.saved_place import SavedPlace


def plot_place(
    place: "SavedPlace", ax: "Axes | None", *, trajectory: bool, dynamic: bool, changes: bool
) -> "Axes":
    """See `SavedPlace.plot`."""
    ax = plot_result(place, ax, trajectory=False, dynamic=False)
    placed = [one for one in place.sessions if one.accepted]
    if dynamic:
        for one in placed:
            draw_dynamic(place.load_session(one.name), ax)
    if trajectory:
        for one in placed:
            x, y = place.poses[one.scans, :2, -1].T
            ax.plot(x, y, linewidth=1.0, label=one.name)
    if changes:
        _draw_changes(place, ax)
    return ax


def _draw_changes(place: "SavedPlace", ax: "Axes") -> None:
    patches = import_extra("matplotlib.patches", "a plot", "drawn", group="notebook")
    for one in place.changes:
        color = tuple(level / 255.0 for level in KIND_COLORS[one.kind])
        x0, y0, x1, y1 = one.box[:4]
        ax.add_patch(
            patches.Rectangle(
                (x0, y0), x1 - x0, y1 - y0, fill=False, edgecolor=color, linewidth=1.2
            )
        )
        if one.from_box is not None:
            before = np.array(one.from_box[:4]).reshape(2, 2).mean(axis=0)
            after = np.array(one.box[:4]).reshape(2, 2).mean(axis=0)
            ax.annotate("", after, before, arrowprops={"arrowstyle": "->", "color": color})
